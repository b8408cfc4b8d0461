"""Forward solver of the entropic transport problem: scalings, Newton steps, and annealing for small mu.

The plan is P = exp((u + v - M) / mu). Rescaling rows and columns in turn converges linearly, and slowly once P is
nearly a permutation; Newton's method on the multipliers (the system of `bpnp.layers.laplacian`) is quadratic there.
"""

import math

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from bpnp.layers.laplacian import newton_direction
from bpnp.layers.pacing import steps, unfinished, waits
from bpnp.types import SolveStats

SWEEPS_BEFORE_NEWTON = 16
STEPS_IN_FLOAT32 = 28  # a sample that is not done by then is short of digits, not of steps
STEPS_ON_GPU = 24
NEWTON_RADIUS = 2.0  # largest first change of a log scaling
COARSEST = 0.05  # annealing starts at this part of the range of the costs
COOLING = 4.0
SWEEPS_PER_TEMPERATURE = 5


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
    u, v = _anneal(cost, rows, cols, mu)
    plan = ((u.unsqueeze(-1) + v.unsqueeze(-2) - cost) / mu).exp_()
    iterations = torch.ones(len(cost), dtype=torch.long, device=cost.device)
    residual = (plan.sum(-1) - rows).abs().sum(-1)
    radius = torch.full_like(residual, NEWTON_RADIUS)
    # Samples that are not done have all taken the same steps: which ones share the batch does not matter to any.
    taken, last = 1, steps(max_iterations, cost.device, STEPS_ON_GPU)
    enough = min(STEPS_IN_FLOAT32, last) if plan.dtype == torch.float32 else last
    while taken < enough and unfinished(active := residual > tolerance):
        some = _worked_on(active)
        part, part_rows, part_cols, part_active = plan[some], rows[some], cols[some], active[some]
        sweeps = 1
        if taken < SWEEPS_BEFORE_NEWTON:
            sweeps = min(SWEEPS_BEFORE_NEWTON, enough) - taken
        else:
            part, radius[some] = _newton(part, part_rows, part_cols, radius[some], part_active)
        part, part_residual, part_sweeps = _sweep(part, part_rows, part_cols, part_active, tolerance, sweeps)
        taken += sweeps
        residual[some] = torch.where(part_active, part_residual, residual[some])
        iterations[some] += part_sweeps
        plan = plan.index_copy(0, some, part) if len(some) < len(plan) else part
    # Afresh in float64: entries that underflow in float32 do not come back.
    if taken < last and not waits(cost.device) and len(some := (residual > tolerance).nonzero().squeeze(-1)):
        exact, stats = solve_plan(
            cost[some].double(),
            rows[some].double(),
            cols[some].double(),
            mu=mu.double() if isinstance(mu, Tensor) else mu,
            tolerance=tolerance,
            max_iterations=max_iterations - taken,
        )
        plan = plan.index_copy(0, some, exact.to(plan.dtype))
        residual[some] = stats.residual.to(residual.dtype)
        iterations[some] += stats.iterations
    return plan, SolveStats(iterations, residual, residual <= tolerance)


def _worked_on(active: Bool[Tensor, " b"]) -> Int[Tensor, " s"]:
    """The samples that steps are computed for: the active ones, or all where it costs a wait to know them."""
    if waits(active.device):
        return torch.arange(len(active), device=active.device)
    return active.nonzero().squeeze(-1)


def _sweep(
    plan: Tensor, rows: Tensor, cols: Tensor, active: Bool[Tensor, " b"], tolerance: float, sweeps: int
) -> tuple[Float[Tensor, "b m n"], Float[Tensor, " b"], Int[Tensor, " b"]]:
    """Rescale rows, then columns, up to `sweeps` times; each sample stops at the tolerance."""
    alpha, beta = torch.ones_like(rows), torch.ones_like(cols)
    row_sums = plan.sum(-1)
    residual = torch.full_like(row_sums[:, 0], torch.inf)
    taken = torch.zeros_like(active, dtype=torch.long)
    for _ in range(sweeps):
        if not unfinished(active):
            break
        alpha = _rescale(alpha, rows / row_sums, active)
        column_sums = (alpha.unsqueeze(-2) @ plan).squeeze(-2)
        beta = _rescale(beta, cols / (beta * column_sums), active)
        row_sums = (plan @ beta.unsqueeze(-1)).squeeze(-1) * alpha
        residual = torch.where(active, (row_sums - rows).abs().sum(-1), residual)
        taken += active
        active = active & (residual > tolerance)
    return plan * alpha.unsqueeze(-1) * beta.unsqueeze(-2), residual, taken


