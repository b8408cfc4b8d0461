"""Forward solver of the entropic transport problem: Sinkhorn sweeps, Newton steps, and annealing for small mu.

The plan is P = diag(alpha) K diag(beta) with K = exp((u + v - M) / mu) from potentials near the optimum. K is computed
once, and again only if the scalings grow so far that entries which underflowed might matter. All other work is products
of K with vectors.

Rescaling rows and columns in turn (a sweep) converges linearly, and slowly once points share their probability with
neighbours or P is nearly a permutation. There Newton's method on the multipliers converges quadratically. It solves the
system of `bpnp.layers.laplacian` by conjugate gradients, to no more digits than the step has.
"""

import math
from dataclasses import replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from bpnp.layers.laplacian import solve_laplacian
from bpnp.layers.scaled_plan import Plan, cached_parts, divide
from bpnp.types import SolveStats

SWEEPS = 4  # before the first Newton step
SWEEPS_PER_TEMPERATURE = 5
ITERATIONS_IN_FLOAT32 = 28  # a sample that has not converged by then needs more digits, not more iterations
NEWTON_RADIUS = 2.0  # largest change of a log scaling in the first Newton step
LOOSEST, SAFETY = 0.3, 0.8  # Newton step: largest relative error of its system, and target error per tolerance
COARSEST = 0.05  # first temperature of the annealing, as a fraction of the range of the costs
COOLING = 4.0  # ratio of successive temperatures
LARGEST_LOG_SCALING = 20.0  # even twice this is far from underflow of K in float32


def solve_plan(
    cost: Float[Tensor, "b m n"],
    rows: Float[Tensor, "b m"],
    cols: Float[Tensor, "b n"],
    *,
    mu: Float[Tensor, ""],
    tolerance: float,
    max_iterations: int,
) -> tuple[Float[Tensor, "b m n"], SolveStats]:
    """Compute the plan whose row and column sums meet the marginals; a point with zero marginal gets no mass.

    The sums of a sample have at most the L1 error `tolerance`; mu, the entropy weight, is float64. Samples for which
    float32 has too few digits are solved again in float64. The `iterations` of the stats count sweeps; a late sweep
    follows a Newton step.
    """
    limit = torch.full((len(cost),), max_iterations, device=cost.device)
    plan, iterations, residual = _solve_parts(cost, rows, cols, limit, mu, tolerance)
    remaining = limit - iterations
    hard = (residual > tolerance) & (remaining > 0)
    if cost.dtype != torch.float64 and bool(hard.any()):
        some = hard.nonzero().squeeze(-1)
        problem = cost[some].double(), rows[some].double(), cols[some].double()
        exact_plan, more, exact_residual = _solve_parts(*problem, remaining[some], mu, tolerance)
        plan[some], residual[some] = exact_plan.to(plan.dtype), exact_residual.to(residual.dtype)
        iterations[some] += more
    return plan, SolveStats(iterations, residual, residual <= tolerance)


def _solve_parts(
    cost: Tensor, rows: Tensor, cols: Tensor, limit: Int[Tensor, " b"], mu: Tensor, tolerance: float
) -> tuple[Tensor, ...]:
    """Solve a few samples at a time; return the plan, the iterations and the residuals."""
    plan = cost.new_empty(cost.shape)
    parts = cached_parts(plan, cost, rows, cols, limit)
    ends = [_solve(k, m, r, c, most, mu, tolerance) for k, m, r, c, most in parts]
    return plan, *map(torch.cat, zip(*ends, strict=True))


