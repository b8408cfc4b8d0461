import pytest
import torch
from planted import Planted, plant
from torch import Tensor

from bpnp.geometry import camera_centre, project, rotation_angle, transform
from bpnp.layers import RansacPnP, ransac_pnp
from bpnp.layers.ransac import top_matches

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


@pytest.mark.parametrize(("backend", "share"), [("poselib", 0.6), ("opencv", 0.3), ("torch", 0.3)])
def test_finds_a_planted_pose_among_wrong_pairs(backend: str, share: float) -> None:
    planted = plant(8, 80, noise=0.001, seed=1)
    assignment = wrong_pairs(planted, share)
    r, t, stats = ransac_pnp(assignment, planted.points2d, planted.points3d, backend=backend)
    assert stats.converged.all()
    assert torch.rad2deg(rotation_angle(r, planted.rotation)).max() < 1
    assert (t - planted.translation).norm(dim=-1).max() < 0.1
    assert stats.residual.max() < THRESHOLD


@pytest.mark.parametrize("backend", ["poselib", "opencv", "torch"])
def test_a_scene_far_from_its_origin_is_no_harder(backend: str) -> None:
    planted = plant(4, 40, noise=0.001, seed=2)
    assignment = wrong_pairs(planted, 0.2)
    r, t, _ = ransac_pnp(assignment, planted.points2d, planted.points3d, backend=backend)
    far_r, far_t, stats = ransac_pnp(assignment, planted.points2d, planted.points3d + 1e5, backend=backend)
    assert stats.converged.all()
    assert rotation_angle(far_r, r).max() < 1e-5
    assert (camera_centre(far_r, far_t) - 1e5 - camera_centre(r, t)).abs().max() < 1e-4


def test_the_residual_is_the_mean_error_of_the_inliers() -> None:
    planted = plant(5, 50, noise=0.003, seed=3)
    assignment = wrong_pairs(planted, 0.3)
    r, t, stats = ransac_pnp(assignment, planted.points2d, planted.points3d, pairs_factor=1.0)
    pairs = top_matches(assignment, pairs_factor=1.0)
    for i in range(5):
        seen = project(transform(r[i], t[i], planted.points3d[i, pairs.index3d[i]]))
        error = (seen - planted.points2d[i, pairs.index2d[i]]).norm(dim=-1)
        torch.testing.assert_close(error[error <= THRESHOLD].mean(), stats.residual[i])


def test_top_matches_are_the_largest_entries_of_each_sample() -> None:
    mask2d = torch.arange(6)[None] < torch.tensor([[6], [3], [1], [0]])
    mask3d = torch.arange(8)[None] < torch.tensor([[8], [5], [1], [2]])
    assignment = torch.rand(4, 6, 8)
    pairs = top_matches(assignment, mask2d=mask2d, mask3d=mask3d)
    assert pairs.mask.sum(-1).tolist() == [9, 4, 1, 0]  # 1.5 min(m, n), m n at most
    for i, (m, n) in enumerate([(6, 8), (3, 5), (1, 1)]):
        k = int(pairs.mask[i].sum())
        expected = assignment[i, :m, :n].flatten().sort(descending=True).values[:k]
        assert torch.equal(assignment[i, pairs.index2d[i, :k], pairs.index3d[i, :k]], expected)
        assert pairs.mask[i, :k].all()
    assert top_matches(assignment, pairs_factor=100.0).mask.sum(-1).tolist() == [48] * 4


@pytest.mark.parametrize("backend", ["poselib", "opencv", "torch"])
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
        assignment, points2d, points3d, mask2d=mask2d, backend=backend, pairs_factor=1.0, threshold=1e-6
    )
    assert stats.converged.tolist() == [False, True, True]
    assert r[0].isnan().all()
    assert t[0].isnan().all()
    assert stats.residual[0] == torch.inf
    tried = (
        kind not in ("three pairs", "nothing finite") or backend == "torch"
    )  # what was tried counts, whatever came of it
    assert (stats.iterations[0] > 0) == tried
    assert rotation_angle(r[1:], planted.rotation[1:]).max() < 1e-5


@pytest.mark.parametrize("backend", ["poselib", "opencv", "torch"])
def test_points_of_one_plane_are_no_trap(backend: str) -> None:
    planted = plant(12, 60, seed=6)
    points3d = planted.points3d * torch.tensor([1.0, 1.0, 0.0]).double()
    seen = project(transform(planted.rotation, planted.translation, points3d))
    generator = torch.Generator().manual_seed(0)
    seen = seen + 0.001 * torch.randn(seen.shape, generator=generator, dtype=torch.float64)
    points2d = torch.empty_like(seen).scatter_(1, planted.match3d.unsqueeze(-1).expand_as(seen), seen)
    r, _, stats = ransac_pnp(wrong_pairs(planted, 0.2), points2d, points3d, backend=backend, pairs_factor=1.0)
    assert stats.converged.all()
    assert torch.rad2deg(rotation_angle(r, planted.rotation)).max() < 2


@pytest.mark.parametrize("backend", ["poselib", "opencv", "torch"])
def test_neighbours_and_padding_change_nothing(backend: str) -> None:
    planted = plant(3, 30, noise=0.002, seed=5)
    assignment = wrong_pairs(planted, 0.3)
    r, t, stats = ransac_pnp(assignment, planted.points2d, planted.points3d, backend=backend)
    pad = torch.nn.functional.pad
    mask2d, mask3d = (torch.arange(k).expand(3, k) < 30 for k in (35, 33))
    padded = ransac_pnp(
        pad(assignment, (0, 3, 0, 5), value=9.0),
        pad(planted.points2d, (0, 0, 0, 5), value=0.3),
        pad(planted.points3d, (0, 0, 0, 3), value=4.0),
        mask2d=mask2d,
        mask3d=mask3d,
        backend=backend,
    )
    torch.testing.assert_close(padded[0], r, atol=1e-9, rtol=0)
    torch.testing.assert_close(padded[1], t, atol=1e-9, rtol=0)
    for i in range(3):
        some = [x[i : i + 1] for x in (assignment, planted.points2d, planted.points3d)]
        alone = ransac_pnp(*some, backend=backend)
        torch.testing.assert_close(alone[0][0], r[i], atol=1e-9, rtol=0)
        assert alone[2].iterations[0] == stats.iterations[i]


@pytest.mark.parametrize("backend", ["poselib", "opencv", "torch"])
def test_a_seed_gives_the_same_pose_again(backend: str) -> None:
    planted = plant(2, 40, noise=0.005, seed=6)
    assignment = wrong_pairs(planted, 0.4)
    first = ransac_pnp(assignment, planted.points2d, planted.points3d, backend=backend, seed=3)
    torch.manual_seed(1)
    second = ransac_pnp(assignment, planted.points2d, planted.points3d, backend=backend, seed=3)
    assert torch.equal(first[0], second[0])
    assert torch.equal(first[1], second[1])


def test_there_are_as_many_hypotheses_as_wrong_pairs_ask_for() -> None:
    planted = plant(1, 40, seed=8)
    easy, hard = (wrong_pairs(planted, share) for share in (0.0, 0.8))

    def iterations(assignment: Tensor, most: int) -> int:
        layer = RansacPnP(backend="poselib", max_iterations=most)
        return int(layer(assignment, planted.points2d, planted.points3d)[2].iterations)

    assert iterations(hard, 20) <= 21
    assert iterations(easy, 5000) < 200
    assert iterations(hard, 5000) > 1000
