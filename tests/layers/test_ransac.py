import pytest
import torch
from planted import Planted, plant
from torch import Tensor

from bpnp.geometry import project, rotation_angle, transform
from bpnp.layers import ransac_pnp

THRESHOLD = 0.01


def wrong_pairs(planted: Planted, share: float, *, seed: int = 0) -> Tensor:
    """An assignment whose most probable pairs, one a 3D point, are wrong for a `share` of the points."""
    generator = torch.Generator().manual_seed(seed)
    b, n = planted.match3d.shape
    match = planted.match3d.clone()
    wrong = torch.rand(b, n, generator=generator).argsort(-1)[:, : round(share * n)]
    match.scatter_(1, wrong, match.gather(1, wrong.roll(1, -1)))
    assignment = 0.01 * torch.rand(b, n, n, generator=generator, dtype=torch.float64)
    return assignment.scatter_(1, match.unsqueeze(1), 1 + torch.rand(b, 1, n, generator=generator).double())


@pytest.mark.parametrize(("backend", "share"), [("poselib", 0.6), ("opencv", 0.3)])
def test_finds_a_planted_pose_among_wrong_pairs(backend: str, share: float) -> None:
    planted = plant(8, 80, noise=0.001, seed=1)
    assignment = wrong_pairs(planted, share)
    r, t, stats = ransac_pnp(assignment, planted.points2d, planted.points3d, backend=backend)
    assert stats.converged.all()
    assert torch.rad2deg(rotation_angle(r, planted.rotation)).max() < 1
    assert (t - planted.translation).norm(dim=-1).max() < 0.1
    assert stats.residual.max() < THRESHOLD


@pytest.mark.parametrize("backend", ["poselib", "opencv"])
@pytest.mark.parametrize("kind", ["three pairs", "one place", "collinear", "no agreement", "nothing finite"])
def test_without_four_inliers_there_is_no_pose(backend: str, kind: str) -> None:
    planted = plant(3, 12, seed=4)
    assignment, points2d, points3d = planted.permutation(), planted.points2d.clone(), planted.points3d.clone()
    mask2d = torch.ones(3, 12, dtype=torch.bool)
    if kind == "three pairs":
        mask2d[0, 3:] = False
    elif kind == "one place":
        points3d[0] = 0.5
    elif kind == "collinear":
        points3d[0, :, 1:] = 0
    elif kind == "nothing finite":
        points2d[0] = torch.nan
    else:
        points2d[0] = torch.randn(12, 2, generator=torch.Generator().manual_seed(0)).double()
    r, t, stats = ransac_pnp(
        assignment, points2d, points3d, mask2d=mask2d, backend=backend, matches_factor=1.0, threshold=1e-6
    )
    assert stats.converged.tolist() == [False, True, True]
    assert r[0].isnan().all()
    assert t[0].isnan().all()
    assert stats.residual[0] == torch.inf
    tried = kind not in ("three pairs", "nothing finite")  # what was tried counts, whatever came of it
    assert (stats.iterations[0] > 0) == tried
    assert rotation_angle(r[1:], planted.rotation[1:]).max() < 1e-5


@pytest.mark.parametrize("backend", ["poselib", "opencv"])
def test_points_of_one_plane_are_no_trap(backend: str) -> None:
    planted = plant(12, 60, seed=6)
    points3d = planted.points3d * torch.tensor([1.0, 1.0, 0.0]).double()
    seen = project(transform(planted.rotation, planted.translation, points3d))
    generator = torch.Generator().manual_seed(0)
    seen = seen + 0.001 * torch.randn(seen.shape, generator=generator, dtype=torch.float64)
    points2d = torch.empty_like(seen).scatter_(1, planted.match3d.unsqueeze(-1).expand_as(seen), seen)
    r, _, stats = ransac_pnp(wrong_pairs(planted, 0.2), points2d, points3d, backend=backend, matches_factor=1.0)
    assert stats.converged.all()
    assert torch.rad2deg(rotation_angle(r, planted.rotation)).max() < 2


@pytest.mark.parametrize("backend", ["poselib", "opencv"])
def test_a_seed_gives_the_same_pose_again(backend: str) -> None:
    planted = plant(2, 40, noise=0.005, seed=6)
    assignment = wrong_pairs(planted, 0.4)
    first = ransac_pnp(assignment, planted.points2d, planted.points3d, backend=backend, seed=3)
    torch.manual_seed(1)
    second = ransac_pnp(assignment, planted.points2d, planted.points3d, backend=backend, seed=3)
    assert torch.equal(first[0], second[0])
    assert torch.equal(first[1], second[1])
