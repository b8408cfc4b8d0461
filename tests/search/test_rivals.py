"""A wrong camera is met by a search for the focal length and named by the verdict."""

import re

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from bpnp import solve
from bpnp.search.evidence.rivals import at_focal_length, near_focal_length
from bpnp.search.point_sets import PointSets
from bpnp.search.scene import Scene
from bpnp.search.settings import DEFAULT

FOCAL = 800.0


def seen(rng: np.random.Generator) -> tuple[NDArray[np.float64], NDArray[np.float64], Rotation, NDArray[np.float64]]:
    """Pixels (240, 2) of half of the points (240, 3), with a noise of a pixel, and as many others; the pose."""
    points = rng.uniform(-1, 1, (240, 3)) * (1, 1, 0.5)
    turn, shift = Rotation.from_rotvec(0.5 * rng.standard_normal(3)), np.array([0, 0, 3.0])
    camera = turn.apply(points[:120]) + shift
    pixels = FOCAL * camera[:, :2] / camera[:, 2:] + rng.standard_normal((120, 2))
    return np.r_[pixels, rng.uniform(pixels.min(0), pixels.max(0), (120, 2))], points, turn, shift


@pytest.mark.parametrize(("zoom", "near"), [(1.35, 1.37), (0.75, 0.73), (1.08, 1.11)])
def test_annealing_meets_the_pose_at_another_focal_length(zoom: float, near: float) -> None:
    pixels, points, turn, shift = seen(np.random.default_rng(1))
    rays = np.column_stack([zoom * pixels / FOCAL, np.ones(len(pixels))])  # as if of a camera 1 / zoom as long
    sets = PointSets(rays / np.linalg.norm(rays, axis=-1, keepdims=True), points)
    off = Rotation.from_rotvec(np.radians([1, -1, 2])) * turn
    middle = turn.apply(np.median(points, 0)) + shift
    scene = Scene(sets, 0, DEFAULT)
    _, _, found = near_focal_length(sets, off.as_matrix(), middle / (1, 1, zoom), near, 1 / FOCAL, scene)
    assert found.log10_false_alarms[0] < -50
    assert np.degrees((Rotation.from_matrix(found.rotation[0]) * turn.inv()).magnitude()) < 1
    seen_at = found.rotation[0] @ np.median(points, 0) + found.translation[0]
    assert np.linalg.norm(seen_at - middle) < 0.06 * np.linalg.norm(middle)


def test_the_same_points_with_another_focal_length_are_those_of_another_camera() -> None:
    pixels, points, _, _ = seen(np.random.default_rng(2))
    one, other = (np.column_stack([pixels / focal, np.ones(len(pixels))]) for focal in (FOCAL, 1.3 * FOCAL))
    unit = one / np.linalg.norm(one, axis=-1, keepdims=True)
    expected = other / np.linalg.norm(other, axis=-1, keepdims=True)
    np.testing.assert_allclose(at_focal_length(PointSets(unit, points), 1.3).bearings, expected, atol=1e-12)


@pytest.mark.parametrize("seed", [1, 2])
def test_the_verdict_names_a_wrong_focal_length(seed: int) -> None:
    pixels, points, turn, shift = seen(np.random.default_rng(seed))
    right, wrong = (solve(pixels, points, np.diag([focal, focal, 1])) for focal in (FOCAL, 1.25 * FOCAL))
    assert right.verdict == "confident"
    assert np.linalg.norm(right.translation - shift) < 0.05
    assert wrong.verdict == "ambiguous"
    named = re.search(r"with ([\d.]+) times the focal length", wrong.reason)
    assert named is not None
    assert float(named[1]) == pytest.approx(0.8, rel=0.03)
