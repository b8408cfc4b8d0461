import itertools
import math
from collections.abc import Callable

import mpmath
import pytest
import torch
from torch import Tensor
from torch.autograd import gradcheck

from bpnp.layers import sinkhorn

EXACT = {"tolerance": 1e-14, "max_iterations": 5000}


def uniform(*shape: int, seed: int = 0, low: float = 0.0, high: float = 1.0) -> Tensor:
    return low + (high - low) * torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def marginals(logits: Tensor) -> Tensor:
    """Totals stay one, whatever the logits."""
    return torch.softmax(logits, -1)


def gradient(of: Tensor, plan: Callable[[Tensor], Tensor], weights: Tensor) -> Tensor:
    variable = of.detach().clone().requires_grad_()
    (plan(variable) * weights).sum().backward()
    assert variable.grad is not None
    return variable.grad


def projected(plan: Tensor, weights: Tensor, mu: float) -> Tensor:
    """-P.(V - a1^T - 1b^T)/mu of one sample with the multipliers solved for in 150 digits."""
    p, v = (mpmath.matrix(x.detach().double().tolist()) for x in (plan.clamp_min(1e-35), weights))
    m, n = plan.shape
    with mpmath.workdps(150):
        rows, cols = [mpmath.fsum(p[i, :]) for i in range(m)], [mpmath.fsum(p[:, j]) for j in range(n)]
        system, right = mpmath.diag(rows + cols), mpmath.zeros(m + n, 1)
        for i, j in itertools.product(range(m), range(n)):
            system[i, m + j] = system[m + j, i] = p[i, j]
            right[i] += p[i, j] * v[i, j]
            right[m + j] += p[i, j] * v[i, j]
        k = m + n - 1  # the last multiplier is zero: only sums a + b count
        x = [*mpmath.lu_solve(system[:k, :k], right[:k, 0]), mpmath.mpf(0)]
        found = [[float(p[i, j] * (v[i, j] - x[i] - x[m + j]) / -mu) for j in range(n)] for i in range(m)]
    return torch.tensor(found, dtype=torch.float64)


@pytest.mark.parametrize("shape", [(1, 4, 4), (1, 3, 5), (1, 1, 4), (2, 3, 1)])
@pytest.mark.parametrize("mu", [0.5, 0.1])
def test_gradients_of_cost_mu_and_marginals_are_finite_differences(shape: tuple[int, int, int], mu: float) -> None:
    b, m, n = shape

    def plan(cost: Tensor, mu: Tensor, rows: Tensor, cols: Tensor) -> Tensor:
        return sinkhorn(cost, mu=mu, row_marginal=marginals(rows), col_marginal=marginals(cols), **EXACT)[0]

    inputs = (uniform(*shape), torch.tensor(mu).double(), uniform(b, m, seed=1), uniform(b, n, seed=2))
    assert gradcheck(plan, tuple(x.requires_grad_() for x in inputs), atol=1e-7)


def test_an_unconverged_plan_has_the_gradient_of_the_problem_that_it_solves() -> None:
    cost, weights = uniform(2, 8, 6), uniform(2, 8, 6, seed=3)
    plan, stats = sinkhorn(cost, mu=0.03, max_iterations=2)
    assert not stats.converged.any()
    solved = {"row_marginal": plan.sum(-1), "col_marginal": plan.sum(-2)}
    again, stats = sinkhorn(cost, mu=0.03, **solved, **EXACT)
    assert stats.converged.all()
    assert (again - plan).abs().max() < 1e-13
    short = gradient(cost, lambda c: sinkhorn(c, mu=0.03, max_iterations=2)[0], weights)
    expected = gradient(cost, lambda c: sinkhorn(c, mu=0.03, **solved, **EXACT)[0], weights)
    assert (short - expected).abs().max() < 1e-11 * expected.abs().max()


def test_the_envelope_theorem_holds() -> None:
    """<P, cost> + mu sum P (log P - 1) is optimal in P: its derivative in the cost is P, in mu the entropy term."""
    cost, mu = uniform(2, 5, 6).requires_grad_(), torch.tensor(0.1, dtype=torch.float64, requires_grad=True)
    plan, _ = sinkhorn(cost, mu=mu, **EXACT)
    ((plan * cost).sum() + mu * (plan * (plan.log() - 1)).sum()).backward()
    assert cost.grad is not None
    assert mu.grad is not None
    assert (cost.grad - plan).abs().max() < 1e-12
    assert abs(mu.grad - (plan * (plan.log() - 1)).sum()) < 1e-11


def clusters(seed: int, n: int, *, groups: int = 4) -> Tensor:
    """Distances between unit vectors in a few far groups: between them the plan falls to nothing."""
    generator = torch.Generator().manual_seed(seed)
    angle = torch.randint(0, groups, (n,), generator=generator) * (2 * math.pi / groups)
    angle = angle + 0.15 * torch.randn(n, generator=generator)
    other = angle + 0.05 * torch.randn(n, generator=generator)
    return torch.cdist(*(torch.stack([a.cos(), a.sin()], -1) for a in (angle, other))).unsqueeze(0)


@pytest.mark.parametrize("mu", [0.1, 0.05, 0.02, 0.01, 0.005])
@pytest.mark.parametrize(("dtype", "digits"), [(torch.float32, 1e-5), (torch.float64, 1e-10)])
def test_weak_links_between_groups_spoil_no_gradient(mu: float, dtype: torch.dtype, digits: float) -> None:
    for seed in range(4):
        cost, weights = clusters(seed, 10).to(dtype), uniform(1, 10, 10, seed=seed, low=-1).to(dtype)
        plan, stats = sinkhorn(cost, mu=mu)
        assert stats.converged.all()
        found = gradient(cost, lambda c: sinkhorn(c, mu=mu)[0], weights)[0].double()
        scale = float((plan * weights).abs().max()) / mu
        assert (found - projected(plan[0], weights[0], mu)).abs().max() < digits * scale
