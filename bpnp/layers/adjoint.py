"""The multipliers in the gradient of the entropic transport plan (`bpnp.layers.implicit.entropic_plan`)."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from bpnp.layers.implicit import projected
from bpnp.layers.laplacian import solve_laplacian
from bpnp.layers.plan import Plan, cached_parts, divide, transpose_times

TOLERANCE = {torch.float32: 5e-6, torch.float64: 1e-13}  # of conjugate gradients, relative
TOLERANCE_PROMOTED = 1e-8  # in float64 for float32 data
ROUNDING = 1e-12  # of sums in float64, relative
SHARP = 16.0  # mass per sum of the degrees, beyond which float32 loses the gradient's fifth digit


def solve_multipliers(
    plan: Float[Tensor, "b m n"], gradient: Float[Tensor, "b m n"]
) -> tuple[Float[Tensor, "b m"], Float[Tensor, "b n"], Bool[Tensor, " b"]]:
    """Multipliers (a, b) of the projection of `gradient` onto plans with the marginals of `plan`; sum(P^T 1 . b) = 0.

    The last value tells which samples converged. Samples whose plan is sharp, where differences of nearly equal numbers
    decide, and samples that stall are solved in float64, by a Cholesky factorisation at last.
    """
    a, b, solved, trusted = _solve_parts(plan, gradient, TOLERANCE[plan.dtype])
    if plan.dtype != torch.float64 and not bool(trusted.all()):
        hard = (~trusted).nonzero().squeeze(-1)
        exact = _solve_parts(plan[hard].double(), gradient[hard].double(), TOLERANCE_PROMOTED)
        a, b, solved = (
            old.index_copy(0, hard, new.to(old.dtype)) for old, new in zip((a, b, solved), exact[:3], strict=True)
        )
    return a, b, solved & a.isfinite().all(-1) & b.isfinite().all(-1)


def _solve_parts(plan: Tensor, gradient: Tensor, tolerance: float) -> tuple[Tensor, ...]:
    """`_solve` of a few samples at a time."""
    parts = [_solve(p, v, tolerance) for p, v in cached_parts(plan, gradient)]
    return tuple(map(torch.cat, zip(*parts, strict=True)))


def _solve(plan: Tensor, gradient: Tensor, tolerance: float) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """(a, b) in the precision of the plan, which samples are solved, and for which of these the precision is enough."""
    weighted, rows, cols = plan * gradient, plan.sum(-1), plan.sum(-2)
    row_mean = divide(weighted.sum(-1), rows)
    rhs = weighted.sum(-2) - transpose_times(plan, row_mean)
    system = Plan.of(plan)
    degree = system.degree(rows, cols)
    b, mean, solved = solve_laplacian(system, rows, cols, degree, rhs, torch.full_like(rhs[:, 0], tolerance))
    a = row_mean - mean
    if plan.dtype == torch.float64 and not bool(solved.all()):
        # Links between groups of columns may be so weak that the whole right-hand side is rounding, which nothing
        # solves to a relative precision: it is enough that the projected gradient's column sums are rounding too.
        sums, size = projected(plan, gradient, a, b).sum(-2), (weighted * gradient).sum((-2, -1))
        solved = solved | ((divide(sums.square(), cols).sum(-1) <= ROUNDING**2 * size) & size.isfinite())
    return a, b, solved, solved & (cols.sum(-1) <= SHARP * degree.sum(-1))