def _solve(
    kernel: Tensor, cost: Tensor, rows: Tensor, cols: Tensor, limit: Int[Tensor, " b"], mu: Tensor, tolerance: float
) -> tuple[Int[Tensor, " b"], Float[Tensor, " b"]]:
    """Write the plans to `kernel`; return iterations and residuals, in the precision of the cost.

    All active samples have taken the same steps, so a result does not depend on the other samples of the batch.
    """
    temperature = mu.to(cost.dtype).expand(len(cost))
    u, v, plan = _anneal(kernel, cost, rows, cols, temperature)
    limit = limit.clamp_max(ITERATIONS_IN_FLOAT32) if cost.dtype == torch.float32 else limit
    plan, sums, residual, iterations = sweep(plan, plan.row_sums(), rows, cols, limit.clamp_max(SWEEPS), tolerance)
    radius = torch.full_like(residual, NEWTON_RADIUS)
    live = torch.ones_like(residual, dtype=torch.bool)  # the last Newton step had enough digits
    while bool((active := live & (residual > tolerance) & (iterations < limit)).any()):
        u, v, plan, sums = _absorb(u, v, plan, sums, cost, temperature, active)
        some = active.nonzero().squeeze(-1)
        goal = rows[some], cols[some]
        part, part_sums, radius[some], live[some] = _newton(
            plan.samples(some), sums[some], *goal, radius[some], tolerance
        )
        one = torch.ones_like(some)
        part, part_sums, residual[some], _ = sweep(part, part_sums, *goal, one, tolerance)
        iterations[some] += 1
        plan = Plan(
            plan.kernel,
            *(old.index_copy(0, some, new) for old, new in ((plan.alpha, part.alpha), (plan.beta, part.beta))),
        )
        sums = sums.index_copy(0, some, part_sums)
    kernel.mul_(plan.alpha.unsqueeze(-1)).mul_(plan.beta.unsqueeze(-2))
    return iterations, residual


def sweep(
    plan: Plan, sums: Float[Tensor, "b m"], rows: Tensor, cols: Tensor, count: Int[Tensor, " b"], tolerance: float
) -> tuple[Plan, Float[Tensor, "b m"], Float[Tensor, " b"], Int[Tensor, " b"]]:
    """Rescale the rows, then the columns, `count` times; a sample stops at the tolerance, the L1 error of its row sums.

    `sums` are the row sums of the plan, `rows` and `cols` the required ones. Return the plan, its row sums, their L1
    error, infinite for a sample without sweeps, and the sweeps taken.
    """
    residual = torch.full_like(sums[:, 0], torch.inf)
    taken = torch.zeros_like(count)
    for k in range(int(count.max())):
        active = (k < count) & (residual > tolerance)
        alpha = _rescale(plan.alpha, rows / sums, active)
        plan = replace(plan, alpha=alpha)
        plan = replace(plan, beta=_rescale(plan.beta, cols / plan.col_sums(), active))
        sums = plan.row_sums()
        residual = torch.where(active, (sums - rows).abs().sum(-1), residual)
        taken += active
    return plan, sums, residual, taken


def _rescale(scaling: Tensor, factor: Tensor, active: Bool[Tensor, " b"]) -> Tensor:
    """Scale by a factor; padded points, whose factor is 0/0, and samples that have stopped keep their scaling."""
    return torch.where(active.unsqueeze(-1) & (factor > 0) & (factor < math.inf), scaling * factor, scaling)


def _newton(
    plan: Plan, sums: Tensor, rows: Tensor, cols: Tensor, radius: Float[Tensor, " b"], tolerance: float
) -> tuple[Plan, Float[Tensor, "b m"], Float[Tensor, " b"], Bool[Tensor, " b"]]:
    """Take one Newton step inside a trust region, unless it lowers the (concave) dual objective.

    The change (x, y) of the log scalings gives diag(e^x) P diag(e^y) the marginals to first order. The columns meet
    theirs before the step. Return the plan, its row sums, the new radius, and which samples continue: those whose
    direction was computed to enough digits.
    """
    error = (sums - rows).abs().sum(-1)
    precision = torch.maximum(SAFETY * tolerance / error, error.sqrt().clamp_max(LOOSEST))
    row_error = divide(rows - sums, sums)
    # In float32 a step has few digits; the marginals precondition well enough and need no pass over the plan.
    degree = plan.degree(sums, cols) if cols.dtype == torch.float64 else cols
    y, mean, solved = solve_laplacian(plan, sums, cols, degree, -plan.transpose_times(row_error), precision)
    x = row_error - mean
    size = torch.maximum(x.abs().amax(-1), y.abs().amax(-1))
    shrink = (radius / size.clamp_min(torch.finfo(size.dtype).tiny)).clamp_max(1).unsqueeze(-1)
    x, y = x * shrink, y * shrink
    new = Plan(plan.kernel, plan.alpha * x.exp(), plan.beta * y.exp())
    new_sums = new.row_sums()
    gain = (rows * x).sum(-1) + (cols * y).sum(-1) - (new_sums - sums).sum(-1)
    accept = gain >= -16 * torch.finfo(rows.dtype).eps
    alpha, beta, sums = (
        torch.where(accept.unsqueeze(-1), changed, kept)
        for changed, kept in ((new.alpha, plan.alpha), (new.beta, plan.beta), (new_sums, sums))
    )
    continues = solved | (rows.dtype == torch.float64)
    return Plan(plan.kernel, alpha, beta), sums, torch.where(accept, 2 * radius, radius / 4), continues


