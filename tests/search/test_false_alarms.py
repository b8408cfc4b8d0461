"""The evidence for a pose: what holds for unrelated points by law, and what a planted pose must show."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from planted import directions
from scipy.spatial.transform import Rotation

from bpnp.arrays import Array
from bpnp.search import problem as problem_module
from bpnp.search.pose_model import PoseModel
from bpnp.search.problem import Problem
from bpnp.search.starts import GravityPrior, PosePrior
from bpnp.search.verdict.false_alarms import (
    alarms_of,
    camera_terms,
    directions_of,
    log10_nfa,
    point_evidence,
)

SHIFT = np.array([0.1, -0.2, 6.0])


def planted(rng: np.random.Generator, count: int, noise: float = 4e-4) -> tuple[Array, Array, Array]:
    """Bearings of `count` points with noise in radians, the points, and the rotation; the translation is SHIFT."""
    points = rng.uniform(-1, 1, (count, 3))
    rotation = Rotation.random(random_state=rng).as_matrix()
    rays = directions(points @ rotation.T + SHIFT)
    return directions(rays + noise * rng.standard_normal(rays.shape)), points, rotation


def scattered(rng: np.random.Generator, count: int, width: float) -> Array:
    return directions(np.column_stack([rng.uniform(-width, width, (count, 2)), np.ones(count)]))


def evidence(rays: Array, points: Array, rotation: Array, floor: float | None = 2e-4, **known: Any) -> float:
    return alarms(Problem(rays, points, floor=floor, **known), rotation, SHIFT)


def alarms(problem: Problem, rotation: Array, translation: Array) -> float:
    return float(alarms_of(problem, rotation[None], translation[None]).own[0])


@pytest.mark.parametrize(("count", "least"), [(7, -3), (12, -10), (100, -150)])
def test_a_planted_pose_is_significant(count: int, least: float) -> None:
    rng = np.random.default_rng(count)
    for _ in range(10):
        assert evidence(*planted(rng, count)) < least


def test_a_pose_of_four_points_is_not_significant() -> None:
    """Three of them fix the pose, and there are 2 * 24 * 24 / 6 ways to choose these: one more is to be expected."""
    rng = np.random.default_rng(0)
    assert min(evidence(*planted(rng, 4, 2e-3), 1e-3) for _ in range(20)) > -1


@pytest.mark.parametrize("width", [0.002, 0.006])
def test_clusters_of_points_count_as_one_observation_each(width: float) -> None:
    """Six clumps of eight points, in the image and in the scene, meet under a pose. The points within them are others,
    or the same ones, seen with less noise than the clumps are wide."""
    rng, clumps, alone = np.random.default_rng(0), [], []
    for _ in range(20):
        rotation = Rotation.random(random_state=rng).as_matrix()
        middles = rng.uniform(-1, 1, (6, 3))
        points = middles.repeat(8, 0) + 6 * width * rng.standard_normal((48, 3))
        rays = directions(middles @ rotation.T + SHIFT)
        others = directions(rays.repeat(8, 0) + width * rng.standard_normal(points.shape))
        own = directions(directions(points @ rotation.T + SHIFT) + width / 20 * rng.standard_normal(points.shape))
        clumps.append(evidence(others, points, rotation))
        alone.append(evidence(rays, middles, rotation))
        assert evidence(own, points, rotation) < -30
    assert np.median(clumps) > np.median(alone)


@pytest.mark.slow
@pytest.mark.parametrize("count", [5, 20, 200])
def test_the_bound_of_markov_holds_for_unrelated_points(count: int) -> None:
    """A pose that was not chosen by the points has a product above b in at most one of b cases.

    The tests are those of three matches, or of the poses that differ at a scale where these are fewer.
    """
    rng = np.random.default_rng(count)
    matches = math.log10(2 * math.comb(count, 3) ** 2 * 6)
    products = []
    for _ in range(400):
        seen = scattered(rng, count, 0.4) * rng.uniform(4, 8, (count, 1))
        turn = Rotation.random(random_state=rng).as_matrix()
        problem = Problem(scattered(rng, count, 0.25), seen @ turn)
        image = problem.image
        cells = PoseModel.of(problem).log10_cells(image.spread, image.scales, image.solid_angle)
        tests = np.minimum(cells, matches)
        products.append(-np.log10(np.mean(10.0**-tests)) - alarms(problem, turn, np.zeros(3)))
    for bound in (0.5, 1, 2):
        assert np.mean(np.array(products) > bound) <= 10**-bound


def test_keypoints_in_one_place_are_one_observation() -> None:
    rays, points, rotation = planted(np.random.default_rng(2), 10)
    assert evidence(np.tile(rays, (5, 1)), points, rotation) > evidence(rays, points, rotation) - 1


def test_labels_and_normals_exclude_matches() -> None:
    rays, points, rotation = planted(np.random.default_rng(3), 12)
    free, own = evidence(rays, points, rotation), np.arange(12) % 3
    assert evidence(rays, points, rotation, labels2d=own, labels3d=own) < free < 0
    assert evidence(rays, points, rotation, labels2d=own, labels3d=(own + 1) % 3) > 0
    anything = evidence(rays, points, rotation, labels2d=np.full(12, -1), labels3d=own)
    assert anything == pytest.approx(free)
    away = directions(points @ rotation.T + SHIFT) @ rotation
    assert evidence(rays, points, rotation, normals3d=-away) == pytest.approx(free)
    assert evidence(rays, points, rotation, normals3d=away) > 0


def test_a_prior_lowers_the_nfa_of_a_pose_that_agrees_with_it() -> None:
    rays, points, rotation = planted(np.random.default_rng(4), 6)
    free, up = evidence(rays, points, rotation), np.array([0.0, 0, 1])
    right = GravityPrior(rotation @ up, up, sigma_deg=2.0)
    # All directions within 4 degrees of one are (1 - cos 4 deg) / 2 of the sphere.
    assert evidence(rays, points, rotation, prior=right) == pytest.approx(free - 2.914, abs=1e-3)
    wrong = GravityPrior(-rotation @ up, up, sigma_deg=2.0)
    assert evidence(rays, points, rotation, prior=wrong) == pytest.approx(free)
    near = PosePrior(rotation, SHIFT, 1.0, 0.06)
    assert evidence(rays, points, rotation, prior=near) < free - 3.5  # one test is left of 4,800
    far = PosePrior(rotation, SHIFT, 180.0, 1e6)
    assert evidence(rays, points, rotation, prior=far) == pytest.approx(free)


def wide_priors(rng: np.random.Generator) -> list[PosePrior | GravityPrior]:
    """Priors of a rotation, of a pose and of a vertical, which have nothing to do with a pose."""
    turn, up = Rotation.random(random_state=rng).as_matrix(), directions(rng.standard_normal((2, 3)))
    return [
        PosePrior(turn, None, 15.0),
        PosePrior(turn, np.array([0.2, 0.1, 6.0]), 10.0, 0.6),
        PosePrior(turn, np.array([0.2, 0.1, 6.0]), 40.0, 0.1),
        GravityPrior(up[0], up[1], 10.0),
    ]


def test_the_fraction_of_poses_as_near_to_a_prior_is_a_p_value() -> None:
    """Over evenly drawn poses of a scene about the origin it is at most u with a probability of at most u."""
    rng, count = np.random.default_rng(0), 8000
    problem = Problem(scattered(rng, 400, 0.4), rng.uniform(-1, 1, (41, 3)))
    turns = Rotation.random(count, random_state=rng).as_matrix()
    shifts = scattered(rng, count, 0.4) * 6 * 30 ** rng.uniform(-0.5, 0.5, (count, 1)) - turns @ problem.centre3d
    for prior in wide_priors(rng):
        known = replace(problem, prior=prior)
        fractions = np.array([known.log10_prior_fraction(*pose) for pose in zip(turns, shifts, strict=True)])
        for u in (0.03, 0.1, 0.3, 0.6, 0.9):
            assert (fractions <= math.log10(u)).mean() <= u + 4 * math.sqrt(u * (1 - u) / count), prior
        if isinstance(prior, GravityPrior) or prior.translation is None:  # then it is exact
            assert (fractions <= math.log10(0.3)).mean() == pytest.approx(0.3, abs=0.02)


def test_a_prior_does_not_change_the_number_of_tests() -> None:
    """The NFA of each pose is that without a prior, times the fraction of poses that are as near to the prior."""
    rng = np.random.default_rng(1)
    rays, points, rotation = planted(rng, 12)
    problem = Problem(rays, points, floor=2e-4)
    other = rotation @ Rotation.from_rotvec([0, 0, 2.0]).as_matrix()
    for prior in wide_priors(rng):
        known = replace(problem, prior=prior)
        for turn in (rotation, other):
            fraction = known.log10_prior_fraction(turn, SHIFT)
            assert alarms(known, turn, SHIFT) == pytest.approx(alarms(problem, turn, SHIFT) + fraction)


@pytest.mark.slow
@pytest.mark.parametrize("kind", range(4))
def test_the_bound_of_markov_holds_with_a_prior(kind: int) -> None:
    """Without the number of tests, a pose that was not chosen by the points exceeds b in at most one of b cases."""
    rng, products = np.random.default_rng(kind), []
    matches = math.log10(2 * math.comb(20, 3) ** 2 * 6)
    for _ in range(400):
        turn, middle = (
            Rotation.random(random_state=rng).as_matrix(),
            scattered(rng, 1, 0.3) * 6 * 30 ** rng.uniform(-0.5, 0.5),
        )
        seen = rng.uniform(-1, 1, (20, 3)) + middle
        prior = wide_priors(rng)[kind]
        problem = Problem(scattered(rng, 20, 0.4), seen @ turn, prior=prior)
        image = problem.image
        cells = PoseModel.of(problem).log10_cells(image.spread, image.scales, image.solid_angle)
        products.append(-np.log10(np.mean(10.0 ** -np.minimum(cells, matches))) - alarms(problem, turn, np.zeros(3)))
    for bound in (0.5, 1, 2):
        assert np.mean(np.array(products) > bound) <= 10**-bound


def test_residuals_below_the_floor_count_as_the_floor() -> None:
    rays, points, rotation = planted(np.random.default_rng(5), 6, 0.0)
    assert evidence(rays, points, rotation, 5e-3) > evidence(rays, points, rotation, 1e-4) + 3


@pytest.mark.parametrize("pairs", [0, 32])
def test_an_image_point_whose_label_no_scene_point_has_is_an_outlier(
    pairs: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its evidence is that of a point without a near correspondence, log(1 - w), however the density is measured."""
    monkeypatch.setattr(problem_module, "PAIRS_A_POINT", pairs)
    points = np.random.default_rng(3).uniform(-1, 1, (12, 3)) + [0, 0, 6]
    labels = np.arange(12)
    problem = Problem(directions(points), points, labels2d=np.r_[99, labels[1:]], labels3d=labels)
    for even in (True, False):
        with np.errstate(all="raise"):
            logs = point_evidence(problem, directions(points), np.array([1e-3]), np.array([0.75]), even=even)
        assert logs[0, 0, 0] == pytest.approx(math.log(0.25))
        assert (logs[1:] > 0).all()


def test_the_false_alarms_of_independent_cameras_multiply() -> None:
    """Two cameras that see the same: the evidence is that of one squared, with the matches that fix the pose left out
    in one of them; each match that is left out costs evidence."""
    rays, points, rotation = planted(np.random.default_rng(3), 30)
    problem = Problem(rays, points, floor=2e-4)
    terms = camera_terms(problem, directions_of(problem, rotation, SHIFT), 4e-4)
    assert terms is not None
    whole, without = (terms.evidence(count)[0] / math.log(10) for count in (0, 3))
    assert without < whole - 1
    assert log10_nfa([terms], 5.0, [[3]])[0] == pytest.approx(5 - without)
    assert log10_nfa([terms, terms], 5.0, [[3, 0], [0, 3]])[0] == pytest.approx(5 - whole - without)
    assert log10_nfa([terms, None], 5.0, [[3, 0], [0, 3]])[0] == pytest.approx(5 - without)
    assert log10_nfa([None], 5.0, [[3]]) == (5.0, 5.0)
