"""Conditions of a verdict apart from few false alarms: evidence of the residuals, a margin, a well-determined pose."""

import math
import re
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest
from planted import degrees_between, directions
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from scipy.special import stdtrit

from bpnp.arrays import Array
from bpnp.runtime import NEVER, Deadline
from bpnp.search.hypotheses import Hypotheses
from bpnp.search.problem import Problem, UnknownFocal
from bpnp.search.propose.known_matches import poses_of_matches
from bpnp.search.search_frame import SearchFrame
from bpnp.search.settings import DEFAULT
from bpnp.search.verdict.contest import contest, rivals_of
from bpnp.search.verdict.decide import Case, SearchResult, decide
from bpnp.search.verdict.rivals.lens import AtZoom, lens, likeliest_zoom

SHIFT = np.array([0.0, 0.0, 6.0])


def case_of(problem: Problem, rotations: Array, translations: Array, scale: float, matched: float) -> Case:
    c = len(rotations)
    poses = Hypotheses.from_poses(
        rotations,
        translations,
        log_likelihood=-np.arange(float(c)),
        match_count=np.full(c, matched * min(len(problem.bearings), len(problem.points3d))),
        scale=np.full(c, scale),
    )
    return Case.of(poses, problem, exhaustive=True)


def verdict_on(problem: Problem, *known: Any) -> SearchResult:
    return decide(case_of(problem, *known))


def test_a_few_exact_matches_do_not_make_a_rough_alignment_precise() -> None:
    """14 of 80 points fit at 3e-4 rad, the rest only at 4e-3: no false alarm, but not where the matches say."""
    rng = np.random.default_rng(0)
    points = rng.uniform(-1, 1, (80, 3))
    noise = np.where(np.arange(80) < 14, 3e-4, 4e-3)[:, None]
    exact = directions(points + SHIFT)
    for spread, scale, verdict in ((noise, 3e-4, "ambiguous"), (noise, 4e-3, "confident"), (3e-4, 3e-4, "confident")):
        rays = directions(exact + spread * rng.standard_normal((80, 3)))
        found = verdict_on(Problem(rays, points), np.eye(3)[None], SHIFT[None], scale, 0.2)
        assert found.log10_false_alarms < -2
        assert found.verdict == verdict
        assert ("residuals far larger" in found.reason) == (verdict == "ambiguous")


def test_a_pose_with_a_large_covariance_is_confident_and_the_reason_has_the_bound() -> None:
    """40 points that fill 1 / 600 rad: their tilt has an error of about a degree for a noise of 1e-4 rad, and a tenth
    of it for 1e-5. Nothing else explains them, and the reason says how well the rotation is known."""
    rng = np.random.default_rng(1)
    points, shift = rng.uniform(-1, 1, (40, 3)), np.array([0, 0, 600.0])
    known = []
    for noise in (1e-5, 1e-4):
        rays = directions(directions(points + shift) + noise * rng.standard_normal((40, 3)))
        found = verdict_on(Problem(rays, points), np.eye(3)[None], shift[None], noise, 1.0)
        assert found.log10_false_alarms < -2
        assert found.verdict == "confident"
        known.append(float(re.search(r"known to (\S+) deg", found.reason)[1]))
    assert 5 * known[0] < known[1] < 20 * known[0]


@pytest.mark.parametrize(
    ("distance", "is_map", "verdict"),
    [(2.0, False, "confident"), (2.0, True, "ambiguous"), (20.0, False, "ambiguous")],
)
def test_a_loose_focal_length_of_a_small_object_is_still_confident(distance: float, is_map: bool, verdict: str) -> None:
    """The bound in the reason is that of Student's t for the spread of repeated fits. Of a map it is too loose."""
    rng, noise = np.random.default_rng(2), 4e-3
    points, shift = rng.uniform(-1, 1, (12, 3)), np.array([0, 0, 3 * distance])
    exact = directions(points + shift)

    def fitted(seen: Array) -> float:
        def residuals(step: Array) -> Array:
            camera = points @ Rotation.from_rotvec(step[:3]).as_matrix().T + (1 + step[5]) * shift
            camera += (*step[3:5], 0)
            return (directions(camera * np.array([math.exp(step[6]), math.exp(step[6]), 1])) - seen).ravel()

        return float(least_squares(residuals, np.zeros(7)).x[6])

    draws = [directions(exact + noise / distance * rng.standard_normal((12, 3))) for _ in range(60)]
    cones = {"normals3d": -exact, "cosines3d": np.full(12, -1.0)} if is_map else {}
    problem = Problem(draws[0], points, focal=UnknownFocal(math.log(6)), **cones)
    found = verdict_on(problem, np.eye(3)[None], shift[None], noise / distance, 1.0)
    bound = re.search(r"(?:focal length to|may be) (\d+) %", found.reason)
    assert found.verdict == verdict
    if distance < 20:
        spread = np.std([fitted(seen) for seen in draws])
        assert bound is not None
        assert 25 < float(bound[1]) < 100
        assert float(bound[1]) == pytest.approx(100 * math.expm1(spread * stdtrit(17, 0.9995)), rel=0.5)


