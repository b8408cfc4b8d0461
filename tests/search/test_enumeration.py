import itertools
import math
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from planted import degrees_between, directions
from scipy.spatial.transform import Rotation

import bpnp
from bpnp.arrays import Array
from bpnp.layers.ransac.minimal_solvers import p3p
from bpnp.runtime import Clock
from bpnp.search.few_points import enumeration
from bpnp.search.few_points.enumeration import Enumerated, Enumeration, Stage, enumerate_poses
from bpnp.search.few_points.hypotheses import VISITED_PAIRS
from bpnp.search.few_points.points import ImageSide
from bpnp.search.problem import Problem
from bpnp.search.starts import PosePrior

RADIUS = 2e-3
NOISE = 4e-4


def planted(
    rng: np.random.Generator, seen: int, *, hidden: int = 0, background: int = 0, noise: float = NOISE
) -> tuple[Array, Array, Array, Array, NDArray[np.int64]]:
    """Bearings, points, pose, and the point of each bearing (-1): points within a ball, 4 to 6 radii away."""
    points = rng.uniform(-1, 1, (seen + hidden, 3))
    rotation, translation = Rotation.random(random_state=rng.integers(2**31)).as_matrix(), rng.uniform(-1, 1, 3)
    translation[2] += 5
    rays = directions(points[:seen] @ rotation.T + translation) + noise * rng.standard_normal((seen, 3))
    lights = directions(np.column_stack([rng.uniform(-0.4, 0.4, (background, 2)), np.ones(background)]))
    order = rng.permutation(seen + background)
    match = np.concatenate([np.arange(seen), np.full(background, -1)])[order]
    return directions(np.concatenate([rays, lights]))[order], points, rotation, translation, match


def solved(rays: Array, points: Array, *, to_the_end: bool = False) -> Enumerated:
    return enumerate_poses(Problem.of(rays, points), radius=RADIUS, to_the_end=to_the_end)


@pytest.mark.parametrize(("seen", "hidden", "background"), [(4, 0, 0), (5, 0, 0), (6, 0, 3), (8, 6, 4), (12, 6, 5)])
def test_planted_poses_are_found(seen: int, hidden: int, background: int) -> None:
    found = 0
    for seed in range(10):
        rays, points, rotation, translation, match = planted(
            np.random.default_rng(seed), seen, hidden=hidden, background=background
        )
        poses = solved(rays, points).poses
        errors = [degrees_between(r, rotation) for r in poses.rotation]
        assert min(errors) < 3
        found += errors[0] < 3
        if errors[0] < 3 and seen > 5:
            _, found_translation = Problem.of(rays, points).to_user(poses.rotation[0], poses.translation[0])
            assert np.linalg.norm(found_translation - translation) < 0.3
            assert (poses.matches[0] == match).mean() > 0.85
    assert found >= (10 if seen > 5 else 4)  # four points and noise leave other poses as good


def brute_force(rays: Array, points: Array, radius: float) -> int:
    """Most one-to-one matches of any pose that P3P gives for any three pairs."""
    triples = list(itertools.product(itertools.combinations(range(len(rays)), 3), itertools.permutations(range(5), 3)))
    rows, columns = (np.array(side) for side in zip(*triples, strict=True))
    solution = p3p(torch.tensor(rays[rows]), torch.tensor(points[columns]))
    rotation, translation = solution.rotation[solution.valid].numpy(), solution.translation[solution.valid].numpy()
    seen = directions(points @ rotation.transpose(0, 2, 1) + translation[:, None])
    near = np.linalg.norm(rays[:, None] - seen[:, None], axis=-1) < radius
    return int(near.any(2).sum(1).max())


@pytest.mark.parametrize("seed", range(4))
def test_small_problems_are_exhausted(seed: int) -> None:
    """On exact points with one stray, the enumeration matches as many as trying everything does."""
    rng = np.random.default_rng(seed)
    rays, points, rotation, _, _ = planted(rng, 5, background=1, noise=0.0)
    poses, ended = solved(rays, points, to_the_end=True)
    assert ended == "exhausted"
    matches = (poses.residual <= 1e-6).sum(-1)
    assert matches.max() == brute_force(rays, points, 1e-6) == 5
    assert degrees_between(poses.rotation[matches.argmax()], rotation) < 1e-3
    assert enumerate_poses(Problem.of(rays, points), radius=RADIUS, deadline=Clock.now()).ended == "interrupted"


