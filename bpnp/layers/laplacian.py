"""Linear system of the entropic transport plan, shared by its gradient and its Newton step.

[diag(P1) P; P^T diag(P^T 1)] [a; b] = [x; y] is singular along (1, -1) and consistent when sum x = sum y. Eliminating a
leaves S b = y - P^T (x / P1) with S = diag(P^T 1) - P^T diag(1 / P1) P, the Laplacian of a graph between columns.
`solve_multipliers` solves the system of the gradient, for `entropic_plan`.
"""

from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from bpnp.layers.implicit import BackwardStats, first_derivative, record
from bpnp.layers.scaled_plan import Plan, cached_parts, divide, times, transpose_times

ITERATIONS = 150  # limit of conjugate gradients; slower systems are factorised
BETWEEN_TESTS = 8  # iterations on a GPU between two tests for convergence, for which the host waits
RIDGE = 1e-13  # added to the diagonal before the factorisation, relative to its scale
FACTORISED = 1e-6  # largest relative residual of a factorised system that counts as solved
TOLERANCE = {torch.float32: 5e-6, torch.float64: 1e-13}  # relative, for conjugate gradients
TOLERANCE_PROMOTED = 1e-8  # relative, for float32 data solved in float64
ROUNDING = 1e-12  # relative rounding error of sums in float64
SHARP = 16.0  # mass per sum of the degrees above which float32 loses the fifth digit of the gradient


# b with S b = rhs and weighted mean zero; P b / rows; True for samples that met their tolerance
LinearSolution = tuple[Float[Tensor, "b n"], Float[Tensor, "b m"], Bool[Tensor, " b"]]


def solve_laplacian(
    plan: Plan,
    rows: Float[Tensor, "b m"],
    cols: Float[Tensor, "b n"],
    degree: Float[Tensor, "b n"],
    rhs: Float[Tensor, "b n"],
    tolerance: Float[Tensor, " b"],
) -> LinearSolution:
    """Solve S b = rhs by preconditioned conjugate gradients; in float64, factorise the samples that stall.

    `rows` and `cols` are the sums of P, zero at padded points; `degree` is the diagonal of S or an approximation.
    Return b with a weighted mean of zero, P b / rows, and which samples met the tolerance. It limits the residual per
    unit of mass, sqrt(sum r_j^2 / cols_j), relative to that of the right-hand side. In the norm of the preconditioner,
    columns with weak links would outweigh all others.
    """
    # A power of two brings the largest entry into [1, 2): no digit changes, and no square underflows or overflows.
    largest = rhs.abs().amax(-1, keepdim=True)
    size = torch.where(largest > 0, largest / (2 * torch.frexp(largest).mantissa), 1)
    x, mean, solved = _conjugate_gradients(plan, rows, cols, degree, rhs / size, tolerance, ITERATIONS)
    x, mean = size * x, size * mean
    shift = _mean(x, cols)
    b, mean = torch.where(cols > 0, x - shift, 0), torch.where(rows > 0, mean - shift, 0)
    if rhs.dtype != torch.float64 or bool(solved.all()):
        return b, mean, solved
    hard = (~solved).nonzero().squeeze(-1)
    exact = _solve_by_cholesky(plan.samples(hard).dense(), rows[hard], cols[hard], rhs[hard])
    b, mean, solved = (old.index_copy(0, hard, new) for old, new in zip((b, mean, solved), exact, strict=True))
    return b, mean, solved


def _conjugate_gradients(
    plan: Plan, rows: Tensor, cols: Tensor, degree: Tensor, rhs: Tensor, tolerance: Float[Tensor, " b"], limit: int
) -> LinearSolution:
    """Solve S x = rhs as `solve_laplacian`, in at most `limit` iterations; a sample keeps the x that met the tolerance.

    Return x, P x / rows, and which samples met it.
    """
    inverse, unit, per_row = (divide(torch.ones_like(x), x) for x in (degree, cols, rows))
    x, mean, r = torch.zeros_like(rhs), torch.zeros_like(rows), rhs
    p = inverse * r
    rz = torch.linalg.vecdot(r, p)
    target = torch.linalg.vecdot(unit * r, r) * tolerance**2
    active = rz > 0
    solved = ~active
    between_tests = 1 if rhs.is_cpu else BETWEEN_TESTS
    for k in range(limit):
        if k % between_tests == 0 and not bool(active.any()):
            break
        mean_p = per_row * plan.times(p)
        sp = cols * p - plan.transpose_times(mean_p)
        curvature = torch.linalg.vecdot(p, sp)
        active = active & (curvature > 0)
        step = torch.where(active, rz / curvature, 0).unsqueeze(-1)
        x, mean, r = x + step * p, mean + step * mean_p, r - step * sp
        done = active & (torch.linalg.vecdot(unit * r, r) <= target)
        solved, active = solved | done, active & ~done
        z = inverse * r
        previous, rz = rz, torch.linalg.vecdot(r, z)
        p = z + divide(rz, previous).unsqueeze(-1) * p
    return x, mean, solved


