"""Backward passes that do not converge are counted or warned of; second derivatives are refused."""

import pytest
import torch
from planted import plant
from torch import Tensor

from bpnp.layers import BackwardStats, sinkhorn, weighted_pnp

SHARED = "bpnp.layers.laplacian"


def smooth_cost(n: int, dtype: torch.dtype = torch.float32) -> Tensor:
    """Distances between points on a line: probability is shared between neighbours, and the system is slow to solve."""
    place = torch.linspace(0, 4, n, dtype=dtype)
    return (place[:, None] - place).abs().expand(2, n, n).clone().requires_grad_()


@pytest.fixture
def too_few_iterations(monkeypatch: pytest.MonkeyPatch) -> None:
    """Three conjugate gradient steps, and no factorisation that is good enough."""
    monkeypatch.setattr(f"{SHARED}.ITERATIONS", 3)
    monkeypatch.setattr(f"{SHARED}.FACTORISED", 0.0)
    monkeypatch.setattr("bpnp.layers.laplacian.ROUNDING", 0.0)


def test_the_gradient_is_solved_to_its_tolerance() -> None:
    """The float32 gradient of a slow system is that of float64 to five digits."""
    n, mu = 60, 0.02
    weights = torch.rand(2, n, n, generator=torch.Generator().manual_seed(0))
    exact = smooth_cost(n, torch.float64)
    (sinkhorn(exact, mu=mu, tolerance=1e-13)[0] * weights).sum().backward()
    cost, stats = smooth_cost(n), BackwardStats()
    (sinkhorn(cost, mu=mu, backward_stats=stats)[0] * weights).sum().backward()
    assert stats == BackwardStats(samples=2, unconverged=0)
    assert cost.grad is not None
    assert exact.grad is not None
    assert (cost.grad - exact.grad).abs().max() < 5e-5 * exact.grad.abs().max()


def test_the_gradient_is_linear_in_that_of_the_loss() -> None:
    """A thousand-millionth of a millionth of a millionth of the loss has that fraction of its gradient."""
    cost = torch.rand(2, 40, 40, generator=torch.Generator().manual_seed(0)).requires_grad_()
    weights = torch.randn(2, 40, 40, generator=torch.Generator().manual_seed(1))
    plan = sinkhorn(cost)[0]
    (expected,) = torch.autograd.grad(plan, cost, weights, retain_graph=True)
    for factor in (1e-24, 1e-20, 1e-10, 1e10, 1e20):
        factors = torch.tensor([factor, 1.0])[:, None, None]  # a sample's scale is its own
        (found,) = torch.autograd.grad(plan, cost, factors * weights, retain_graph=True)
        error = (found.double() / factors.double() - expected).abs().amax((1, 2))
        assert (error < 2e-5 * expected.abs().amax((1, 2))).all()


@pytest.mark.usefixtures("too_few_iterations")
def test_a_failed_backward_pass_without_counters_warns() -> None:
    plan = sinkhorn(smooth_cost(60), mu=0.02)[0]
    with pytest.warns(RuntimeWarning, match="gradient of sinkhorn did not converge for 2 of 2 samples"):
        plan.square().sum().backward()


def test_a_gradient_that_is_not_a_number_is_counted() -> None:
    stats = BackwardStats()
    plan = sinkhorn(torch.rand(3, 5, 5, requires_grad=True), backward_stats=stats)[0]
    weights = torch.ones(3, 5, 5)
    weights[1, 2, 3] = torch.nan
    (plan * weights).sum().backward()
    assert stats == BackwardStats(samples=3, unconverged=1)


@pytest.mark.parametrize("layer", ["sinkhorn", "weighted_pnp", "weighted_pnp in the points"])
def test_a_second_derivative_is_refused(layer: str) -> None:
    planted = plant(1, 6)
    assignment, points3d = planted.diffuse(0.2).requires_grad_(), planted.points3d.requires_grad_()
    if layer == "sinkhorn":
        loss = sinkhorn(assignment)[0][0, 0, 0]
    else:
        loss = weighted_pnp(assignment, planted.bearings, points3d, *planted.near(0.1))[1].sum()
    variable = points3d if "points" in layer else assignment
    with pytest.raises(ValueError, match="create_graph=True asks for a second derivative"):
        torch.autograd.grad(loss, variable, create_graph=True)
