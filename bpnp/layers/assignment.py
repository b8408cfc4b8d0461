"""Entropic optimal transport from a cost matrix to a joint probability (paper Eqs. 9 and 10), to convergence.

`layers.transport` finds the optimum, `layers.laplacian` its gradient, by the theorem in `layers.implicit`.
"""

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from bpnp.checks import check_shapes
from bpnp.layers.implicit import BackwardStats
from bpnp.layers.laplacian import entropic_plan
from bpnp.layers.transport import solve_plan
from bpnp.precision import full_precision
from bpnp.types import SolveStats


@check_shapes
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
    backward_stats: BackwardStats | None = None,
) -> tuple[Float[Tensor, "b m n"], SolveStats]:
    """Joint probability P of every match: argmin <P, M> + mu sum P (log P - 1) with P 1 = r, P^T 1 = c (paper Eq. 9).

    cost: M, infinite for a match that cannot be.
    mu: entropy weight > 0, a number or a scalar tensor (which receives a gradient).
    row_marginal, col_marginal: r and c, each summing to one over real points (default uniform); they receive gradients.
    mask2d, mask3d: True at real points; a padded row or column gets no mass.
    dustbin: cost of leaving a point unmatched, a number or a scalar tensor (which receives a gradient); None for a full
        assignment. With it each side gets one more point, the bin (`dustbin_marginals`), which is left out of the
        result, so that P sums to less than one.
    tolerance: largest L1 error of the row and of the column sums at which a sample stops.
    max_iterations: scalings of rows and of columns for each sample.
    backward_stats: counts the samples of backward passes, and those that did not converge. Without it the latter cause
        a RuntimeWarning.

    Returns P and stats (residual: that L1 error). Samples stop independently of each other. The gradient is that of the
    optimum (`bpnp.layers.implicit`); it needs O(m n) memory. There is no second derivative.
    Raises ValueError for mu <= 0, a sample without a real point on either side, shapes that do not fit, an empty axis
    or integers.

    >>> assignment, stats = sinkhorn(torch.tensor([[[0.0, 1.0], [1.0, 0.2]]]), mu=0.5)
    >>> assignment
    tensor([[[0.4291, 0.0709],
             [0.0709, 0.4291]]])
    >>> stats.converged
    tensor([True])
    """
    for name, scalar in (("mu", mu), ("dustbin", dustbin)):
        if isinstance(scalar, Tensor) and scalar.ndim:
            raise ValueError(f"expected `{name}` as a number or a scalar tensor, got shape {tuple(scalar.shape)}")
    check_mu(mu)
    for name, mask in (("mask2d", mask2d), ("mask3d", mask3d)):
        if mask is not None and not bool(mask.any(-1).all()):
            raise ValueError(f"expected at least one real point on each side of every sample, got an empty `{name}`")
    b, m, n = cost.shape
    real2d = cost.new_ones(b, m, dtype=torch.bool) if mask2d is None else mask2d
    real3d = cost.new_ones(b, n, dtype=torch.bool) if mask3d is None else mask3d
    rows = uniform_marginal(real2d, cost.dtype) if row_marginal is None else row_marginal * real2d
    cols = uniform_marginal(real3d, cost.dtype) if col_marginal is None else col_marginal * real3d
    if dustbin is not None:
        bin_cost = torch.as_tensor(dustbin, dtype=cost.dtype, device=cost.device)
        cost = torch.cat([cost, bin_cost.expand(b, m, 1)], 2)
        cost = torch.cat([cost, bin_cost.expand(b, 1, n + 1)], 1)
        rows, cols = dustbin_marginals(rows, cols, real2d, real3d)
    exact_mu = torch.as_tensor(mu, dtype=torch.float64, device=cost.device)
    with torch.no_grad():
        plan, stats = solve_plan(cost, rows, cols, mu=exact_mu, tolerance=tolerance, max_iterations=max_iterations)
    plan = entropic_plan(plan, cost, exact_mu.to(cost.dtype), rows, cols, backward_stats)
    return (plan if dustbin is None else plan[:, :m, :n]), stats


def uniform_marginal(real: Bool[Tensor, "b k"], dtype: torch.dtype) -> Float[Tensor, "b k"]:
    """The same share of one for each real point."""
    return real.to(dtype) / real.sum(-1, keepdim=True)


def dustbin_marginals(
    rows: Float[Tensor, "b m"], cols: Float[Tensor, "b n"], real2d: Bool[Tensor, "b m"], real3d: Bool[Tensor, "b n"]
) -> tuple[Float[Tensor, "b rows"], Float[Tensor, "b cols"]]:
    """Marginals (b, m + 1), (b, n + 1) of both sides with a bin at the end that has room for the other side's points.

    With m and n real points, those of the image have m / (m + n) of the mass and their bin n / (m + n); in the scene
    it is the other way round. Uniform marginals thus give each point of either side 1 / (m + n).
    """
    m, n = (real.sum(-1, keepdim=True).to(rows.dtype) for real in (real2d, real3d))
    share2d, share3d = m / (m + n), n / (m + n)
    return torch.cat([rows * share2d, share3d], -1), torch.cat([cols * share3d, share2d], -1)


def check_mu(mu: float | Tensor) -> None:
    """Raise ValueError for an entropy weight that is not above zero, NaN included."""
    if not mu > 0:
        raise ValueError(f"expected `mu` > 0, got {float(mu)}; try 0.1")


class Sinkhorn(nn.Module):
    """`sinkhorn` with its options as a module; `mu` may be learned.

    Its `backward_stats` count the backward passes of the module and those that did not converge: log
    `backward_stats.unconverged` at the end of an epoch, then call `backward_stats.reset()`.

    Args:
        mu: entropy weight of the transport.
        learn_mu: whether mu is learned.
        dustbin: cost of leaving a point unmatched; null for a full assignment.
        tolerance: L1 error of the marginals at which the transport stops.
        max_iterations: scalings of rows and of columns, at most.

    >>> layer = Sinkhorn(mu=0.1, learn_mu=True)
    >>> assignment, stats = layer(torch.rand(2, 5, 6))
    >>> assignment.shape, [name for name, _ in layer.named_parameters()]
    (torch.Size([2, 5, 6]), ['log_mu'])
    """

    def __init__(
        self,
        *,
        mu: float = 0.1,
        learn_mu: bool = False,
        dustbin: float | None = None,
        tolerance: float = 1e-6,
        max_iterations: int = 1000,
    ) -> None:
        super().__init__()
        check_mu(mu)
        self.log_mu = nn.Parameter(torch.tensor(math.log(mu))) if learn_mu else None
        self.mu, self.learn_mu, self.dustbin = mu, learn_mu, dustbin
        self.tolerance, self.max_iterations = tolerance, max_iterations
        self.backward_stats = BackwardStats()

    def forward(
        self, cost: Tensor, mask2d: Tensor | None = None, mask3d: Tensor | None = None
    ) -> tuple[Float[Tensor, "b m n"], SolveStats]:
        return sinkhorn(
            cost,
            mu=self.entropy,
            mask2d=mask2d,
            mask3d=mask3d,
            dustbin=self.dustbin,
            tolerance=self.tolerance,
            max_iterations=self.max_iterations,
            backward_stats=self.backward_stats,
        )

    @property
    def entropy(self) -> float | Tensor:
        """mu, as it is now."""
        return self.mu if self.log_mu is None else self.log_mu.exp()
