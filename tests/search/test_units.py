"""Results do not depend on the unit of the scene, on the size of labels, on the resolution, or on the field of view."""

from typing import Any

import numpy as np
import pytest
from planted import degrees_between
from scipy.spatial.transform import Rotation

from bpnp import solve
from bpnp.search.problem import Problem
from bpnp.search.verdict.uncertainty import linearised, systematic_misfit


def view(focal: float, noise: float, count: int = 90) -> Any:
    """Return points, their pixels with noise (pixels), and the planted pose."""
    rng = np.random.default_rng(5)
    points, rotation = rng.uniform(-1, 1, (count, 3)), Rotation.random(random_state=5).as_matrix()
    camera = points @ rotation.T + [0.1, -0.05, 5.0]
    image = focal * camera[:, :2] / camera[:, 2:] + noise * rng.standard_normal((count, 2))
    return points, image, rotation


@pytest.mark.nightly
@pytest.mark.parametrize("unit", [1e-9, 1e6, 1e9])
def test_a_wrong_camera_is_noticed_in_any_unit(unit: float) -> None:
    """The misfit of a focal length 15 % off, as a law of the residuals and as a verdict."""
    points, image, rotation = view(800.0, 0.8)
    rays = np.column_stack([image / 920, np.ones(len(image))])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    translation = np.array([0.1, -0.05, 5.75])
    both = [
        systematic_misfit(linearised(Problem(rays, u * points), rotation, u * translation, 2e-3), 90.0)
        for u in (1.0, unit)
    ]
    assert both[0].zoom != 1
    assert both[1] == pytest.approx(both[0], rel=1e-4)
    camera = np.diag([920.0, 920, 1])
    verdicts = {u: solve(image, u * points, camera, solver="search", time_limit=60).verdict for u in (1.0, unit)}
    assert verdicts == dict.fromkeys(verdicts, "ambiguous")
    found = solve(image, unit * points, camera, focal_error=0.15, solver="search", time_limit=120)
    assert abs(found.focal_length - 800) < 4 * found.focal_length_std < 40


def test_labels_may_be_any_integers() -> None:
    points, image, rotation = view(1.0, 1e-3)
    labels = np.arange(90) % 2
    small, *large = (
        solve(image, points, labels2d=labels * by, labels3d=labels * by, solver="search", time_limit=60)
        for by in (1, 2**32 - 1, 5 + 2**40)
    )
    for solution in large:
        np.testing.assert_array_equal(solution.rotation, small.rotation)
        np.testing.assert_array_equal(solution.matches, small.matches)
    assert degrees_between(small.rotation, rotation) < 0.5


@pytest.mark.parametrize("focal", [800.0, 8000.0])
def test_subpixel_noise_is_estimated_at_any_resolution(focal: float) -> None:
    points, image, rotation = view(focal, 0.3)
    solution = solve(image, points, np.diag([focal, focal, 1]), solver="search", time_limit=60)
    assert solution.inlier_threshold == pytest.approx(3 * 0.3, rel=0.35)
    off = Rotation.from_matrix(rotation @ solution.rotation.T).as_rotvec()
    assert 0.05 < off @ np.linalg.solve(solution.covariance[:3, :3], off) / 3 < 4


@pytest.mark.slow
def test_bearings_all_around_the_camera_are_searched() -> None:
    for seed in range(4):
        rng = np.random.default_rng(seed)
        bearings = rng.standard_normal((200, 3))
        bearings /= np.linalg.norm(bearings, axis=1, keepdims=True)
        rotation, translation = Rotation.random(random_state=seed).as_matrix(), np.array([0.1, -0.2, 0.3])
        points = (bearings * rng.uniform(2, 6, (200, 1)) - translation) @ rotation
        bearings += 1e-3 * rng.standard_normal(bearings.shape)
        bearings /= np.linalg.norm(bearings, axis=1, keepdims=True)
        solution = solve(rng.permutation(bearings), points, solver="search", time_limit=60)
        assert solution.verdict == "confident"
        assert degrees_between(solution.rotation, rotation) < 0.1
        assert np.linalg.norm(solution.translation - translation) < 0.05
