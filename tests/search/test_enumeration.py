import itertools
import math

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from planted import degrees_between, directions
from scipy.spatial.transform import Rotation

from bpnp.robust.minimal_solvers import p3p
from bpnp.runtime import Clock
from bpnp.search.enumeration.search import Enumerated, Enumeration, enumerate_poses
from bpnp.search.problem import Problem

Array = NDArray[np.float64]
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
