"""P3P in float64 on triangles whose depths are known in closed form."""

import numpy as np
import pytest

from bpnp.search.propose.minimal_solvers import p3p_poses


@pytest.mark.parametrize("along", [1.2, 1.5, 2.0, 3.0, 6.0])
def test_an_equilateral_triangle_seen_along_its_axis_has_all_its_poses(along: float) -> None:
    """Rays at equal angles, with |f_i - f_j|^2 = c, the depths for unit sides are d = 1/sqrt(c), and those where
    one of them is (1 - c) d if that is positive."""
    rays = np.full((3, 3), 1.0) + (along - 1) * np.eye(3)
    unit = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    chord = ((unit[0] - unit[1]) ** 2).sum()
    points = np.eye(3)  # sides of sqrt(2)
    poses = p3p_poses(rays[None], points[None])[0]
    poses = poses[np.isfinite(poses).all((1, 2))]
    rotation, translation = poses[:, :3], poses[:, 3]
    camera = points @ rotation.transpose(0, 2, 1) + translation[:, None]
    depth = np.linalg.norm(camera, axis=-1)
    np.testing.assert_allclose(camera, depth[..., None] * unit, atol=1e-9)
    expected = np.sqrt(2 / chord) * (np.ones((4, 3)) - chord * np.eye(4, 3))
    expected = expected[(expected > 0).all(1)]
    assert len(expected) == (1 if chord > 1 else 4)
    order = np.lexsort(np.round(depth, 6).T), np.lexsort(np.round(expected, 6).T)
    np.testing.assert_allclose(depth[order[0]], expected[order[1]], rtol=1e-6)
