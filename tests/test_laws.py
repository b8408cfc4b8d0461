"""Laws that every solver keeps, whatever the problem: order of the points, batch and padding, unit and origin."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from planted import Planted, degrees_between, padded
from planted_strategies import FEW, problems
from small_data import small_matcher, small_net

from bpnp import Batch, solve
from bpnp.geometry import bearings, retract
from bpnp.layers import ransac_pnp, sinkhorn, weighted_pnp
from bpnp.models import Search

pytestmark = pytest.mark.slow


def true_matches(batch: Batch) -> torch.Tensor:
    index = torch.arange(batch.points2d.shape[1]).unsqueeze(-1)
    return (index == batch.match3d.unsqueeze(1)).double()


def by_module(module: torch.nn.Module) -> Callable[[Batch], list[torch.Tensor]]:
    def solved(batch: Batch) -> list[torch.Tensor]:
        with torch.no_grad():
            poses = module.eval()(batch).poses.values()
        return [part for pose in poses for part in (pose.rotation, pose.translation)]

    return solved


def by_pnp(batch: Batch) -> tuple[torch.Tensor, ...]:
    near = retract(torch.full((len(batch), 6), 0.03, dtype=torch.float64), batch.rotation, batch.translation)
    return weighted_pnp(true_matches(batch), bearings(batch.points2d), batch.points3d, *near)[:2]


def by_ransac(backend: str) -> Callable[[Batch], tuple[torch.Tensor, ...]]:
    def solved(batch: Batch) -> tuple[torch.Tensor, ...]:
        masks = {"mask2d": batch.mask2d, "mask3d": batch.mask3d}
        return ransac_pnp(true_matches(batch), batch.points2d, batch.points3d, backend=backend, **masks)[:2]

    return solved


def by_sinkhorn(batch: Batch) -> tuple[torch.Tensor]:
    cost = torch.cdist(batch.points2d, batch.points3d[..., :2])
    return (sinkhorn(cost, mu=0.05, tolerance=1e-12, mask2d=batch.mask2d, mask3d=batch.mask3d)[0],)


def by_matcher(frame: str) -> Callable[[Batch], tuple[torch.Tensor, ...]]:
    net = small_matcher(frame)
    return lambda batch: (net.match(batch).assignment.detach(),)


LAYERS = {
    "sinkhorn": by_sinkhorn,
    "pnp": by_pnp,
    **{f"ransac of {backend}": by_ransac(backend) for backend in ("poselib", "opencv", "torch")},
    **{f"matcher in {frame} frame": by_matcher(frame) for frame in ("any", "view")},
    "search": by_module(Search()),
    "net": by_module(small_net().double()),
}


@pytest.mark.parametrize("name", LAYERS)
@FEW
@given(planted=problems(), others=problems())
def test_a_problem_is_solved_as_if_it_were_alone(name: str, planted: Planted, others: Planted) -> None:
    """Whatever else is in the batch, and nothing to the padding."""
    alone = replace(padded([planted]), index=torch.tensor([1]))
    both, alone = LAYERS[name](padded([others, planted])), LAYERS[name](alone)
    for together, single in zip(both, alone, strict=True):
        inside = together[1][tuple(slice(size) for size in single.shape[1:])]
        torch.testing.assert_close(inside, single[0], rtol=0, atol=0 if name == "search" else 1e-7, equal_nan=True)
        if "sinkhorn" in name or "matcher" in name:
            assert float(together[1].abs().sum()) == pytest.approx(float(inside.abs().sum()), rel=1e-12)


@FEW
@given(planted=problems(noise=0.0, least=20), seed=st.integers(0, 100))
def test_the_order_of_the_points_changes_the_places_of_matches_alone(planted: Planted, seed: int) -> None:
    points2d, points3d = planted.points2d[0].numpy(), planted.points3d[0].numpy()
    rng = np.random.default_rng(seed)
    image, scene = rng.permutation(len(points2d)), rng.permutation(len(points3d))
    plain, shuffled = solve(points2d, points3d), solve(points2d[image], points3d[scene])
    assert plain.verdict == shuffled.verdict == "confident"
    assert degrees_between(plain.rotation, shuffled.rotation) < 1e-3
    places = np.column_stack([image[shuffled.matches[:, 0]], scene[shuffled.matches[:, 1]]])
    assert set(map(tuple, places.tolist())) == set(map(tuple, plain.matches.tolist()))


@FEW
@given(
    planted=problems(noise=0.0, least=20),
    unit=st.sampled_from([1e-3, 1.0, 250.0]),
    origin=st.tuples(*3 * [st.floats(-100, 100)]),
)
def test_unit_and_origin_of_the_scene_change_the_translation_alone(
    planted: Planted, unit: float, origin: tuple[float, float, float]
) -> None:
    points2d, points3d = planted.points2d[0].numpy(), planted.points3d[0].numpy()
    plain, moved = solve(points2d, points3d), solve(points2d, unit * (points3d + origin))
    assert plain.verdict == moved.verdict == "confident"
    assert degrees_between(plain.rotation, moved.rotation) < 0.01
    np.testing.assert_allclose(moved.centre / unit - origin, plain.centre, atol=2e-3)


@FEW
@given(planted=problems(size=2, least=6, most=20), seed=st.integers(0, 100))
def test_layers_keep_the_order_the_unit_and_the_origin(planted: Planted, seed: int) -> None:
    """Sinkhorn's assignment is permuted with its cost; a pose's translation follows the points."""
    generator = torch.Generator().manual_seed(seed)
    m, n = planted.points2d.shape[1], planted.points3d.shape[1]
    rows, cols = torch.randperm(m, generator=generator), torch.randperm(n, generator=generator)
    cost = torch.rand(2, m, n, generator=generator, dtype=torch.float64)
    plan, permuted = (sinkhorn(c, tolerance=1e-12)[0] for c in (cost, cost[:, rows][:, :, cols]))
    torch.testing.assert_close(permuted, plan[:, rows][:, :, cols], atol=1e-12, rtol=1e-9)
    assignment, near = planted.permutation(), planted.near(0.02)
    pose = weighted_pnp(assignment, planted.bearings, planted.points3d, *near)[:2]
    shift = torch.tensor([30.0, -20, 10], dtype=torch.float64)
    start = near[0], 10 * near[1] - near[0] @ shift
    moved = weighted_pnp(assignment, planted.bearings, 10 * planted.points3d + shift, *start)[:2]
    torch.testing.assert_close(moved[0], pose[0], atol=1e-6, rtol=0)
    torch.testing.assert_close(moved[1], 10 * pose[1] - pose[0] @ shift, atol=1e-4, rtol=1e-5)
    shuffled = ransac_pnp(assignment[:, rows][:, :, cols], planted.points2d[:, rows], planted.points3d[:, cols])
    plain = ransac_pnp(assignment, planted.points2d, planted.points3d)
    torch.testing.assert_close(shuffled[0], plain[0], atol=0.02, rtol=0)
