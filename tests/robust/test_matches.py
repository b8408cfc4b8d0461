"""A RANSAC that is not misled from behind."""

import numpy as np
import pytest
import torch
from planted import plant

from bpnp.geometry import rotation_angle
from bpnp.layers import ransac_pnp

THRESHOLD = 0.01


@pytest.mark.parametrize("backend", ["poselib", "torch"])
def test_points_behind_the_camera_are_no_inliers(backend: str) -> None:
    """Every other 3D point is put where it is seen from behind, in the same place of the image."""
    planted = plant(1, 400, noise=0.001, seed=4)
    camera = planted.points3d @ planted.rotation.mT + planted.translation
    camera[:, ::2] *= -1
    points3d = (camera - planted.translation.unsqueeze(1)) @ planted.rotation
    rotation, translation, stats = ransac_pnp(
        planted.permutation(), planted.points2d, points3d, backend=backend, matches_factor=1.0, threshold=THRESHOLD
    )
    assert rotation_angle(rotation, planted.rotation) < np.deg2rad(1)
    camera = points3d @ rotation.mT + translation
    distance = (camera[..., :2] / camera[..., 2:] - planted.points2d[:, planted.match3d[0]]).norm(dim=-1)[0]
    assert (distance[::2] < THRESHOLD).any()
    front = distance[1::2]
    torch.testing.assert_close(stats.residual[0], front[front < THRESHOLD].mean())