def test_an_image_point_opposite_to_the_mean_bearing_is_matched() -> None:
    """The stereographic coordinates about the mean bearing have no place for the opposite direction."""
    rng = np.random.default_rng(0)
    rays = directions(rng.standard_normal((7, 3)) + [0, 0, 1])
    rays = np.concatenate([rays, directions(-rays.sum(0, keepdims=True))])
    poses = solved(rays, rays * rng.uniform(2, 3, (8, 1))).poses
    assert degrees_between(poses.rotation[0], np.eye(3)) < 1e-3
    assert poses.matches[0].tolist() == list(range(8))
    assert poses.evidence[0] > 0


@pytest.mark.parametrize(("count", "most"), [(12, 4), (100, 2)])
def test_a_camera_that_sees_all_around_has_chance_matches_in_the_whole_sphere(count: int, most: int) -> None:
    """A cap of the radius r is the fraction (1 - cos r) / 2 of the sphere; few points do not reach all its sides."""
    images = (directions(np.random.default_rng([k, count]).standard_normal((count, 3))) for k in range(40))
    densities = np.array([ImageSide(image, RADIUS, None, 2.0).density for image in images])
    ratio = densities / ((1 - math.cos(RADIUS)) / 2)
    assert 0.5 < np.median(ratio) < most
    assert ratio.max() < 2 * most