@pytest.mark.parametrize(
    ("basin_count", "local_searches", "verdict"),
    [(0, 0, "ambiguous"), (10, 0, "ambiguous"), (10, 1, "confident"), (6, 2, "confident")],
)
def test_weak_matches_need_repeated_basins_or_a_local_search(
    basin_count: int, local_searches: int, verdict: str
) -> None:
    """400 points with residuals of their spacing: a match is worth a hundredth of a decade.

    Ten initial poses could as well have ended at a far better optimum, which they make unlikely. A local search
    excludes a better optimum near the pose.
    """
    rng = np.random.default_rng(1)
    points = rng.uniform(-1, 1, (400, 3))
    rays = directions(directions(points + SHIFT) + 5e-3 * rng.standard_normal((400, 3)))
    columns = {"match_count": np.array([320.0]), "scale": np.array([5e-3])}
    pose = Hypotheses.from_poses(np.eye(3)[None], SHIFT[None], basin_count=basin_count, **columns)
    found = decide(Case.of(pose, Problem(rays, points), local_searches=local_searches))
    assert -10 > found.log10_false_alarms > -60
    assert found.verdict == verdict
    assert ("miss probability" in found.reason) == (verdict == "ambiguous")


@pytest.mark.parametrize(("degrees", "verdict"), [(1.0, "confident"), (4.0, "ambiguous")])
def test_initial_poses_that_end_near_a_pose_count_for_its_basin(degrees: float, verdict: str) -> None:
    """All ten initial poses end at another optimum, which is the same pose up to two degrees; the rest is as above."""
    rng = np.random.default_rng(1)
    points = rng.uniform(-1, 1, (400, 3))
    rays = directions(directions(points + SHIFT) + 5e-3 * rng.standard_normal((400, 3)))
    rotations = Rotation.from_rotvec([[0, 0, 0], [0, 0, np.radians(degrees)]]).as_matrix()
    columns = {"match_count": np.array([320.0, 200.0]), "scale": np.array([5e-3, 5e-3])}
    poses = Hypotheses.from_poses(rotations, np.stack([SHIFT, SHIFT]), **columns)
    poses = replace(poses, basin_count=np.array([0, 10]))
    found = decide(Case.of(poses, Problem(rays, points), local_searches=1))
    assert found.verdict == verdict
    assert ("miss probability" in found.reason) == (verdict == "ambiguous")


@pytest.mark.parametrize(("others", "verdict"), [(16, "ambiguous"), (2, "confident")])
def test_two_poses_that_explain_different_points_are_ambiguous(others: int, verdict: str) -> None:
    """20 image points of one pose and as many others of a different one: only if the signs are 20 to 2, chance is
    less than exp(-18^2 / 2 / 22) = 1 / 1580 to have made the difference; of independent points 4 are enough."""
    rng = np.random.default_rng(2)
    points = rng.uniform(-1, 1, (60, 3))
    turn = Rotation.from_euler("y", 50, degrees=True).as_matrix()
    rays = np.concatenate([points[:20] + SHIFT, points[20 : 20 + others] @ turn.T + SHIFT])
    problem = Problem(directions(directions(rays) + 1e-3 * rng.standard_normal(rays.shape)), points)
    found = verdict_on(problem, np.stack([np.eye(3), turn]), np.stack([SHIFT, SHIFT]), 1e-3, 0.5)
    alarms = found.candidates.log10_false_alarms
    assert alarms[0] < min(alarms[1] - 3, -5)
    assert found.verdict == verdict
    assert ("50 deg away explains" in found.reason) == (verdict == "ambiguous")


