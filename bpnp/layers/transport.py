"""Forward solver of the entropic transport problem: Sinkhorn sweeps, Newton steps, and annealing for small mu.

The plan is P = diag(alpha) K diag(beta), K = exp((u + v - M) / mu) from potentials near the optimum. K is made once,
and again only if the scalings grow so far that entries which underflowed might matter; in between all work is products
of K with vectors. Rescaling rows and columns in turn (a sweep) converges linearly, and slowly once points share their
probability with neighbours or P is nearly a permutation. Newton's method on the multipliers (the system of
`bpnp.layers.laplacian`, by conjugate gradients to no more digits than the step has) is quadratic there.
"""

import math
from dataclasses import replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from bpnp.layers.laplacian import solve_laplacian
from bpnp.layers.plan import Plan, cached_parts, divide
from bpnp.types import SolveStats

SWEEPS = 4  # before the first Newton step
SWEEPS_PER_TEMPERATURE = 5
ITERATIONS_IN_FLOAT32 = 28  # a sample that is not done by then lacks digits, not iterations
NEWTON_RADIUS = 2.0  # largest first change of a log scaling
LOOSEST, SAFETY = 0.3, 0.8  # of a Newton step: largest relative error, and the error to end at per tolerance
COARSEST = 0.05  # annealing starts at this part of the range of the costs
COOLING = 4.0  # ratio of two temperatures
LARGEST_LOG_SCALING = 20.0  # twice this is far from where entries of K underflow in float32


def solve_plan(
    cost: Float[Tensor, "b m n"],
    rows: Float[Tensor, "b m"],
    cols: Float[Tensor, "b n"],
    *,
    mu: Float[Tensor, ""],
    tolerance: float,
    max_iterations: int,
) -> tuple[Float[Tensor, "b m n"], SolveStats]:
    """Plan with column sums `cols` and row sums `rows` to an L1 error of `tolerance`, sample by sample.

    A point with zero marginal takes no part. Iterations count sweeps; a late one follows a Newton step. Samples for
    which float32 has too few digits are solved again in float64.
    """
    limit = torch.full((len(cost),), max_iterations, device=cost.device)
    plan, iterations, residual = _solve_parts(cost, rows, cols, limit, mu, tolerance)
    left = limit - iterations
    hard = (residual > tolerance) & (left > 0)
    if cost.dtype != torch.float64 and bool(hard.any()):
        some = hard.nonzero().squeeze(-1)
        problem = cost[some].double(), rows[some].double(), cols[some].double()
        exact_plan, more, exact_residual = _solve_parts(*problem, left[some], mu, tolerance)
        plan[some], residual[some] = exact_plan.to(plan.dtype), exact_residual.to(residual.dtype)
        iterations[some] += more
    return plan, SolveStats(iterations, residual, residual <= tolerance)


def _solve_parts(
    cost: Tensor, rows: Tensor, cols: Tensor, limit: Int[Tensor, " b"], mu: Tensor, tolerance: float
) -> tuple[Tensor, ...]:
    """Plan, iterations and residuals; a few samples at a time."""
    plan = cost.new_empty(cost.shape)
    parts = cached_parts(plan, cost, rows, cols, limit)
    ends = [_solve(k, m, r, c, most, mu, tolerance) for k, m, r, c, most in parts]
    return plan, *map(torch.cat, zip(*ends, strict=True))


def _solve(
    kernel: Tensor, cost: Tensor, rows: Tensor, cols: Tensor, limit: Int[Tensor, " b"], mu: Tensor, tolerance: float
) -> tuple[Int[Tensor, " b"], Float[Tensor, " b"]]:
    """Iterations and residuals, in the precision of the cost; the plan is written to `kernel`.

    Samples that are active have all taken the same steps: which others share the batch does not matter to any.
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
    """Rescale the rows, then the columns, `count` times; a sample stops at the tolerance. sums: P 1.

    Returns the plan, its row sums, their L1 error (infinite for a sample without sweeps) and the sweeps taken.
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
    """Padded points, whose factor is 0/0, keep their scaling, and so do samples that have stopped."""
    return torch.where(active.unsqueeze(-1) & (factor > 0) & (factor < math.inf), scaling * factor, scaling)


def _newton(
    plan: Plan, sums: Tensor, rows: Tensor, cols: Tensor, radius: Float[Tensor, " b"], tolerance: float
) -> tuple[Plan, Float[Tensor, "b m"], Float[Tensor, " b"], Bool[Tensor, " b"]]:
    """One Newton step inside a trust radius, taken if it does not lower the (concave) dual objective.

    Returns the plan, its row sums, the new radius, and which samples go on: those whose direction the precision can
    tell. The change (x, y) of the log scalings gives diag(e^x) P diag(e^y) the marginals, to first order; the columns
    have theirs already.
    """
    error = (sums - rows).abs().sum(-1)
    precision = torch.maximum(SAFETY * tolerance / error, error.sqrt().clamp_max(LOOSEST))
    row_error = divide(rows - sums, sums)
    # For the few digits of a step in float32 the marginals precondition as well, and need no pass over the plan.
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
    goes_on = solved | (rows.dtype == torch.float64)
    return Plan(plan.kernel, alpha, beta), sums, torch.where(accept, 2 * radius, radius / 4), goes_on


def _anneal(
    kernel: Tensor, cost: Tensor, rows: Tensor, cols: Tensor, mu: Float[Tensor, " b"]
) -> tuple[Tensor, Tensor, Plan]:
    """Potentials u, v from which the plan at `mu` neither over- nor underflows, and that plan, in `kernel`.

    Sweeps at falling temperatures, each sample from its own range of costs down to mu. Each temperature starts with the
    largest entry of every row at one. A point without mass has the potential -inf.
    """
    warm = torch.maximum(COARSEST * _range(cost, rows, cols), mu)
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
    """u for which the largest entry of each row of K is one (-inf in rows without mass), and K, written to `kernel`."""
    u = torch.sub(cost, v.unsqueeze(-2), out=kernel).amin(-1)
    u = torch.where(rows > 0, u, -math.inf)
    return u, Plan.of(kernel.sub_(u.unsqueeze(-1)).div_(-mu[:, None, None]).exp_())


def _absorb(
    u: Tensor, v: Tensor, plan: Plan, sums: Tensor, cost: Tensor, mu: Tensor, active: Bool[Tensor, " b"]
) -> tuple[Tensor, Tensor, Plan, Tensor]:
    """Move large scalings of active samples into the potentials and make their K again, in place.

    One sample at a time: K may be nearly all the memory there is.
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
    moved = large.unsqueeze(-1)
    plan = Plan(plan.kernel, torch.where(moved, 1, plan.alpha), torch.where(moved, 1, plan.beta))
    return u, v, plan, torch.where(moved, plan.row_sums(), sums)


def _range(cost: Tensor, rows: Tensor, cols: Tensor) -> Float[Tensor, " b"]:
    """Difference of the largest and the smallest finite cost between points with mass."""
    highest, lowest = cost.amax(-1), cost.amin(-1)
    if not bool((cols > 0).all() & highest.isfinite().all()):
        real = (cols > 0).unsqueeze(-2) & cost.isfinite()
        highest = torch.where(real, cost, -math.inf).amax(-1)
        lowest = torch.where(real, cost, math.inf).amin(-1)
    highest, lowest = torch.where(rows > 0, highest, -math.inf), torch.where(rows > 0, lowest, math.inf)
    return highest.amax(-1) - lowest.amin(-1)
