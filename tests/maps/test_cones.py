"""Cones from which points of a map are seen, on planted tracks."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bpnp.maps.views import MARGIN_DEG, viewing_cones
from bpnp.search.point_sets import faces


def around(axis: np.ndarray, degrees: float, count: int = 8) -> np.ndarray:
    """Directions that make an angle with an axis, evenly about it."""
    side = np.linalg.svd(axis[None])[2][1]
    tilted = Rotation.from_rotvec(np.radians(degrees) * np.cross(axis, side)).apply(axis)
    turns = 2 * np.pi * np.arange(count) / count
    return np.asarray(Rotation.from_rotvec(turns[:, None] * axis).apply(tilted))


@pytest.mark.parametrize("degrees", [0.0, 12.0, 40.0])
def test_the_cone_holds_the_cameras_of_the_track_and_a_margin(degrees: float) -> None:
    rng = np.random.default_rng(0)
    points = rng.normal(size=(3, 3))
    axis = np.array([0.6, 0.0, 0.8])
    centres = points[1] + 4 * around(axis, degrees)
    axes, cosines = viewing_cones(points, [(centre, np.array([1])) for centre in centres])
    np.testing.assert_allclose(axes[1], axis, atol=1e-9)
    assert np.degrees(np.arccos(cosines[1])) == pytest.approx(degrees + MARGIN_DEG, abs=1e-6)
    for off, seen in ((degrees + MARGIN_DEG - 1, True), (degrees + MARGIN_DEG + 1, False)):
        for direction in around(axis, off):
            camera = points[[1]] - (points[1] + 2 * direction)  # R = I
            assert faces(axes[[1]], cosines[[1]], camera, np.eye(3))[0] == seen


def test_a_point_is_seen_from_both_sides_of_its_track_and_one_without_a_track_from_everywhere() -> None:
    points = np.zeros((2, 3))
    axes, cosines = viewing_cones(points, [(x, np.array([0])) for x in np.array([[1.0, 0, 0.1], [-1.0, 0, 0.1]])])
    assert cosines[0] == pytest.approx(np.cos(np.pi / 2 - np.arctan(0.1) + np.radians(MARGIN_DEG)))
    assert cosines[1] == -1
    np.testing.assert_allclose(np.linalg.norm(axes, axis=1), 1)
