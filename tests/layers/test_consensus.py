"""The RANSAC of a whole batch against PoseLib's, among many wrong matches and points that repeat."""

import numpy as np
import pytest
import torch
from planted import plant, seen
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from bpnp.geometry import rotation_angle
from bpnp.layers import ransac_pnp
from bpnp.layers.ransac.matches import Matches, residuals, truncated_scores

THRESHOLD, MATCHES = 0.01, 600


@pytest.mark.parametrize(("inliers", "lead"), [(0.1, 2.0), (0.3, 2.0), (0.6, 2.0), (0.3, 0.0), (0.6, 0.0)])
def test_poses_and_scores_are_poselibs(inliers: float, lead: float) -> None:
    """Candidate matches in any order, a share of them true, and probabilities that favour these by a factor e^lead.

    The pose is the least-squares pose of its inliers, from which scipy does not move.
    """
    planted, generator = plant(3, 400, noise=0.0025, seed=0), torch.Generator().manual_seed(0)
    order = torch.rand(3, MATCHES, generator=generator).argsort(-1)
    true = order < round(inliers * MATCHES)
    other = torch.randint(1, 400, (3, MATCHES), generator=generator)
    scene = torch.where(true, order % 400, other)
    image = planted.match3d.gather(1, torch.where(true, scene, (scene + other.roll(1, -1)) % 400))
    points2d, points3d = (
        points.gather(1, index.unsqueeze(-1).expand(-1, -1, points.shape[-1]))
        for points, index in ((planted.points2d, image), (planted.points3d, scene))
    )
    # An assignment of each 2D point to the 3D point of the same index.
    weights = (torch.randn(3, MATCHES, generator=generator, dtype=torch.float64) + lead * true).exp()
    options = {"matches_factor": 1.0, "threshold": THRESHOLD, "max_iterations": 2048}
    ours, theirs = (
        ransac_pnp(torch.diag_embed(weights), points2d, points3d, backend=backend, **options)
        for backend in ("torch", "poselib")
    )
    poses = torch.stack([torch.cat([r, t.unsqueeze(-1)], -1) for r, t, _ in (ours, theirs)], 1)
    matches = Matches(points2d, points3d, torch.ones_like(true))
    scores = truncated_scores(poses, matches, THRESHOLD**2)
    assert (scores[:, 0] < 1.005 * scores[:, 1]).all()
    assert torch.rad2deg(rotation_angle(ours[0], theirs[0])).max() < 0.2
    assert torch.rad2deg(rotation_angle(ours[0], planted.rotation)).max() < 1
    _, inlier, *_ = residuals(poses[:, :1], matches, THRESHOLD**2)
    for b in range(3):
        image, scene = (points[b, inlier[b, 0]].numpy() for points in (points2d, points3d))
        pose = poses[b, 0].numpy()

        def errors(step: np.ndarray, pose=pose, image=image, scene=scene) -> np.ndarray:
            rotation = Rotation.from_rotvec(step[:3]).as_matrix() @ pose[:, :3]
            return (seen(scene, rotation, pose[:, 3] + step[3:]) - image).ravel()

        assert np.abs(least_squares(errors, np.zeros(6), method="lm").x).max() < 1e-5


def test_an_empty_batch_has_no_scores() -> None:
    matches = Matches(torch.zeros(0, 5, 2), torch.zeros(0, 5, 3), torch.zeros(0, 5, dtype=torch.bool))
    assert truncated_scores(torch.zeros(0, 7, 3, 4), matches, THRESHOLD**2).shape == (0, 7)
