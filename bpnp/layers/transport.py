"""Forward solver of the entropic transport problem: scalings, Newton steps, and annealing for small mu.

The plan is P = diag(alpha) K diag(beta), K = exp((u + v - M) / mu) from potentials near the optimum. K is made once,
and again only if the scalings grow so far that entries which underflowed might matter; in between all work is products
of K with vectors. Rescaling rows and columns in turn converges linearly, and slowly once points share their probability
with neighbours or P is nearly a permutation. Newton's method on the multipliers (the system of `bpnp.layers.adjoint`,
by conjugate gradients to no more digits than the step has) is quadratic there.
"""

import math
from dataclasses import replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from bpnp.layers.adjoint import Plan, newton_direction, times
from bpnp.layers.memory import empty
from bpnp.layers.pacing import steps, unfinished, waits
from bpnp.layers.scalings import Scaled, absorb, from_row_minima, sweep
from bpnp.types import SolveStats

SWEEPS_BEFORE_NEWTON = 4
SWEEPS_BEFORE_NEWTON_ON_GPU = 16
STEPS_IN_FLOAT32 = 28  # a sample that is not done by then is short of digits, not of steps
STEPS_ON_GPU = 24
NEWTON_RADIUS = 2.0  # largest first change of a log scaling
LOOSEST, SAFETY = 0.3, 0.8  # of a Newton step: relative error, and the error to end at per tolerance
COARSEST = 0.05  # annealing starts at this part of the range of the costs
COOLING = 4.0
SWEEPS_PER_TEMPERATURE = 5
CACHE = 2**24  # bytes of K that are worked on together on a CPU: products with it come from the cache