@pytest.mark.slow
@pytest.mark.parametrize("factor", [1.0, 1.3, 0.75])
def test_a_focal_length_sweep_reaches_the_true_focal_length(factor: float) -> None:
    """1,500 dense points, seen with `factor` times the true focal length by a pose that is three degrees off. It is an
    alternative; so is that there was no time to look, unless Gauss-Newton steps from the pose itself had found it."""
    rng = np.random.default_rng(2)
    points, shift = rng.uniform(-1, 1, (1500, 3)), np.array([0.0, 0.0, 4.0])
    exact = directions(points + shift) + 4e-3 * rng.standard_normal((1500, 3))
    problem = Problem(directions(exact / (factor, factor, 1)), points)
    turned = Rotation.from_euler("x", 3, degrees=True).as_matrix()
    away = shift * (1, 1, factor) - turned @ problem.centre3d
    met = AtZoom(1.0, problem, Hypotheses.from_poses(turned[None], away[None], scale=np.array([4e-3])))
    climbed = likeliest_zoom(met, SearchFrame(problem, 0, DEFAULT))
    assert climbed.zoom == pytest.approx(1 / factor, rel=0.09 if factor == 1 else 0.045)  # half a step; never none
    assert np.degrees(Rotation.from_matrix(climbed.pose.rotation[0]).magnitude()) < 0.5
    seen = case_of(problem, np.eye(3)[None], met.centre3d[None], 4e-3, 0.6)
    scenes = [SearchFrame(problem, 0, DEFAULT, end) for end in (NEVER, Deadline(0.0))]
    other, (untried,) = (lens(seen, scene_of=lambda one=one: one, deadline=one.deadline).objections for one in scenes)
    if not other:
        assert (factor, untried.clause) == (1.0, "there was no time to try other focal lengths")
    else:
        zoom = float(re.search(r"with (\S+) times the focal length", other[0].clause)[1])
        assert zoom == pytest.approx(1 / factor, rel=0.03)


def test_a_pose_is_not_confident_if_there_was_no_time_to_refine_its_competing_pose() -> None:
    """Half of the scene is nearly a copy of the other half, turned by 180 degrees. The planted pose fits best."""
    rng = np.random.default_rng(0)
    half = rng.uniform(-1, 1, (40, 3))
    points = np.concatenate([half, half * [-1, -1, 1] + 0.01 * rng.standard_normal((40, 3))])
    rays = points + [0, 0, 6] + 0.006 * rng.standard_normal(points.shape)
    problem = Problem.of(rays / np.linalg.norm(rays, axis=1, keepdims=True), points)
    found = poses_of_matches(problem, np.arange(80), np.arange(80), 0)
    alone = Case.of(found, problem, exhaustive=True)
    assert (alone.objection, len(alone.candidates)) == (None, 1)
    in_time, late = (
        decide(contest(alone, rivals_of(partial(SearchFrame, problem, 0, DEFAULT, end), end)))
        for end in (NEVER, Deadline(0.0))
    )
    assert degrees_between(in_time.best[0], np.eye(3)) < 1
    assert degrees_between(in_time.candidates.rotation[1], np.diag([-1.0, -1.0, 1.0])) < 2
    assert (in_time.verdict, in_time.code) == ("confident", "confident")
    assert (late.verdict, late.code) == ("ambiguous", "untested")
    assert late.reason.startswith("There was no time to test its competing poses")


def test_a_pose_that_sees_no_more_points_than_fix_it_fails() -> None:
    """Three points fit some pose exactly. As the only pose that was tested, it has an NFA of exactly 1."""
    points = np.random.default_rng(4).uniform(-1, 1, (12, 3))
    away = points + SHIFT
    normals = away / np.linalg.norm(away, axis=1, keepdims=True)
    normals[:3] *= -1  # only these face the camera
    problem = Problem(directions(away), points, normals3d=normals, log10_tried=0.0)
    result = verdict_on(problem, np.eye(3)[None], SHIFT[None], 1e-3, 0.25)
    assert result.log10_false_alarms == 0
    assert (result.verdict, result.code) == ("failed", "chance")
