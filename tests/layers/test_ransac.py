import math

import numpy as np
import pytest
import torch
from planted import Planted, plant
from torch import Tensor

from bpnp.geometry import project, rotation_angle, transform
from bpnp.layers import ransac_pnp
from bpnp.layers.ransac.layer import top_matches

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
def test_ransac_finds_a_planted_pose_among_outliers(backend: str, share: float) -> None:
    planted = plant(8, 80, noise=0.001, seed=1)
    assignment = wrong_pairs(planted, share)
    r, t, stats = ransac_pnp(assignment, planted.points2d, planted.points3d, backend=backend)
    assert stats.converged.all()
    assert torch.rad2deg(rotation_angle(r, planted.rotation)).max() < 1
    assert (t - planted.translation).norm(dim=-1).max() < 0.1
    assert stats.residual.max() < THRESHOLD


@pytest.mark.parametrize("backend", ["poselib", "opencv", "torch"])
@pytest.mark.parametrize("kind", ["three pairs", "one place", "collinear", "no agreement", "nothing finite"])
def test_ransac_finds_no_pose_without_four_inliers(backend: str, kind: str) -> None:
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
    # What was tried counts, whatever came of it.
    tried = backend == "torch" or kind not in ("three pairs", "nothing finite")
    assert (stats.iterations[0] > 0) == tried
    assert rotation_angle(r[1:], planted.rotation[1:]).max() < 1e-5


@pytest.mark.parametrize("backend", ["poselib", "opencv", "torch"])
def test_ransac_solves_points_of_one_plane(backend: str) -> None:
    planted = plant(12, 60, seed=6)
    points3d = planted.points3d * torch.tensor([1.0, 1.0, 0.0]).double()
    seen = project(transform(planted.rotation, planted.translation, points3d))
    generator = torch.Generator().manual_seed(0)
    seen = seen + 0.001 * torch.randn(seen.shape, generator=generator, dtype=torch.float64)
    points2d = torch.empty_like(seen).scatter_(1, planted.match3d.unsqueeze(-1).expand_as(seen), seen)
    r, _, stats = ransac_pnp(wrong_pairs(planted, 0.2), points2d, points3d, backend=backend, matches_factor=1.0)
    assert stats.converged.all()
    assert torch.rad2deg(rotation_angle(r, planted.rotation)).max() < 2


@pytest.mark.parametrize("backend", ["poselib", "torch"])
def test_the_most_probable_matches_are_tried_first(backend: str) -> None:
    """The 15 most probable of 300 matches are true. Uniform draws would find a true triple once in ten thousand."""
    planted = plant(8, 300, noise=0.0005, seed=3)
    place = torch.arange(300).expand(8, 300)
    matched = torch.where(place < 15, planted.match3d, planted.match3d.roll(1, -1))
    assignment = torch.zeros(8, 300, 300).double().scatter_(1, matched.unsqueeze(1), 1 / (1 + place.double())[:, None])
    options = {"matches_factor": 1.0, "threshold": 0.002, "max_iterations": 64}
    r, _, stats = ransac_pnp(assignment, planted.points2d, planted.points3d, backend=backend, **options)
    assert (stats.iterations <= 64).all()
    assert torch.rad2deg(rotation_angle(r, planted.rotation)).max() < 1


@pytest.mark.parametrize("backend", ["poselib", "opencv", "torch"])
def test_a_seed_gives_the_same_pose_again_and_another_one_another(backend: str) -> None:
    planted = plant(2, 40, noise=0.005, seed=6)
    assignment = wrong_pairs(planted, 0.4).roll(1, 1)  # no match is true: there are many poses, and none stands out

    def poses(seed: int) -> Tensor:
        options = {"threshold": 0.1, "max_iterations": 5, "seed": seed}
        return ransac_pnp(assignment, planted.points2d, planted.points3d, backend=backend, **options)[0]

    first = poses(3)
    torch.manual_seed(1)
    torch.testing.assert_close(poses(3), first, rtol=0, atol=0, equal_nan=True)
    if backend != "opencv":  # its generator starts afresh at each call
        assert (poses(4) - first).abs().max() > 0.1