def solve_plan(
    cost: Float[Tensor, "b m n"],
    rows: Float[Tensor, "b m"],
    cols: Float[Tensor, "b n"],
    *,
    mu: float | Tensor,
    tolerance: float,
    max_iterations: int,
) -> tuple[Float[Tensor, "b m n"], SolveStats]:
    """Plan with column sums `cols` and row sums `rows` to an L1 error of `tolerance`, sample by sample.

    A point with zero marginal takes no part. Iterations count pairs of scalings; a late one follows a Newton step. A
    GPU takes at most `STEPS_ON_GPU` and is not waited for.
    """
    plan = empty(cost.shape, dtype=cost.dtype, device=cost.device)
    size = len(cost) if waits(cost.device) else max(1, CACHE // (cost[0].numel() * cost.element_size()))
    parts = []
    for start in range(0, len(cost), size):
        some = slice(start, start + size)
        parts.append(_solve(cost[some], rows[some], cols[some], plan[some], mu, tolerance, max_iterations))
    iterations, residual = (torch.cat(values) for values in zip(*parts, strict=True))
    # Afresh in float64 where float32 has too few digits.
    left = max_iterations - iterations
    hard = (residual > tolerance) & (left > 0)
    alike = [] if cost.dtype == torch.float64 or waits(cost.device) else left[hard].unique().tolist()
    for limit in alike:
        some = (hard & (left == limit)).nonzero().squeeze(-1)
        exact, stats = solve_plan(
            cost[some].double(),
            rows[some].double(),
            cols[some].double(),
            mu=mu.double() if isinstance(mu, Tensor) else mu,
            tolerance=tolerance,
            max_iterations=limit,
        )
        plan[some] = exact.to(plan.dtype)
        residual[some] = stats.residual.to(residual.dtype)
        iterations[some] += stats.iterations
    return plan, SolveStats(iterations, residual, residual <= tolerance)


def _solve(
    cost: Tensor, rows: Tensor, cols: Tensor, plan: Tensor, mu: float | Tensor, tolerance: float, max_iterations: int
) -> tuple[Int[Tensor, " b"], Float[Tensor, " b"]]:
    """Fill `plan`; iterations and residuals."""
    temperature = torch.zeros_like(rows[:, 0]) + mu
    coolings = _coolings_on_gpu(mu) if waits(cost.device) else math.inf
    state = _anneal(cost, rows, cols, temperature, plan, coolings)
    iterations = torch.zeros(len(cost), dtype=torch.long, device=cost.device)
    residual = torch.full_like(temperature, torch.inf)
    radius = torch.full_like(temperature, NEWTON_RADIUS)
    # Samples that are not done have all taken the same steps: which ones share the batch does not matter to any.
    taken, last = 0, steps(max_iterations, cost.device, STEPS_ON_GPU)
    last = min(STEPS_IN_FLOAT32, last) if plan.dtype == torch.float32 else last
    first = min(SWEEPS_BEFORE_NEWTON_ON_GPU if waits(cost.device) else SWEEPS_BEFORE_NEWTON, last)
    active = torch.ones_like(residual, dtype=torch.bool)
    while taken < last and unfinished(active):
        if taken:
            state = absorb(state, cost, temperature, active)
        some = _worked_on(active)
        part, sweeps, exact = state.samples(some), 1 if taken else first, active[some]
        if taken:
            part, radius[some], exact = _newton(part, rows[some], cols[some], radius[some], active[some], tolerance)
        part, part_residual, part_sweeps = sweep(part, rows[some], cols[some], active[some], tolerance, sweeps)
        taken += sweeps
        state = state.with_scalings(some, part)
        residual[some] = torch.where(active[some], part_residual, residual[some])
        iterations[some] += part_sweeps
        active = active.index_copy(0, some, exact & (part_residual > tolerance))
    plan.mul_(state.alpha.unsqueeze(-1)).mul_(state.beta.unsqueeze(-2))
    return iterations, residual


def _worked_on(active: Bool[Tensor, " b"]) -> Int[Tensor, " s"]:
    """The samples that steps are computed for: the active ones, or all where it costs a wait to know them."""
    if waits(active.device):
        return torch.arange(len(active), device=active.device)
    return active.nonzero().squeeze(-1)


def _newton(
    state: Scaled, rows: Tensor, cols: Tensor, radius: Tensor, active: Bool[Tensor, " b"], tolerance: float
) -> tuple[Scaled, Float[Tensor, " b"], Bool[Tensor, " b"]]:
    """One Newton step inside a trust radius, taken if it does not lower the (concave) dual objective.

    The new radius, and which samples go on: those whose direction the precision can tell.
    """
    error = (state.row_sums - rows).abs().sum(-1)
    precision = torch.maximum(SAFETY * tolerance / error, error.sqrt().clamp_max(LOOSEST))
    plan = Plan(state.kernel, state.alpha, state.beta)
    x, y, solved = newton_direction(plan, state.row_sums, rows, cols, precision)
    size = torch.maximum(x.abs().amax(-1), y.abs().amax(-1))
    shrink = (radius / size.clamp_min(torch.finfo(size.dtype).tiny)).clamp_max(1).unsqueeze(-1)
    x, y = x * shrink, y * shrink
    alpha, beta = state.alpha * x.exp(), state.beta * y.exp()
    row_sums = alpha * times(state.kernel, beta)
    gain = (rows * x).sum(-1) + (cols * y).sum(-1) - (row_sums - state.row_sums).sum(-1)
    accept = active & (gain >= -16 * torch.finfo(rows.dtype).eps)
    alpha, beta, row_sums = (
        torch.where(accept.unsqueeze(-1), new, old)
        for new, old in ((alpha, state.alpha), (beta, state.beta), (row_sums, state.row_sums))
    )
    return (
        replace(state, alpha=alpha, beta=beta, row_sums=row_sums),
        torch.where(accept, 2 * radius, radius / 4),
        solved,
    )


def _anneal(
    cost: Tensor, rows: Tensor, cols: Tensor, mu: Float[Tensor, " b"], kernel: Tensor, coolings: float
) -> Scaled:
    """Potentials from which the plan at `mu` neither over- nor underflows, and K in `kernel`.

    Sweeps at falling temperatures, each sample from its own range of costs down to mu. Each temperature starts with the
    largest entry of every row at one. A point without mass has the potential -inf.
    """
    warm = torch.maximum(COARSEST * _range(cost, rows, cols), mu)
    v = torch.where(cols > 0, 0.0, -math.inf).to(cost.dtype)
    while coolings > 0 and unfinished(cooling := warm > mu):
        state = from_row_minima(cost, rows, v, warm, kernel)
        state, _, _ = sweep(state, rows, cols, cooling, 0.0, SWEEPS_PER_TEMPERATURE)
        v = v + torch.where(cooling, warm, 0).unsqueeze(-1) * state.beta.log()
        warm = torch.maximum(warm / COOLING, mu)
        coolings -= 1
    return from_row_minima(cost, rows, v, mu, kernel)


def _coolings_on_gpu(mu: float | Tensor) -> float:
    """Temperatures above mu for costs between unit features, in [0, 2]; mu is not read back if it is a tensor."""
    if isinstance(mu, Tensor):
        return 2.0
    return max(0.0, float(math.ceil(math.log(2 * COARSEST / mu, COOLING))))


def _range(cost: Tensor, rows: Tensor, cols: Tensor) -> Float[Tensor, " b"]:
    """Difference of the largest and the smallest finite cost between points with mass."""
    highest, lowest = cost.amax(-1), cost.amin(-1)
    if waits(cost.device) or not bool((cols > 0).all() & highest.isfinite().all()):
        real = (cols > 0).unsqueeze(-2) & cost.isfinite()
        highest = torch.where(real, cost, -math.inf).amax(-1)
        lowest = torch.where(real, cost, math.inf).amin(-1)
    highest, lowest = torch.where(rows > 0, highest, -math.inf), torch.where(rows > 0, lowest, math.inf)
    return highest.amax(-1) - lowest.amin(-1)