def _rescale(scaling: Tensor, factor: Tensor, active: Tensor) -> Tensor:
    """Padded points, whose factor is 0/0, keep their scaling, and so do samples that have stopped."""
    return torch.where(active.unsqueeze(-1) & (factor > 0) & factor.isfinite(), scaling * factor, scaling)


def _newton(
    plan: Tensor, rows: Tensor, cols: Tensor, radius: Tensor, active: Bool[Tensor, " b"]
) -> tuple[Tensor, Tensor]:
    """One Newton step inside a trust radius, taken if it does not lower the (concave) dual objective."""
    x, y = newton_direction(plan, rows, cols)
    size = torch.maximum(x.abs().amax(-1), y.abs().amax(-1))
    shrink = (radius / size.clamp_min(torch.finfo(size.dtype).tiny)).clamp_max(1).unsqueeze(-1)
    x, y = x * shrink, y * shrink
    trial = plan * x.exp().unsqueeze(-1) * y.exp().unsqueeze(-2)
    gain = (rows * x).sum(-1) + (cols * y).sum(-1) - (trial.sum((-2, -1)) - plan.sum((-2, -1)))
    noise = 16 * torch.finfo(plan.dtype).eps
    accept = active & (gain >= -noise)
    return torch.where(accept[:, None, None], trial, plan), torch.where(accept, 2 * radius, radius / 4)


def _anneal(cost: Tensor, rows: Tensor, cols: Tensor, mu: float | Tensor) -> tuple[Tensor, Tensor]:
    """Potentials (u, v) from which the plan at `mu` neither over- nor underflows; its column sums hold exactly.

    Log-domain sweeps at falling temperatures, each sample from its own range of costs down to mu, where one sweep
    ends it. A point without mass has the potential -inf.
    """
    real = (rows > 0).unsqueeze(-1) & (cols > 0).unsqueeze(-2) & cost.isfinite()
    highest = cost.masked_fill(~real, -math.inf).amax((-2, -1))
    lowest = cost.masked_fill(~real, math.inf).amin((-2, -1))
    coldest = torch.zeros_like(highest) + mu
    warm = torch.maximum(COARSEST * (highest - lowest), coldest)
    log_r, log_c = rows.log(), cols.log()
    v = torch.where(cols > 0, 0.0, -math.inf).to(cost.dtype)
    left = _coolings_on_gpu(mu) if waits(cost.device) else math.inf
    while left > 0 and unfinished(warm > coldest):
        v_new = v
        for _ in range(SWEEPS_PER_TEMPERATURE):
            _, v_new = _log_sweep(cost, log_r, log_c, v_new, warm[:, None])
        v = torch.where((warm > coldest).unsqueeze(-1), v_new, v)
        warm = torch.maximum(warm / COOLING, coldest)
        left -= 1
    return _log_sweep(cost, log_r, log_c, v, coldest[:, None])


def _coolings_on_gpu(mu: float | Tensor) -> int:
    """Temperatures above mu for costs between unit features, in [0, 2]; mu is not read back if it is a tensor."""
    if isinstance(mu, Tensor):
        return 2
    return max(0, math.ceil(math.log(2 * COARSEST / mu, COOLING)))


def _log_sweep(cost: Tensor, log_r: Tensor, log_c: Tensor, v: Tensor, mu: Tensor) -> tuple[Tensor, Tensor]:
    scaled = cost / -mu.unsqueeze(-1)
    u = log_r - torch.logsumexp(scaled + (v / mu).unsqueeze(-2), -1)
    v = log_c - torch.logsumexp(scaled + u.unsqueeze(-1), -2)
    return mu * u, mu * v
