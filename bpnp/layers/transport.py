"""Forward solver of the entropic transport problem: scalings, Newton steps, and annealing for small mu.

The plan is P = diag(alpha) K diag(beta), K = exp((u + v - M) / mu) from potentials near the optimum. K is made once,
and again only if the scalings grow so far that entries which underflowed might matter; in between all work is products
of K with vectors. Rescaling rows and columns in turn converges linearly, and slowly once points share their probability
with neighbours or P is nearly a permutation. Newton's method on the multipliers (the system of `bpnp.layers.laplacian`,
by conjugate gradients to no more digits than the step has) is quadratic there.
"""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from bpnp.layers.laplacian import Plan, newton_direction, times, transpose_times
from bpnp.layers.pacing import steps, unfinished, waits
from bpnp.types import SolveStats

SWEEPS_BEFORE_NEWTON = 4
SWEEPS_BEFORE_NEWTON_ON_GPU = 16
STEPS_IN_FLOAT32 = 28  # a sample that is not done by then is short of digits, not of steps
STEPS_ON_GPU = 24
NEWTON_RADIUS = 2.0  # largest first change of a log scaling
LOOSEST, SAFETY = 0.1, 0.3  # of a Newton step: relative error, and the error to end at per tolerance
LARGEST_LOG_SCALING = 20.0  # twice this is far from where entries of K underflow in float32
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
    plan = torch.empty(cost.shape, dtype=cost.dtype, device=cost.device)
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
            state = _absorb(state, cost, temperature)
        some = _worked_on(active)
        part, sweeps, exact = state.samples(some), 1 if taken else first, active[some]
        if taken:
            part, radius[some], exact = _newton(part, rows[some], cols[some], radius[some], active[some], tolerance)
        part, part_residual, part_sweeps = _sweep(part, rows[some], cols[some], active[some], tolerance, sweeps)
        taken += sweeps
        state = state.with_scalings(some, part)
        residual[some] = torch.where(active[some], part_residual, residual[some])
        iterations[some] += part_sweeps
        active = active.index_copy(0, some, exact & (part_residual > tolerance))
    plan.mul_(state.alpha.unsqueeze(-1)).mul_(state.beta.unsqueeze(-2))
    return iterations, residual


@dataclass(frozen=True)
class _State:
    """P = diag(alpha) K diag(beta), K = exp((u + v - M) / mu), and its row sums."""

    kernel: Tensor
    u: Tensor
    v: Tensor
    alpha: Tensor
    beta: Tensor
    row_sums: Tensor

    @classmethod
    def start(cls, kernel: Tensor, u: Tensor, v: Tensor) -> "_State":
        ones = torch.ones_like(v)
        return cls(kernel, u, v, torch.ones_like(u), ones, times(kernel, ones))

    def samples(self, some: Int[Tensor, " s"]) -> "_State":
        if len(some) == len(self.u):
            return self
        return _State(*(x[some] for x in (self.kernel, self.u, self.v, self.alpha, self.beta, self.row_sums)))

    def with_scalings(self, some: Int[Tensor, " s"], part: "_State") -> "_State":
        if len(some) == len(self.u):
            return part
        names = ("alpha", "beta", "row_sums")
        return replace(self, **{x: getattr(self, x).index_copy(0, some, getattr(part, x)) for x in names})


def _worked_on(active: Bool[Tensor, " b"]) -> Int[Tensor, " s"]:
    """The samples that steps are computed for: the active ones, or all where it costs a wait to know them."""
    if waits(active.device):
        return torch.arange(len(active), device=active.device)
    return active.nonzero().squeeze(-1)


def _absorb(state: _State, cost: Tensor, mu: Float[Tensor, " b"]) -> _State:
    """Move large scalings into the potentials and make K of these samples again; on a GPU, of all."""
    log_alpha, log_beta = state.alpha.log(), state.beta.log()
    large = torch.maximum(log_alpha.abs().amax(-1), log_beta.abs().amax(-1)) > LARGEST_LOG_SCALING
    if not unfinished(large):
        return state
    u, v = state.u + mu[:, None] * log_alpha, state.v + mu[:, None] * log_beta
    # Slices, not indices: K is changed in place and may be nearly all the memory there is.
    parts = [slice(None)] if waits(cost.device) else [slice(i, i + 1) for i in large.nonzero().flatten().tolist()]
    values = [x.clone() for x in (state.u, state.v, state.alpha, state.beta, state.row_sums)]
    for some in parts:
        kernel = torch.sub(u[some].unsqueeze(-1), cost[some], out=state.kernel[some])
        kernel.add_(v[some].unsqueeze(-2)).div_(mu[some, None, None]).exp_()
        fresh = _State.start(kernel, u[some], v[some])
        for value, new in zip(values, (fresh.u, fresh.v, fresh.alpha, fresh.beta, fresh.row_sums), strict=True):
            value[some] = new
    return _State(state.kernel, *values)