def _solve_by_cholesky(plan: Float[Tensor, "b m n"], rows: Tensor, cols: Tensor, rhs: Tensor) -> LinearSolution:
    """Solve S b = rhs by a Cholesky factorisation and one refinement, in float64.

    A diagonal entry is computed as the sum of the other entries of its row: as a difference from `cols` it would be
    noise when P is almost a permutation.
    """
    per_row, unit = (divide(torch.ones_like(x), x) for x in (rows, cols))
    system = plan.mT @ (plan * -per_row.unsqueeze(-1))
    diagonal = system.diagonal(dim1=-2, dim2=-1)
    diagonal.zero_()
    # Between groups of columns that hardly share a row, the right-hand side is rounding error and S nearly singular.
    # The ridge, relative to the marginals, keeps the difference of their b small where it hardly matters.
    ridge = RIDGE * cols
    diagonal.copy_(torch.where(cols > 0, ridge - system.sum(-1), 1))
    factor, _ = torch.linalg.cholesky_ex(system)
    b, left = torch.zeros_like(rhs), rhs
    for _ in range(2):
        b = b + torch.cholesky_solve(left.unsqueeze(-1), factor).squeeze(-1)
        left = rhs - torch.where(cols > 0, transpose_times(system, b) - ridge * b, 0)
    b = torch.where(cols > 0, b - _mean(b, cols), 0)
    solved = torch.linalg.vecdot(unit * left, left) <= FACTORISED**2 * torch.linalg.vecdot(unit * rhs, rhs)
    return b, per_row * times(plan, b), solved


def _mean(b: Float[Tensor, "b n"], cols: Float[Tensor, "b n"]) -> Float[Tensor, "b 1"]:
    """Return the component along the null vector: the mean of b weighted by `cols`."""
    return (cols * b).sum(-1, keepdim=True) / cols.sum(-1, keepdim=True)


def entropic_plan(
    plan: Float[Tensor, "b m n"],
    cost: Float[Tensor, "b m n"],
    mu: Float[Tensor, ""],
    row_marginal: Float[Tensor, "b m"],
    col_marginal: Float[Tensor, "b n"],
    backward_stats: BackwardStats | None,
) -> Float[Tensor, "b m n"]:
    """Return `plan` with the gradients of the transport problem that it solves.

    `plan` minimises <P, cost> + mu P (log P - 1) with the given marginals r and c. With V = dL/dP and multipliers a, b
    from [diag(P1) P; P^T diag(P^T 1)] [a; b] = [(P.V)1; (P.V)^T 1], the gradients are

    dL/dcost = -P.(V - a1^T - 1b^T)/mu, dL/dmu = <dL/dcost, log P>, dL/drow = a, dL/dcol = b,

    up to one constant added to a and subtracted from b, chosen so that the mean of b, weighted by c, is zero. The
    actual sums of P are used, so that a plan short of convergence has the gradient of the problem that it does solve.
    """
    return _EntropicPlan.apply(plan, cost, mu, row_marginal, col_marginal, backward_stats)


class _EntropicPlan(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, plan: Tensor, cost: Tensor, mu: Tensor, rows: Tensor, cols: Tensor, stats: BackwardStats | None
    ) -> Tensor:
        ctx.save_for_backward(plan, mu)
        ctx.stats = stats
        return plan.view_as(plan)

    @staticmethod
    @first_derivative
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        plan, mu = ctx.saved_tensors
        a, b, converged = solve_multipliers(plan, gradient)
        record(ctx.stats, "sinkhorn", converged)
        to_cost = _project_gradient(plan, gradient, a, b, -1 / mu)
        to_mu = torch.special.xlogy(to_cost, plan).sum() if ctx.needs_input_grad[2] else None
        return None, to_cost, to_mu, a, b, None


def _project_gradient(
    plan: Tensor, gradient: Tensor, a: Tensor, b: Tensor, factor: float | Tensor = 1.0
) -> Float[Tensor, "b m n"]:
    """Return factor P.(V - a1^T - 1b^T), (b, m, n)."""
    result = torch.empty_like(plan)
    for out, p, v, x, y in cached_parts(result, plan, gradient, a, b):
        torch.sub(v, x.unsqueeze(-1), out=out).sub_(y.unsqueeze(-2)).mul_(p).mul_(factor)
    return result


def solve_multipliers(
    plan: Float[Tensor, "b m n"], gradient: Float[Tensor, "b m n"]
) -> tuple[Float[Tensor, "b m"], Float[Tensor, "b n"], Bool[Tensor, " b"]]:
    """Compute the multipliers (a, b) that project V = dL/dP onto plans with the marginals of P; sum(P^T 1 . b) = 0.

    Two kinds of samples are solved in float64, and by a Cholesky factorisation at last: those whose plan is sharp,
    where differences of nearly equal numbers decide, and those that stall. The third result is which samples converged.
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
    """Run `_solve` for a few samples at a time."""
    parts = [_solve(p, v, tolerance) for p, v in cached_parts(plan, gradient)]
    return tuple(map(torch.cat, zip(*parts, strict=True)))


def _solve(plan: Tensor, gradient: Tensor, tolerance: float) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Solve for the multipliers a, b in the precision of the plan; return them, which are solved and which precisely.

    These are tensors (b, m), (b, n), (b,) and (b,), of P and V = dL/dP (b, m, n).
    """
    weighted, rows, cols, kernel = plan * gradient, plan.sum(-1), plan.sum(-2), Plan.of(plan)
    row_mean, degree = divide(weighted.sum(-1), rows), kernel.degree(rows, cols)
    rhs = weighted.sum(-2) - transpose_times(plan, row_mean)
    b, mean, solved = solve_laplacian(kernel, rows, cols, degree, rhs, torch.full_like(rhs[:, 0], tolerance))
    a = row_mean - mean
    if plan.dtype == torch.float64 and not bool(solved.all()):
        # Weak links between groups of columns may leave only rounding error on the right-hand side, which no solver
        # can meet to a relative tolerance. It is enough that the column sums of the projected gradient are rounding.
        sums, size = _project_gradient(plan, gradient, a, b).sum(-2), (plan * gradient.square()).sum((-2, -1))
        solved = solved | ((divide(sums.square(), cols).sum(-1) <= ROUNDING**2 * size) & size.isfinite())
    return a, b, solved, solved & (cols.sum(-1) <= SHARP * degree.sum(-1))
