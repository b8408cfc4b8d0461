import math

import pytest
import torch
from scipy.optimize import linear_sum_assignment
from torch import Tensor

from bpnp.layers import sinkhorn

EXACT = {"tolerance": 1e-13, "max_iterations": 5000}


def random_cost(*shape: int, seed: int = 0) -> Tensor:
    return 2 * torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def marginals(*shape: int, seed: int = 0) -> Tensor:
    weights = 0.2 + random_cost(*shape, seed=seed)
    return weights / weights.sum(-1, keepdim=True)


def plain_sinkhorn(cost: Tensor, mu: float, rows: Tensor, cols: Tensor, *, iterations: int = 100_000) -> Tensor:
    """Plan (b, m, n) by rescaling in the log domain until the row sums are right to 1e-13."""
    kernel, log_r, log_c = -cost / mu, rows.log(), cols.log()
    v = torch.zeros_like(cols)
    for i in range(iterations):
        u = log_r - torch.logsumexp(kernel + v.unsqueeze(-2), -1)
        v = log_c - torch.logsumexp(kernel + u.unsqueeze(-1), -2)
        if i % 100 == 0:
            plan = (kernel + u.unsqueeze(-1) + v.unsqueeze(-2)).exp()
            if (plan.sum(-1) - rows).abs().sum(-1).max() < 1e-13:
                return plan
    raise AssertionError(f"the reference did not converge at mu = {mu}")


@pytest.mark.parametrize("mu", [0.1, 0.05, 0.01, 1e-3])
@pytest.mark.parametrize("shape", [(2, 5, 5), (2, 4, 6), (2, 1, 5), (2, 4, 1)])
def test_the_plan_is_that_of_plain_sinkhorn_scaling(mu: float, shape: tuple[int, int, int]) -> None:
    cost = random_cost(*shape)
    rows, cols = marginals(*shape[:2], seed=1), marginals(shape[0], shape[2], seed=2)
    expected = plain_sinkhorn(cost, mu, rows, cols)
    plan, stats = sinkhorn(cost, mu=mu, row_marginal=rows, col_marginal=cols, **EXACT)
    assert stats.converged.all()
    assert (plan - expected).abs().max() < 1e-12
    plan, stats = sinkhorn(cost.float(), mu=mu, row_marginal=rows.float(), col_marginal=cols.float())
    assert stats.converged.all()
    # The exponent cost / mu holds 24 bits in float32.
    assert (plan - expected).abs().max() < 4 * torch.finfo(torch.float32).eps * 2 / mu


def test_the_plan_becomes_the_optimal_assignment_as_mu_falls() -> None:
    cost = random_cost(8, 12, 12, seed=3)
    plan, stats = sinkhorn(cost, mu=2e-4, **EXACT)
    assert stats.converged.all()
    for sample, expected in zip(plan, cost, strict=True):
        i, j = linear_sum_assignment(expected)
        assert (12 * sample[i, j]).min() > 0.99


def test_a_pair_of_infinite_cost_is_never_matched() -> None:
    cost = random_cost(2, 6, 6)
    cost[:, torch.arange(6), torch.arange(6)] = torch.inf
    uniform = torch.full((2, 6), 1 / 6, dtype=torch.float64)
    plan, stats = sinkhorn(cost, mu=0.05, **EXACT)
    assert stats.converged.all()
    assert plan.diagonal(dim1=1, dim2=2).abs().max() == 0
    expected = plain_sinkhorn(cost.clamp_max(100), 0.05, uniform, uniform)
    assert (plan - expected).abs().max() < 1e-12


def test_a_dustbin_is_one_more_row_and_column() -> None:
    cost = random_cost(2, 4, 6)
    augmented = torch.full((2, 5, 7), 0.9, dtype=torch.float64)
    augmented[:, :4, :6] = cost
    rows = torch.tensor([0.1] * 4 + [0.6], dtype=torch.float64).expand(2, 5)
    cols = torch.tensor([0.1] * 6 + [0.4], dtype=torch.float64).expand(2, 7)
    plan, stats = sinkhorn(cost, dustbin=0.9, **EXACT)
    assert stats.converged.all()
    assert (plan - plain_sinkhorn(augmented, 0.1, rows, cols)[:, :4, :6]).abs().max() < 1e-12


@pytest.mark.parametrize("dustbin", [None, 0.9])
def test_padding_changes_neither_given_marginals_nor_the_room_of_a_dustbin(dustbin: float | None) -> None:
    """A problem of 4 and 6 points beside one of 7 and 8, with marginals of 5 at its padded points."""
    cost, rows, cols = random_cost(2, 7, 8), marginals(2, 7, seed=1), marginals(2, 8, seed=2)
    mask2d, mask3d = (torch.arange(k) < torch.tensor([[small], [k]]) for small, k in ((4, 7), (6, 8)))
    for marginal, mask in ((rows, mask2d), (cols, mask3d)):
        marginal[0] /= marginal[0, mask[0]].sum()
        marginal[~mask] = 5.0
    given = {"row_marginal": rows, "col_marginal": cols}
    alone = {name: value[:1, mask[0]] for (name, value), mask in zip(given.items(), (mask2d, mask3d), strict=True)}
    expected, _ = sinkhorn(cost[:1, :4, :6], dustbin=dustbin, **alone, **EXACT)
    plan, stats = sinkhorn(cost, dustbin=dustbin, mask2d=mask2d, mask3d=mask3d, **given, **EXACT)
    assert stats.converged.all()
    assert (plan[:1, :4, :6] - expected).abs().max() < 1e-12
    assert not plan[0, 4:].any()
    assert not plan[0, :, 6:].any()