def _anneal(
    kernel: Tensor, cost: Tensor, rows: Tensor, cols: Tensor, mu: Float[Tensor, " b"]
) -> tuple[Tensor, Tensor, Plan]:
    """Compute potentials u, v from which the plan at `mu` neither over- nor underflows, and that plan, in `kernel`.

    Sweeps at falling temperatures, each sample from its own range of costs down to mu. At each temperature the largest
    entry of every row is one at first. A point without mass has the potential -inf. A sample in which a point has no
    finite cost has no plan: all of it is NaN.
    """
    extent = _range(cost, rows, cols)
    mu = torch.where(extent.isnan(), torch.nan, mu)
    warm = torch.maximum(COARSEST * extent, mu)
    v = torch.where(cols > 0, 0.0, -math.inf).to(cost.dtype)
    while bool((cooling := warm > mu).any()):
        _, plan = _from_row_minima(cost, rows, v, warm, kernel)
        plan, *_ = sweep(plan, plan.row_sums(), rows, cols, SWEEPS_PER_TEMPERATURE * cooling, 0.0)
        v = v + torch.where(cooling, warm, 0).unsqueeze(-1) * plan.beta.log()
        warm = torch.maximum(warm / COOLING, mu)
    u, plan = _from_row_minima(cost, rows, v, mu, kernel)
    return u, v, plan


def _from_row_minima(
    cost: Tensor, rows: Tensor, v: Tensor, mu: Float[Tensor, " b"], kernel: Tensor
) -> tuple[Float[Tensor, "b m"], Plan]:
    """Return u for which the largest entry of each row of K is one, and K, written to `kernel`.

    u is -inf in rows without mass.
    """
    u = torch.sub(cost, v.unsqueeze(-2), out=kernel).amin(-1)
    u = torch.where(rows > 0, u, -math.inf)
    return u, Plan.of(kernel.sub_(u.unsqueeze(-1)).div_(-mu[:, None, None]).exp_())


def _absorb(
    u: Tensor, v: Tensor, plan: Plan, sums: Tensor, cost: Tensor, mu: Tensor, active: Bool[Tensor, " b"]
) -> tuple[Tensor, Tensor, Plan, Tensor]:
    """Move large scalings of active samples into the potentials, and recompute their K in place.

    Works sample by sample, because K may take most of the memory.
    """
    log_alpha, log_beta = plan.alpha.log(), plan.beta.log()
    large = active & (torch.maximum(log_alpha.abs().amax(-1), log_beta.abs().amax(-1)) > LARGEST_LOG_SCALING)
    if not bool(large.any()):
        return u, v, plan, sums
    move = torch.where(large, mu, 0).unsqueeze(-1)
    u, v = u + move * log_alpha, v + move * log_beta
    for i in large.nonzero().flatten().tolist():
        kernel = torch.sub(u[i].unsqueeze(-1), cost[i], out=plan.kernel[i])
        kernel.add_(v[i]).div_(mu[i]).exp_()
    absorbed = large.unsqueeze(-1)
    plan = Plan(plan.kernel, torch.where(absorbed, 1, plan.alpha), torch.where(absorbed, 1, plan.beta))
    return u, v, plan, torch.where(absorbed, plan.row_sums(), sums)


def _range(cost: Tensor, rows: Tensor, cols: Tensor) -> Float[Tensor, " b"]:
    """Return the difference of the largest and the smallest finite cost between points with mass (b,).

    It is NaN where a point with mass has no finite cost.
    """
    highest, lowest = cost.amax(-1), cost.amin(-1)
    blocked = torch.zeros_like(highest[:, 0], dtype=torch.bool)
    if not bool((cols > 0).all() & highest.isfinite().all()):
        real = (cols > 0).unsqueeze(-2) & (rows > 0).unsqueeze(-1) & cost.isfinite()
        highest = torch.where(real, cost, -math.inf).amax(-1)
        lowest = torch.where(real, cost, math.inf).amin(-1)
        blocked = ((rows > 0) & ~real.any(-1)).any(-1) | ((cols > 0) & ~real.any(-2)).any(-1)
    highest, lowest = torch.where(rows > 0, highest, -math.inf), torch.where(rows > 0, lowest, math.inf)
    return torch.where(blocked, torch.nan, highest.amax(-1) - lowest.amin(-1))
