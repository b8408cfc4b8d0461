"""Scores and inliers of a pose, counted one match after the other; and a RANSAC that is not misled from behind."""

import numpy as np
import pytest
import torch
from planted import plant

from bpnp.geometry import rotation_angle
from bpnp.layers import ransac_pnp
from bpnp.robust.matches import Matches, residuals, truncated_scores

THRESHOLD = 0.01


def test_a_score_is_the_sum_of_truncated_errors() -> None:
    planted = plant(2, 40, noise=0.004, seed=1)
    seen = planted.points2d.gather(1, planted.match3d.unsqueeze(-1).expand(-1, -1, 2))
    matches = Matches(seen, planted.points3d, torch.rand(2, 40, generator=torch.Generator().manual_seed(0)) < 0.8)
    rotation, translation = planted.near(0.5, seed=1)  # some points are behind this camera
    poses = torch.stack(
        [torch.cat([r, t.unsqueeze(-1)], -1) for r, t in (planted.pose, (rotation, translation - 5))], 1
    )
    scores = truncated_scores(poses, matches, THRESHOLD**2)
    for b in range(2):
        for c in range(2):
            expected, inliers = 0.0, []
            for x, p, real in zip(*(values[b].numpy() for values in matches), strict=True):
                camera = poses[b, c, :, :3].numpy() @ p + poses[b, c, :, 3].numpy()
                error = ((camera[:2] / camera[2] - x) ** 2).sum() if camera[2] > 0 else np.inf
                expected += real * min(error, THRESHOLD**2)
                inliers.append(bool(real and error < THRESHOLD**2))
            assert abs(float(scores[b, c]) - expected) < 1e-6
            assert residuals(poses, matches, THRESHOLD**2).inlier[b, c].tolist() == inliers
    assert (scores[:, 0] < 0.7 * scores[:, 1]).all()


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