@pytest.mark.parametrize("level", [0.99, 0.999, 0.999999])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_plan_close_to_a_permutation_converges(level: float, dtype: torch.dtype) -> None:
    n, mu = 50, 0.05
    odds = (n - 1) * level / (1 - level)
    cost = mu * math.log(odds) * (1 - torch.eye(n, dtype=dtype)).unsqueeze(0)
    plan, stats = sinkhorn(cost, mu=mu)
    assert stats.converged.all()
    assert stats.iterations.max() < 5
    assert abs(float(plan.diagonal(dim1=1, dim2=2).sum()) - level) < 1e-5


def test_an_unconverged_plan_is_reported() -> None:
    cost = random_cost(3, 20, 20)
    cost[1] = 0  # converges at once
    plan, stats = sinkhorn(cost, mu=0.01, max_iterations=2)
    assert stats.converged.tolist() == [False, True, False]
    assert stats.iterations.tolist() == [2, 1, 2]
    torch.testing.assert_close(stats.residual, (plan.sum(-1) - 1 / 20).abs().sum(-1))


def test_the_sweeps_of_both_precisions_are_counted() -> None:
    """Float32 does not reach this tolerance: the samples are solved again in float64."""
    cost = random_cost(2, 20, 20).float()
    single, double = (sinkhorn(values, mu=0.01, tolerance=1e-10)[1] for values in (cost, cost.double()))
    assert single.converged.all()
    assert (single.iterations > double.iterations).all()


def test_a_sample_with_nan_is_flagged_and_alone() -> None:
    cost = random_cost(3, 6, 6)
    expected, _ = sinkhorn(cost)
    cost[1, 2, 3] = torch.nan
    plan, stats = sinkhorn(cost)
    assert stats.converged.tolist() == [True, False, True]
    assert torch.equal(plan[[0, 2]], expected[[0, 2]])


def test_scalings_beyond_the_range_of_float32_are_absorbed() -> None:
    """Potentials that no single kernel exp(-M / mu) holds: they reach 200 mu, and float32 ends at 88."""
    n, mu = 40, 0.01
    far = 2 * torch.eye(n)[:, torch.arange(n).roll(1)] + torch.arange(n) / n
    for cost in (far.unsqueeze(0), far.T.unsqueeze(0)):
        uniform = torch.full((1, n), 1 / n, dtype=torch.float64)
        plan, stats = sinkhorn(cost, mu=mu)
        assert stats.converged.all()
        expected = plain_sinkhorn(cost.double(), mu, uniform, uniform)
        assert (plan - expected).abs().max() < 1e-5


@pytest.mark.parametrize("side", ["image", "scene"])
@pytest.mark.parametrize("padded", [False, True])
def test_a_point_without_a_finite_cost_has_no_plan(side: str, padded: bool) -> None:
    """On either side; a finite cost at a padded point is none. The other samples keep their plans."""
    cost = random_cost(3, 6, 6)
    masks = {}
    if padded:
        real = torch.ones(3, 6, dtype=torch.bool)
        real[1, 5] = False
        masks = {"mask2d": real, "mask3d": real}
    expected, _ = sinkhorn(cost, **masks)
    one, other = cost.clone(), 5 if padded else 6
    one[1, :other, 2] = torch.inf
    blocked = one.mT.contiguous() if side == "image" else one
    plan, stats = sinkhorn(blocked, **masks)
    assert stats.converged.tolist() == [True, False, True]
    assert plan[1, :other, :other].isnan().all()
    assert stats.iterations[1] <= 1
    if side == "scene":
        assert torch.equal(plan[[0, 2]], expected[[0, 2]])
    left, stats = sinkhorn(blocked, **masks, dustbin=0.5)
    assert stats.converged.all()
    assert left.isfinite().all()


def test_marginals_of_another_precision_are_those_of_the_cost() -> None:
    cost, rows, cols = random_cost(2, 4, 6).float(), marginals(2, 4, seed=1), marginals(2, 6, seed=2)
    expected, _ = sinkhorn(cost, row_marginal=rows.float(), col_marginal=cols.float())
    rows.requires_grad_()
    plan, stats = sinkhorn(cost, row_marginal=rows, col_marginal=cols)
    assert plan.dtype == cost.dtype
    assert torch.equal(plan, expected)
    plan.square().sum().backward()
    assert rows.grad is not None
    assert rows.grad.any()
    again, _ = sinkhorn(cost.double(), row_marginal=rows.float(), col_marginal=cols.float())
    assert again.dtype == torch.float64
    assert (again - plan).abs().max() < 1e-6
