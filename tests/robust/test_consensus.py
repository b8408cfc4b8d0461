"""The RANSAC of a whole batch against PoseLib's, among many wrong pairs and points that repeat."""

import numpy as np
import pytest
import torch
from planted import Planted, plant
from torch import Tensor

from bpnp.geometry import rotation_angle
from bpnp.layers import ransac_pnp
from bpnp.robust.consensus import Matches, truncated_scores
from bpnp.types import SolveStats

THRESHOLD = 0.01


def problem(
    seed: int, *, pairs: int = 600, inliers: float = 0.3, lead: float = 2.0, noise: float = 0.0025
) -> tuple[Planted, Matches, Tensor]:
    """Candidate pairs of 400 points in any order, a share of them true, and weights that favour these by `lead`."""
    planted, generator = plant(1, 400, noise=noise, seed=seed), torch.Generator().manual_seed(seed)
    order = torch.randperm(pairs, generator=generator)
    true = order < round(inliers * pairs)
    other = torch.randint(1, 400, (pairs,), generator=generator)
    second = torch.where(true, order % 400, other)
    first = torch.where(true, second, (second + other.roll(1)) % 400)
    weights = (torch.randn(pairs, generator=generator, dtype=torch.float64) + lead * true).exp()
    chosen = Matches(planted.points2d[:, planted.match3d[0, first]], planted.points3d[:, second], true.unsqueeze(0))
    return planted, chosen._replace(real=torch.ones(1, pairs, dtype=torch.bool)), weights.unsqueeze(0)


def consensus(
    pairs: Matches, weights: Tensor, *, backend: str = "torch", hypotheses: int = 2048
) -> tuple[Tensor, Tensor, SolveStats]:
    """The consensus of pairs (b, k): an assignment of each 2D point to the 3D point of the same index."""
    return ransac_pnp(
        torch.diag_embed(weights),
        *pairs[:2],
        mask2d=pairs.real,
        mask3d=pairs.real,
        matches_factor=1.0,
        backend=backend,
        threshold=THRESHOLD,
        max_iterations=hypotheses,
    )


def as_matrix(rotation: Tensor, translation: Tensor) -> Tensor:
    """[R | t] (b, 1, 3, 4)."""
    return torch.cat([rotation, translation.unsqueeze(-1)], -1).unsqueeze(1)


@pytest.mark.parametrize(("inliers", "lead"), [(0.1, 2.0), (0.3, 2.0), (0.6, 2.0), (0.3, 0.0), (0.6, 0.0)])
def test_pose_and_score_are_poselibs(inliers: float, lead: float) -> None:
    for seed in range(3):
        planted, pairs, weights = problem(seed, inliers=inliers, lead=lead)
        ours, theirs = (consensus(pairs, weights, backend=backend)[:2] for backend in ("torch", "poselib"))
        scores = [truncated_scores(as_matrix(*pose), pairs, THRESHOLD**2) for pose in (ours, theirs)]
        assert scores[0] < scores[1] * 1.005
        assert rotation_angle(ours[0], theirs[0]) < np.deg2rad(0.2)
        assert rotation_angle(ours[0], planted.rotation) < np.deg2rad(1)


def test_points_behind_the_camera_are_no_inliers() -> None:
    """Every other 3D point is put where it is seen from behind, in the same place of the image."""
    planted, pairs, weights = problem(4, inliers=0.6, noise=0.001)
    camera = pairs.points3d @ planted.rotation.mT + planted.translation
    camera[:, ::2] *= -1
    pairs = pairs._replace(points3d=(camera - planted.translation) @ planted.rotation)
    rotation, translation, stats = consensus(pairs, weights)
    assert rotation_angle(rotation, planted.rotation) < np.deg2rad(1)
    camera = pairs.points3d @ rotation.mT + translation
    distance = (camera[..., :2] / camera[..., 2:] - pairs.points2d).norm(dim=-1)[0]
    assert (distance[::2] < THRESHOLD).any()
    front = distance[1::2]
    torch.testing.assert_close(stats.residual[0], front[front < THRESHOLD].mean())