@pytest.fixture
def short_sweeps(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ten hypotheses between checks of the best pose."""
    monkeypatch.setattr(enumeration, "HYPOTHESES_A_SWEEP", 10)
    monkeypatch.setattr(enumeration, "HYPOTHESES_A_LOOK", 10)


class Sweeps:
    """Calls of the compiled loop: its arguments and what it returns."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.calls: list[tuple[Any, Any]] = []
        self.explore = enumeration.explore
        monkeypatch.setattr(enumeration, "explore", self)

    def __call__(self, *arguments: Any) -> Any:
        self.calls.append((arguments, self.explore(*arguments)))
        return self.calls[-1][1]


def labelled(count: int, first: int) -> Enumeration:
    """Unrelated points, the image points with labels from 0 and the scene points from `first`, each label once."""
    rng = np.random.default_rng(0)
    rays = directions(rng.standard_normal((count, 3)) * [0.3, 0.3, 0] + [0, 0, 1])
    labels = first + rng.permutation(count)
    problem = Problem.of(rays, rng.uniform(-1, 1, (count, 3)), labels2d=np.arange(count), labels3d=labels)
    stage = Stage(3, count - 1, count - 1, 0.5)
    return Enumeration(problem, RADIUS, stages=[stage])


@pytest.mark.usefixtures("short_sweeps")
def test_pairs_whose_labels_differ_end_a_sweep_too(monkeypatch: pytest.MonkeyPatch) -> None:
    """One hypothesis fits each of the C(14, 3) sets of image points.

    A fourteenth of the 6 C(14, 3) pairs with sets of the scene have the same label at their first points.
    """
    run, sweeps, sets = labelled(14, 0), Sweeps(monkeypatch), math.comb(14, 3)
    while run.advance(math.inf):
        pass
    assert run.ended == "exhausted"
    ends = [end for arguments, end in sweeps.calls if arguments[2] > 0]
    assert sum(visited for *_, visited in ends) == 6 * sets**2 // 14
    assert max(visited for *_, visited in ends) <= 10 * VISITED_PAIRS
    assert sum(solved for _, _, solved, _ in ends) == run.solved == sets


@pytest.mark.usefixtures("short_sweeps")
@pytest.mark.parametrize(("any2d", "any3d"), [(0, 0), (2, 0), (0, 2), (2, 2)])
def test_every_hypothesis_whose_labels_fit_is_solved_once(any2d: int, any3d: int) -> None:
    """Two labels on each side, and points that fit any; two stages, of which the second adds the sets of the rest."""
    count, rng = 9, np.random.default_rng(3)
    rays = directions(rng.standard_normal((count, 3)) * [0.3, 0.3, 0] + [0, 0, 1])
    labels2d, labels3d = np.arange(count) % 2, rng.permutation(count) % 2
    labels2d[:any2d], labels3d[:any3d] = -1, -1
    problem = Problem.of(rays, rng.uniform(-1, 1, (count, 3)), labels2d=labels2d, labels3d=labels3d)
    stages = Stage(3, 4, 4, 0.5), Stage(3, count - 1, count - 1, 0.5)
    run = Enumeration(problem, RADIUS, stages=stages)
    while run.advance(math.inf):
        pass
    fitting = (labels2d[:, None] == labels3d) | (labels2d[:, None] < 0) | (labels3d < 0)
    expected = sum(
        bool(fitting[seen, chosen].all())
        for seen in itertools.combinations(range(count), 3)
        for chosen in itertools.permutations(range(count), 3)
    )
    assert run.ended == "exhausted"
    assert run.solved == expected


@pytest.mark.usefixtures("short_sweeps")
def test_image_points_without_a_fitting_label_take_part_in_no_hypothesis(monkeypatch: pytest.MonkeyPatch) -> None:
    """Three image points have labels of the scene: one set, in 6 orders, each of them first in two."""
    for fitting in (0, 3):
        run, sweeps = labelled(14, 14 - fitting), Sweeps(monkeypatch)
        while run.advance(math.inf):
            pass
        assert run.ended == "exhausted"
        firsts = run.scene.arrays.labels[run.scene.triangles(3, 13).triples[:, 0]]
        visited = sum(end[3] for arguments, end in sweeps.calls if arguments[2] > 0)
        assert visited == 2 * (firsts < 14).sum()


@pytest.mark.parametrize(("sigmas", "is_found"), [(3.8, True), (4.2, False)])
def test_no_pose_beyond_four_standard_deviations_of_a_prior_rotation_is_tried(sigmas: float, is_found: bool) -> None:
    rays, points, rotation, _, _ = planted(np.random.default_rng(0), 8, noise=0.0)
    turned = Rotation.from_rotvec(math.radians(2 * sigmas) * np.array([0.6, 0, 0.8])).as_matrix() @ rotation
    problem = Problem.of(rays, points, prior=PosePrior(turned, None, 2.0))
    poses = enumerate_poses(problem, radius=RADIUS).poses
    assert any(degrees_between(each, rotation) < 0.2 for each in poses.rotation) == is_found


@pytest.mark.usefixtures("short_sweeps")
def test_a_clock_that_stands_still_ends_no_enumeration(monkeypatch: pytest.MonkeyPatch) -> None:
    rays, points, rotation, _, _ = planted(np.random.default_rng(0), 8, noise=0.0)
    monkeypatch.setattr(Clock, "now", classmethod(lambda cls: 0.0))
    run = Enumeration(Problem.of(rays, points), RADIUS)
    while run.advance(1e3):
        pass
    assert degrees_between(run.poses().rotation[0], rotation) < 0.1


@pytest.mark.parametrize("basin_count", [1, 3])
def test_a_better_pose_is_missed_as_rarely_as_basin_counts_predict(basin_count: int) -> None:
    """Counted on objects of equal parts and a few unique points, without competitors: of partial enumerations that end
    when the best pose has the basin count h, at most 2^-h end at a turned pose."""
    wrong = 0
    for k in range(40):
        rng = np.random.default_rng([k, basin_count])
        part = rng.uniform(-1, 1, (7, 3))
        turns = Rotation.from_rotvec([[0, 0, 2 * np.pi * i / 3] for i in range(3)]).as_matrix()
        points = np.concatenate([*(part @ turn.T for turn in turns), rng.uniform(-1, 1, (3, 3))])
        rotation = Rotation.random(random_state=rng).as_matrix()
        camera = points @ rotation.T + [0, 0, 5]
        rays = rng.permutation(camera / np.linalg.norm(camera, axis=1, keepdims=True))
        problem = Problem.of(rays, points)
        run = Enumeration(problem, problem.match_radius)
        while run.advance(math.inf) and run.poses().basin_count[0] < basin_count:
            pass
        poses = run.poses()
        assert run.ended is None  # not every triple was tried
        assert poses.basin_count[0] >= basin_count
        wrong += degrees_between(poses.rotation[0], rotation) > 3
    assert wrong <= 40 * 0.5**basin_count


def test_a_confident_pose_is_not_that_of_the_smaller_of_two_bodies() -> None:
    """Of one scene, 24 points and 18 others move on their own between the scene and the image."""
    confident = 0
    for seed in range(10):
        rng = np.random.default_rng([2, seed])
        bodies = rng.uniform(-1, 1, (24, 3)), rng.uniform(-1, 1, (18, 3))
        rotations = Rotation.random(2, rng=rng).as_matrix()
        seen = np.concatenate([body @ turn.T + [0, 0, 5] for body, turn in zip(bodies, rotations, strict=True)])
        image = rng.permutation(seen[:, :2] / seen[:, 2:] + 6e-4 * rng.standard_normal((42, 2)))
        solution = bpnp.solve(image, rng.permutation(np.concatenate(bodies)), seed=seed, time_limit=math.inf)
        if solution.verdict == "confident":
            confident += 1
            assert degrees_between(solution.rotation, rotations[0]) < 1, (seed, solution.reason)
    assert confident >= 8
