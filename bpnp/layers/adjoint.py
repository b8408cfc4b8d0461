"""The gradient of the entropic transport plan: the incoming gradient, projected onto plans with the same marginals."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

import bpnp.layers.compiled as compiled
from bpnp.layers.laplacian import solve_laplacian
from bpnp.layers.plan import Plan, divide, transpose_times

TOLERANCE = {torch.float32: 5e-6, torch.float64: 1e-13}  # of conjugate gradients, relative
TOLERANCE_PROMOTED = 1e-8  # in float64 for float32 data
ROUNDING = 1e-12  # of sums in float64, relative
SHARP = 16.0  # mass per sum of the degrees, beyond which float32 loses the gradient's fifth digit


def project(
    plan: Float[Tensor, "b m n"],
    gradient: Float[Tensor, "b m n"],
    a: Float[Tensor, "b m"],
    b: Float[Tensor, "b n"],
    factor: Float[Tensor, ""],
) -> Float[Tensor, "b m n"]:
    """factor P . (V - a 1^T - 1 b^T) for the gradient V."""
    if compiled.applies_to(plan):
        return compiled.projected(plan, gradient, a, b, factor.expand(len(plan)))
    return (gradient - a.unsqueeze(-1)).sub_(b.unsqueeze(-2)).mul_(plan).mul_(factor)


def solve_multipliers(
    plan: Float[Tensor, "b m n"], gradient: Float[Tensor, "b m n"]
) -> tuple[Float[Tensor, "b m"], Float[Tensor, "b n"], Bool[Tensor, " b"]]:
    """Multipliers (a, b) of the projection of `gradient` onto plans with the marginals of `plan`; sum(P^T 1 . b) = 0.

    The last value tells which samples converged. Samples whose plan is sharp, where differences of nearly equal numbers
    decide, and samples that stall are solved in float64, by a Cholesky factorisation at last.
    """
    a, b, solved, trusted = _solve(plan, gradient, TOLERANCE[plan.dtype])
    if plan.dtype != torch.float64 and not bool(trusted.all()):
        hard = (~trusted).nonzero().squeeze(-1)
        exact_a, exact_b, exact_solved, _ = _solve(plan[hard].double(), gradient[hard].double(), TOLERANCE_PROMOTED)
        a, b = a.index_copy(0, hard, exact_a.to(a.dtype)), b.index_copy(0, hard, exact_b.to(b.dtype))
        solved = solved.index_copy(0, hard, exact_solved)
    return a, b, solved & a.isfinite().all(-1) & b.isfinite().all(-1)


def _solve(
    plan: Float[Tensor, "b m n"], gradient: Float[Tensor, "b m n"], tolerance: float
) -> tuple[Float[Tensor, "b m"], Float[Tensor, "b n"], Bool[Tensor, " b"], Bool[Tensor, " b"]]:
    """(a, b) in the precision of the plan, which samples are solved, and for which of these the precision is enough."""
    rows, row_mean, cols, rhs = _moments(plan, gradient)
    system = Plan.of(plan)
    degree = system.degree(rows, cols)
    b, mean, solved = solve_laplacian(system, rows, cols, degree, rhs, torch.full_like(rhs[:, 0], tolerance))
    if plan.dtype == torch.float64 and not bool(solved.all()):
        solved = solved | _sums_vanish(plan, gradient, row_mean - mean, b, cols)
    return row_mean - mean, b, solved, solved & (cols.sum(-1) <= SHARP * degree.sum(-1))


def _sums_vanish(plan: Tensor, gradient: Tensor, a: Tensor, b: Tensor, cols: Tensor) -> Bool[Tensor, " b"]:
    """Whether the column sums of the projected gradient are rounding errors of those of P . V.

    Links between groups of columns may be so weak that the whole right-hand side is rounding, which nothing solves to
    a relative precision.
    """
    sums = project(plan, gradient, a, b, plan.new_ones(())).sum(-2)
    size = (plan * gradient.square()).sum((-2, -1))
    return (divide(sums.square(), cols).sum(-1) <= ROUNDING**2 * size) & size.isfinite()


def _moments(plan: Tensor, gradient: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """P 1, the rows' means w of the gradient V, P^T 1 and P^T (V - w 1^T)."""
    if compiled.applies_to(plan):
        return compiled.moments(plan, gradient)
    weighted, rows = plan * gradient, plan.sum(-1)
    means = divide(weighted.sum(-1), rows)
    return rows, means, plan.sum(-2), weighted.sum(-2) - transpose_times(plan, means)
