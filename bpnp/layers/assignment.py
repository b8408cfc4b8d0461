"""Entropic optimal transport from a cost matrix to a joint probability (paper Eqs. 4 and 8), to convergence.

P = argmin <P, M> + mu sum P (log P - 1)  over P >= 0, P 1 = r, P^T 1 = c.
`bpnp.layers.transport` finds the optimum, `bpnp.layers.implicit` knows its derivative.
"""

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from bpnp.layers.implicit import entropic_plan
from bpnp.layers.pacing import waits
from bpnp.layers.transport import solve_plan
from bpnp.precision import full_precision
from bpnp.types import SolveStats


@full_precision
def sinkhorn(
    cost: Float[Tensor, "b m n"],
    *,
    mu: float | Tensor = 0.1,
    row_marginal: Float[Tensor, "b m"] | None = None,
    col_marginal: Float[Tensor, "b n"] | None = None,
    mask2d: Bool[Tensor, "b m"] | None = None,
    mask3d: Bool[Tensor, "b n"] | None = None,
    dustbin: float | Tensor | None = None,
    tolerance: float = 1e-6,
    max_iterations: int = 1000,
) -> tuple[Float[Tensor, "b m n"], SolveStats]:
    """Joint probability of every pair, and per-sample stats.

    cost: M, infinite for a pair that cannot be.
    mu: entropy weight > 0, a number or a scalar tensor (which receives a gradient).
    row_marginal, col_marginal: r and c, each summing to one over real points (default uniform); they receive gradients.
    mask2d, mask3d: True at real points; a padded row or column gets no mass.
    dustbin: cost of leaving a point unmatched, a number or a scalar tensor; None for a full assignment. With it the
        points share their marginals with one bin on each side in the proportion m : n, points to the other side's bin,
        and the assignment sums to less than one.
    tolerance: largest L1 error of the row and of the column sums at which a sample stops.
    max_iterations: pairs of scalings; on cuda at most 24, all of which are taken (a stop would make the host wait), and
        in the cost's own precision: sharp plans in float32 may end short of the tolerance there, and say so.

    Returns the assignment (b, m, n) and stats (residual: that L1 error). Samples stop independently of each other. The
    gradient is that of the optimum (`bpnp.layers.implicit`); its memory is O(m n), whatever the iterations.
    Raises ValueError for mu <= 0 or a sample without a real point on either side.
    """
    mu_tensor = torch.as_tensor(mu, dtype=cost.dtype, device=cost.device)
    if not bool(mu_tensor > 0):
        raise ValueError(f"expected `mu` > 0, got {float(mu_tensor)}; try 0.1")
    b, m, n = cost.shape
    real2d = cost.new_ones(b, m, dtype=torch.bool) if mask2d is None else mask2d
    real3d = cost.new_ones(b, n, dtype=torch.bool) if mask3d is None else mask3d
    if not waits(cost.device) and not bool((real2d.any(-1) & real3d.any(-1)).all()):
        raise ValueError("expected at least one real point on each side of every sample, got an empty mask")
    rows = _uniform(real2d, cost.dtype) if row_marginal is None else row_marginal * real2d
    cols = _uniform(real3d, cost.dtype) if col_marginal is None else col_marginal * real3d
    if dustbin is not None:
        cost, rows, cols = _with_dustbin(cost, dustbin, rows, cols, real2d, real3d)
    fixed_mu = mu.detach().to(cost) if isinstance(mu, Tensor) else mu
    with torch.no_grad():
        plan, stats = solve_plan(cost, rows, cols, mu=fixed_mu, tolerance=tolerance, max_iterations=max_iterations)
    plan = entropic_plan(plan, cost, mu, rows, cols)
    return (plan if dustbin is None else plan[:, :m, :n]), stats


def _uniform(real: Bool[Tensor, "b k"], dtype: torch.dtype) -> Float[Tensor, "b k"]:
    return real.to(dtype) / real.sum(-1, keepdim=True)


def _with_dustbin(
    cost: Tensor, dustbin: float | Tensor, rows: Tensor, cols: Tensor, real2d: Tensor, real3d: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Append a bin to each side; point marginals scale to m/(m+n) and n/(m+n), the bins take the other side's share."""
    bin_cost = dustbin.to(cost) if isinstance(dustbin, Tensor) else cost.new_full((), dustbin)
    m, n = (real.sum(-1, keepdim=True).to(cost.dtype) for real in (real2d, real3d))
    share2d, share3d = m / (m + n), n / (m + n)
    cost = torch.cat([cost, bin_cost.expand(*cost.shape[:2], 1)], -1)
    cost = torch.cat([cost, bin_cost.expand(cost.shape[0], 1, cost.shape[2])], -2)
    rows = torch.cat([rows * share2d, share3d], -1)
    cols = torch.cat([cols * share3d, share2d], -1)
    return cost, rows, cols


class Sinkhorn(nn.Module):
    """`sinkhorn` with its options as a module; `mu` and `dustbin` may be learned.

    Args:
        mu: entropy weight of the transport.
        learn_mu: whether mu is learned.
        dustbin: cost of leaving a point unmatched; null for a full assignment.
        learn_dustbin: whether that cost is learned.
        tolerance: L1 error of the marginals at which the transport stops.
        max_iterations: pairs of scalings, at most.
    """

    def __init__(
        self,
        *,
        mu: float = 0.1,
        learn_mu: bool = False,
        dustbin: float | None = None,
        learn_dustbin: bool = False,
        tolerance: float = 1e-6,
        max_iterations: int = 1000,
    ) -> None:
        super().__init__()
        if not mu > 0:
            raise ValueError(f"expected `mu` > 0, got {mu}; try 0.1")
        if learn_dustbin and dustbin is None:
            raise ValueError("expected a `dustbin` cost to learn from, got None; try 1.0")
        self.log_mu = nn.Parameter(torch.tensor(math.log(mu))) if learn_mu else None
        self.mu, self.learn_mu = mu, learn_mu
        self.dustbin, self.learn_dustbin = dustbin, learn_dustbin
        self.bin_cost = nn.Parameter(torch.tensor(float(dustbin))) if learn_dustbin and dustbin is not None else None
        self.tolerance = tolerance
        self.max_iterations = max_iterations

    def forward(
        self,
        cost: Float[Tensor, "b m n"],
        mask2d: Bool[Tensor, "b m"] | None = None,
        mask3d: Bool[Tensor, "b n"] | None = None,
    ) -> tuple[Float[Tensor, "b m n"], SolveStats]:
        return sinkhorn(
            cost,
            mu=self.entropy,
            mask2d=mask2d,
            mask3d=mask3d,
            dustbin=self.dustbin if self.bin_cost is None else self.bin_cost,
            tolerance=self.tolerance,
            max_iterations=self.max_iterations,
        )

    @property
    def entropy(self) -> float | Tensor:
        """mu, as it is now."""
        return self.mu if self.log_mu is None else self.log_mu.exp()
