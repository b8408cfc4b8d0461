"""Scenes with most of their points on a line, such as a strip of lights: planted poses against rotated ones."""

import math

import numpy as np
import pytest
from planted import degrees_between, directions
from scipy.spatial.transform import Rotation

import bpnp
from bpnp.arrays import Array
from bpnp.search.problem import Problem
from bpnp.search.propose.collinear import find_line, rotations_about

FOCAL = 800.0


def strip(rng: np.random.Generator, on_line: int, others: int) -> Array:
    """Return random points on a line, and others around it."""
    line = np.outer(rng.uniform(-1, 1, on_line), [1, 0.3, 0.2])
    return np.concatenate([line, rng.uniform(-1, 1, (others, 3))])


@pytest.mark.slow
def test_confident_poses_of_a_strip_are_those_planted() -> None:
    """Of 20 or 40 points on a line and 3 to 6 others, a tenth is hidden. The rotation about the line depends on a few
    points."""
    camera, confident = np.array([[FOCAL, 0, 640], [0, FOCAL, 480], [0, 0, 1]]), 0
    for seed in range(12):
        rng = np.random.default_rng([5, seed])
        points = strip(rng, int(rng.choice([20, 40])), int(rng.choice([3, 4, 6])))
        rotation = Rotation.random(rng=rng).as_matrix()
        seen = points[rng.random(len(points)) < 0.9] @ rotation.T + [0, 0, rng.uniform(4, 6)]
        pixels = seen[:, :2] / seen[:, 2:] * FOCAL + [640, 480] + 0.5 * rng.standard_normal((len(seen), 2))
        solution = bpnp.solve(rng.permutation(pixels), points, camera, seed=seed, time_limit=math.inf)
        if solution.verdict == "confident":
            confident += 1
            assert degrees_between(solution.rotation, rotation) < 3, (seed, solution.reason)
    assert confident >= 7


@pytest.mark.parametrize("seed", range(4))
def test_the_rotation_about_the_line_is_found(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points = strip(rng, 15, 5)
    line = find_line(points)
    assert line is not None
    true, distance = Rotation.random(rng=rng).as_matrix(), np.array([0.1, -0.2, 6.0])
    problem = Problem(directions(points @ true.T + distance), points)
    turn = Rotation.from_rotvec(rng.uniform(0.5, 5.5) * line.axis).as_matrix()
    rotation, translation = true @ turn, true @ (line.point - turn @ line.point) + distance
    rotations, translations = rotations_about(problem, rotation, translation, line, 1e-4)
    assert degrees_between(rotations[0], true) < 1
    np.testing.assert_allclose(rotations @ line.point + translations, [true @ line.point + distance] * len(rotations))


def test_the_line_of_many_points_is_found() -> None:
    """Of 5,000 points, 3,000 lie on a line."""
    points = strip(np.random.default_rng(1), 3000, 2000)
    line = find_line(points)
    assert line is not None
    assert line.distances(points[:3000]).max() < 1e-9
    np.testing.assert_allclose(abs(line.axis), np.array([1, 0.3, 0.2]) / np.linalg.norm([1, 0.3, 0.2]))


def test_a_cloud_has_no_line() -> None:
    points = np.random.default_rng(0).uniform(-1, 1, (60, 3))
    assert find_line(points) is None
    assert find_line(np.ones((8, 3))) is None