def padded_matches(assignment: Tensor, size: int, factor: float) -> list[tuple[int, int]]:
    """Matches of one sample (m, n) that is padded to (size, size)."""
    m, n = assignment.shape
    wide = torch.nn.functional.pad(assignment, (0, size - n, 0, size - m))[None]
    place = torch.arange(size)[None]
    index2d, index3d, real = top_matches(wide, place < m, place < n, factor)
    return list(zip(index2d[real].tolist(), index3d[real].tolist(), strict=True))


@pytest.mark.parametrize("kind", ["one-hot", "underflowed", "constant", "distinct"])
@pytest.mark.parametrize("size", [20, 23, 200])
def test_matches_of_equal_probability_are_ordered_by_index_whatever_the_padding(kind: str, size: int) -> None:
    m, n, factor = 18, 20, 1.5
    assignment = torch.rand(m, n, generator=torch.Generator().manual_seed(0))
    if kind == "one-hot":
        assignment = torch.eye(m, n) / m
    elif kind == "underflowed":
        assignment = torch.where(assignment > 0.95, assignment, 0)
    elif kind == "constant":
        assignment = torch.full_like(assignment, 1 / (m * n))
    order = np.argsort(-assignment.flatten().numpy(), kind="stable")[: int(factor * m)]
    expected = list(zip((order // n).tolist(), (order % n).tolist(), strict=True))
    assert padded_matches(assignment, size, factor) == expected


def test_a_pose_of_one_to_one_matches_does_not_depend_on_padding() -> None:
    """A one-to-one assignment has 20 equal entries, and RANSAC takes 30: ten are chosen among zeros."""
    n = 20
    planted = plant(1, n, noise=0.004, seed=2, dtype=torch.float32)
    assignment, points2d, points3d = planted.permutation(), planted.points2d.clone(), planted.points3d
    points2d[:, 14:] = points2d[:, 14:].roll(1, 1)
    pad, poses = torch.nn.functional.pad, []
    for more in (0, 3, 44):
        mask = (torch.arange(n + more) < n)[None]
        wide = pad(assignment, (0, more, 0, more)), pad(points2d, (0, 0, 0, more)), pad(points3d, (0, 0, 0, more))
        rotation, _, stats = ransac_pnp(*wide, mask2d=mask, mask3d=mask, backend="poselib")
        assert stats.converged.all()
        poses.append(rotation)
    assert max(float((pose - poses[0]).abs().max()) for pose in poses) < 1e-6


@pytest.mark.parametrize("default", [torch.float32, torch.float64])
def test_the_number_of_matches_is_exact(default: torch.dtype) -> None:
    """1.4 * 45 is just below 63 in double precision, and 63 in single precision."""
    before = torch.get_default_dtype()
    assignment = torch.rand(45, 45, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    torch.set_default_dtype(default)
    try:
        counts = [len(padded_matches(assignment, size, 1.4)) for size in (45, 65)]
    finally:
        torch.set_default_dtype(before)
    assert counts == [math.floor(1.4 * 45)] * 2 == [62, 62]


@pytest.mark.parametrize(("real", "count"), [(3, 9), (5, 10), (8, 12), (30, 40)])
def test_the_number_of_matches_is_within_its_limits(real: int, count: int) -> None:
    """1.5 a point, at least 10, but no more than the pairs that there are, and at most 40."""
    assignment = torch.rand(1, 30, 30, generator=torch.Generator().manual_seed(0))
    mask = (torch.arange(30) < real)[None]
    index2d, index3d, chosen = top_matches(assignment, mask, mask, 1.5, 10, 40)
    assert int(chosen.sum()) == count
    pairs = assignment[0, :real, :real].flatten().sort(descending=True).values[:count]
    assert torch.equal(assignment[0, index2d[0], index3d[0]][chosen[0]], pairs)


def test_limits_that_contradict_each_other_are_refused() -> None:
    planted = plant(1, 6)
    with pytest.raises(ValueError, match="`max_matches` is 5; .* 10"):
        ransac_pnp(planted.permutation(), planted.points2d, planted.points3d, min_matches=10, max_matches=5)
