"""The paper's options of the weighted PnP layer: L-BFGS finds Newton's optimum, and columns of the derivative are
clipped to a norm that is measured by finite differences."""

import pytest
import roma
import torch
from planted import plant
from torch import Tensor

from bpnp.geometry import rotation_angle
from bpnp.layers import WeightedPnP, weighted_pnp
from bpnp.layers.pnp import ClippedColumns


def test_lbfgs_reaches_the_optimum_of_newton() -> None:
    """Draw soft assignments with outliers on both sides."""
    planted = plant(8, 100, outliers2d=10, outliers3d=10)
    problem = planted.diffuse(0.15), planted.bearings, planted.points3d
    start = planted.near(0.1)
    *newton, newton_stats = weighted_pnp(*problem, *start)
    *found, stats = weighted_pnp(*problem, *start, solver="lbfgs", max_iterations=200)
    assert newton_stats.converged.all()
    assert stats.converged.all()
    assert rotation_angle(found[0], newton[0]).max() < 1e-6
    assert (found[1] - newton[1]).norm(dim=-1).max() < 1e-5
    assert (stats.iterations > newton_stats.iterations).all()  # it has no second derivatives


def test_lbfgs_gives_the_same_gradient_and_leaves_the_samples_of_a_batch_apart() -> None:
    planted = plant(3, 60, outliers2d=4)
    start, gradients = planted.near(0.1), []
    for solver, chosen in (("newton", slice(None)), ("lbfgs", slice(None)), ("lbfgs", slice(1, 2))):
        problem = planted.diffuse(0.1), planted.bearings, planted.points3d
        variables = [values[chosen].clone().requires_grad_() for values in problem]
        layer = WeightedPnP(solver=solver, max_iterations=200)
        r, t, stats = layer(*variables, start[0][chosen], start[1][chosen])
        assert stats.converged.all()
        (rotation_angle(r, planted.rotation[chosen]) + t.norm(dim=-1)).sum().backward()
        gradients.append([values.grad for values in variables])
    for newton, lbfgs, alone in zip(*gradients, strict=True):
        assert newton is not None
        assert (lbfgs - newton).abs().max() < 1e-4 * newton.abs().max()
        # A batch rounds the initial rotation differently (by 1e-16), and L-BFGS ends anywhere within its tolerance.
        assert (lbfgs[1:2] - alone).abs().max() < 1e-5 * alone.abs().max()


def test_lbfgs_runs_in_a_trainers_inference_mode() -> None:
    planted = plant(2, 30)
    problem = planted.diffuse(0.1), planted.bearings, planted.points3d, *planted.near(0.1)
    with torch.inference_mode():
        rotation, _, stats = weighted_pnp(*problem, solver="lbfgs", max_iterations=200)
    assert stats.converged.all()
    assert rotation_angle(rotation, weighted_pnp(*problem)[0]).max() < 1e-5


def test_lbfgs_stops_after_its_iterations_and_reports_it() -> None:
    planted = plant(2, 20)
    problem = planted.diffuse(0.3), planted.bearings, planted.points3d, *planted.near(0.3)
    _, _, stats = weighted_pnp(*problem, solver="lbfgs", max_iterations=2)
    assert stats.iterations.tolist() == [2, 2]
    assert not stats.converged.any()


def columns(planted, assignment: Tensor, start: tuple[Tensor, Tensor]) -> Tensor:
    """d(angle-axis, translation) / dP_ij (6, m, n) of the first sample by central differences."""

    def pose(p: Tensor) -> Tensor:
        options = {"tolerance": 1e-13, "max_iterations": 100}
        r, t, stats = weighted_pnp(p[None], planted.bearings[:1], planted.points3d[:1], *start, **options)
        assert stats.converged.all()
        return torch.cat([roma.rotmat_to_rotvec(r[0]), t[0]])

    result = torch.zeros(6, *assignment.shape)
    for i in range(assignment.shape[0]):
        for j in range(assignment.shape[1]):
            step = torch.zeros_like(assignment)
            step[i, j] = 1e-6
            result[:, i, j] = (pose(assignment + step) - pose(assignment - step)) / 2e-6
    return result


@pytest.mark.parametrize("total", [1.0, 7.0])
def test_long_columns_of_the_derivative_are_scaled_to_the_limit(total: float) -> None:
    """The limit is of P that sums to one, as in the paper: another total of P changes which gradient comes out by its
    factor, and not which columns are clipped."""
    planted = plant(1, 6, outliers2d=2, seed=3)
    assignment = planted.diffuse(0.3)[0]
    assignment = assignment / assignment.sum()
    start = planted.near(0.02)
    exact = columns(planted, assignment, start)
    norms = exact.norm(dim=0)
    limit = norms.median().item()
    direction = torch.randn(6, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    variable = (total * assignment)[None].requires_grad_()
    count = ClippedColumns()
    options = {"clip_columns": limit, "clipped": count, "tolerance": 1e-13}
    r, t, _ = weighted_pnp(variable, planted.bearings[:1], planted.points3d[:1], *start, **options)
    (torch.cat([roma.rotmat_to_rotvec(r)[0], t[0]]) @ direction).backward()
    expected = torch.einsum("k,kij->ij", direction, exact.double()) * (limit / norms).clamp_max(1) / total
    assert variable.grad is not None
    assert (variable.grad[0] - expected).abs().max() < 1e-4 * expected.abs().max()
    assert count == ClippedColumns(norms.numel(), int((norms > limit * (1 + 1e-6)).sum()))
    count.reset()
    assert count == ClippedColumns()


def test_clipping_is_off_by_default_and_does_not_change_the_pose() -> None:
    planted = plant(2, 12, outliers2d=3)
    problem, start = (planted.bearings, planted.points3d), planted.near(0.05)
    layers = WeightedPnP(), WeightedPnP(clip_columns=1e9), WeightedPnP(clip_columns=1e-3)
    gradients, poses = [], []
    for layer in layers:
        assignment = planted.diffuse(0.2).requires_grad_()
        r, t, _ = layer(assignment, *problem, *start)
        t.sum().backward()
        gradients.append(assignment.grad)
        poses.append(torch.cat([r.flatten(1), t], 1).detach())
    assert poses[0].equal(poses[1])
    assert poses[0].equal(poses[2])
    assert torch.allclose(gradients[0], gradients[1], rtol=1e-12, atol=0)
    assert gradients[2].abs().max() < 2e-3 < gradients[0].abs().max()
    assert layers[0].clipped == ClippedColumns()
    assert (layers[1].clipped.clipped, layers[2].clipped.clipped) == (0, layers[2].clipped.columns)


def test_a_limit_of_zero_is_one_error() -> None:
    planted = plant(1, 6)
    problem = planted.permutation(), planted.bearings, planted.points3d, *planted.near(0.1)
    with pytest.raises(ValueError, match="`clip_columns` is 0.0; it is a norm above 0"):
        weighted_pnp(*problem, clip_columns=0.0)
