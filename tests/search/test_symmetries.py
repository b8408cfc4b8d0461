import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bpnp import solve
from bpnp.search.enumeration.symmetries import near_symmetries

CAMERA = np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]])


def prism(corners: int, displaced: float, rng: np.random.Generator) -> np.ndarray:
    """Two regular rings, the lower one smaller: it comes onto itself by turns about its axis alone."""
    angle = 2 * np.pi * np.arange(corners) / corners
    ring = np.column_stack([np.cos(angle), np.sin(angle), np.full(corners, 0.4)])
    points = np.concatenate([ring, ring * (0.8, 0.8, -1)])
    return points + displaced * rng.standard_normal(points.shape)


@pytest.mark.parametrize("displaced", [0.0, 0.01])
def test_the_turns_of_a_prism_are_found(displaced: float) -> None:
    rng = np.random.default_rng(0)
    turn, shift = Rotation.random(rng=rng).as_matrix(), np.array([5.0, -3, 2])
    motions = near_symmetries(7.0 * prism(6, displaced, rng) @ turn.T + shift)
    angles = sorted(np.degrees(Rotation.from_matrix(found).magnitude()) for found, _ in motions)
    np.testing.assert_allclose(angles, [60, 60, 120, 120, 180], atol=3)


def test_a_scattered_cloud_has_none_and_a_large_one_is_not_looked_at() -> None:
    rng = np.random.default_rng(1)
    assert near_symmetries(rng.normal(size=(20, 3))) == []
    assert near_symmetries(prism(40, 0.0, rng)) == []


@pytest.mark.parametrize("displaced", [0.0, 0.002, 0.01])
def test_a_twin_is_never_called_certain(displaced: float) -> None:
    """Of a nearly symmetric prism only one pose is right; of a symmetric one all turns fit, and all are returned."""
    rng = np.random.default_rng(2)
    for _ in range(6):
        points = prism(12, displaced, rng)
        rotation, translation = Rotation.random(rng=rng).as_matrix(), np.array([0.0, 0, 7])
        seen = (points @ rotation.T + translation) @ CAMERA.T
        pixels = seen[:, :2] / seen[:, 2:] + 0.3 * rng.standard_normal((len(seen), 2))
        found = solve(pixels, points, CAMERA)
        error = np.degrees(Rotation.from_matrix(found.rotation.T @ rotation).magnitude())
        assert found.verdict != "failed"
        assert error < 2 or found.verdict == "ambiguous"
        if displaced == 0:
            assert found.verdict == "ambiguous"
            assert len(found.candidates) > 1