def _sweep(
    state: _State, rows: Tensor, cols: Tensor, active: Bool[Tensor, " b"], tolerance: float, sweeps: int
) -> tuple[_State, Float[Tensor, " b"], Int[Tensor, " b"]]:
    """Rescale rows, then columns, up to `sweeps` times; each sample stops at the tolerance."""
    kernel, alpha, beta, row_sums = state.kernel, state.alpha, state.beta, state.row_sums
    residual = torch.full_like(row_sums[:, 0], torch.inf)
    taken = torch.zeros_like(active, dtype=torch.long)
    for _ in range(sweeps):
        if not unfinished(active):
            break
        alpha = _rescale(alpha, rows / row_sums, active)
        beta = _rescale(beta, cols / (beta * transpose_times(kernel, alpha)), active)
        row_sums = alpha * times(kernel, beta)
        residual = torch.where(active, (row_sums - rows).abs().sum(-1), residual)
        taken += active
        active = active & (residual > tolerance)
    return replace(state, alpha=alpha, beta=beta, row_sums=row_sums), residual, taken


def _rescale(scaling: Tensor, factor: Tensor, active: Tensor) -> Tensor:
    """Padded points, whose factor is 0/0, keep their scaling, and so do samples that have stopped."""
    return torch.where(active.unsqueeze(-1) & (factor > 0) & factor.isfinite(), scaling * factor, scaling)


def _newton(
    state: _State, rows: Tensor, cols: Tensor, radius: Tensor, active: Bool[Tensor, " b"], tolerance: float
) -> tuple[_State, Float[Tensor, " b"], Bool[Tensor, " b"]]:
    """One Newton step inside a trust radius, taken if it does not lower the (concave) dual objective.

    The new radius, and which samples go on: those whose direction the precision can tell.
    """
    error = (state.row_sums - rows).abs().sum(-1)
    precision = torch.maximum(SAFETY * tolerance / error, error.clamp_max(LOOSEST))
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
) -> _State:
    """Potentials from which the plan at `mu` neither over- nor underflows, and K in `kernel`.

    Sweeps at falling temperatures, each sample from its own range of costs down to mu. Each temperature starts with the
    largest entry of every row at one. A point without mass has the potential -inf.
    """
    warm = torch.maximum(COARSEST * _range(cost, rows, cols), mu)
    v = torch.where(cols > 0, 0.0, -math.inf).to(cost.dtype)
    while coolings > 0 and unfinished(cooling := warm > mu):
        state = _from_row_minima(cost, rows, v, warm, kernel)
        state, _, _ = _sweep(state, rows, cols, cooling, 0.0, SWEEPS_PER_TEMPERATURE)
        v = v + torch.where(cooling, warm, 0).unsqueeze(-1) * state.beta.log()
        warm = torch.maximum(warm / COOLING, mu)
        coolings -= 1
    return _from_row_minima(cost, rows, v, mu, kernel)


def _coolings_on_gpu(mu: float | Tensor) -> int:
    """Temperatures above mu for costs between unit features, in [0, 2]; mu is not read back if it is a tensor."""
    if isinstance(mu, Tensor):
        return 2
    return max(0, math.ceil(math.log(2 * COARSEST / mu, COOLING)))


def _from_row_minima(cost: Tensor, rows: Tensor, v: Tensor, mu: Float[Tensor, " b"], kernel: Tensor) -> _State:
    u = torch.sub(cost, v.unsqueeze(-2), out=kernel).amin(-1)
    u = torch.where(rows > 0, u, -math.inf)
    kernel.sub_(u.unsqueeze(-1)).div_(-mu[:, None, None]).exp_()
    return _State.start(kernel, u, v)


def _range(cost: Tensor, rows: Tensor, cols: Tensor) -> Float[Tensor, " b"]:
    """Difference of the largest and the smallest finite cost between points with mass."""
    highest, lowest = cost.amax(-1), cost.amin(-1)
    if waits(cost.device) or not bool((cols > 0).all() & highest.isfinite().all()):
        real = (cols > 0).unsqueeze(-2) & cost.isfinite()
        highest = torch.where(real, cost, -math.inf).amax(-1)
        lowest = torch.where(real, cost, math.inf).amin(-1)
    highest, lowest = torch.where(rows > 0, highest, -math.inf), torch.where(rows > 0, lowest, math.inf)
    return highest.amax(-1) - lowest.amin(-1)
