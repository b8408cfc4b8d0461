"""Entropic optimal transport from a cost matrix to a joint probability, run to convergence (paper Eqs. 9 and 10).

`layers.transport` finds the optimum and `layers.laplacian` its gradient, by the theorem in `layers.implicit`.
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
    """Solve the entropic transport problem (paper Eq. 9): the joint probability P of every match.

    P minimises <P, M> + mu sum P (log P - 1) subject to P 1 = r and P^T 1 = c. With a `dustbin` M, r and c are first
    extended by one point on each side (`dustbin_marginals`). Samples stop independently of each other. The gradient is
    that of the optimum (`bpnp.layers.implicit`) and takes O(m n) memory. There is no second derivative.

    Args:
        cost: Cost M (b, m, n); infinite for an impossible match, but not for all matches of a point.
        mu: Entropy weight > 0, a number or a scalar tensor, which receives a gradient.
        row_marginal: r (b, m), summing to one over the real points, of any float type; receives a gradient. Default:
            uniform.
        col_marginal: c (b, n), as `row_marginal`.
        mask2d: True at real image points (b, m). A padded row gets no mass. Default: all are real.
        mask3d: True at real scene points (b, n). A padded column gets no mass. Default: all are real.
        dustbin: Cost of leaving a point unmatched, a number or a scalar tensor, which receives a gradient. Each side
            gets one more point, the dustbin, with room for all points of the other side: with m and n real points,
            image points have the marginal m / (m + n) r, their dustbin n / (m + n), and likewise for c. The dustbins
            are left out of the result, so that P sums to less than one. Default: None, every point is matched.
        tolerance: Largest L1 error of the row sums, and of the column sums, at which a sample stops.
        max_iterations: Largest number of sweeps of a sample; a sweep scales all rows, then all columns. The sweeps at
            higher temperatures that come first where mu is small against the range of the costs, five at each, are not
            counted.
        backward_stats: Counts the samples of backward passes and those that did not converge. Default: None, a
            RuntimeWarning reports the latter.

    Returns:
        P (b, m, n), and stats whose `residual` is the L1 error of the marginals and whose `iterations` counts sweeps,
            as `max_iterations` does. A sample with NaN in the cost, or with a point without a finite cost and without a
            dustbin, has NaN in P and `converged` False.

    Raises:
        ValueError: mu is not positive, a sample has no real point on one side, or an argument has a wrong shape or
            dtype.

    >>> import torch
    >>> from bpnp.layers import sinkhorn
    >>> assignment, stats = sinkhorn(torch.tensor([[[0.0, 1.0], [1.0, 0.2]]]), mu=0.5)
    >>> assignment
    tensor([[[0.4291, 0.0709],
             [0.0709, 0.4291]]])
    >>> stats.converged
    tensor([True])
    """
    for name, scalar in (("mu", mu), ("dustbin", dustbin)):
        if isinstance(scalar, Tensor) and scalar.ndim:
            raise ValueError(f"`{name}` has the shape {tuple(scalar.shape)}; a number or a scalar tensor is needed")
    check_mu(mu)
    for name, mask in (("mask2d", mask2d), ("mask3d", mask3d)):
        if mask is not None and not bool(mask.any(-1).all()):
            raise ValueError(f"a sample has no real point in `{name}`; every sample needs one on each side")
    b, m, n = cost.shape
    real2d = cost.new_ones(b, m, dtype=torch.bool) if mask2d is None else mask2d
    real3d = cost.new_ones(b, n, dtype=torch.bool) if mask3d is None else mask3d
    rows = uniform_marginal(real2d, cost.dtype) if row_marginal is None else row_marginal.to(cost.dtype) * real2d
    cols = uniform_marginal(real3d, cost.dtype) if col_marginal is None else col_marginal.to(cost.dtype) * real3d
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
    """Return a uniform distribution over the real points, zero at padded points."""
    return real.to(dtype) / real.sum(-1, keepdim=True)


def dustbin_marginals(
    rows: Float[Tensor, "b m"], cols: Float[Tensor, "b n"], real2d: Bool[Tensor, "b m"], real3d: Bool[Tensor, "b n"]
) -> tuple[Float[Tensor, "b rows"], Float[Tensor, "b cols"]]:
    """Append a dustbin, the last entry, to the marginal of each side, with room for all points of the other side.

    With m and n real points, the image points have m / (m + n) of the mass and their dustbin n / (m + n); the scene has
    it the other way round. With uniform marginals each point of either side thus has the mass 1 / (m + n). Each
    marginal sums to one.
    """
    m, n = (real.sum(-1, keepdim=True).to(rows.dtype) for real in (real2d, real3d))
    mass2d, mass3d = m / (m + n), n / (m + n)
    return torch.cat([rows * mass2d, mass3d], -1), torch.cat([cols * mass3d, mass2d], -1)


def check_mu(mu: float | Tensor) -> None:
    """Raise ValueError unless the entropy weight is positive."""
    if not mu > 0:
        raise ValueError(f"`mu` is {float(mu)}; it must be above 0, such as 0.1")


class Sinkhorn(nn.Module):
    """Entropic optimal transport as a module; see `sinkhorn`.

    `backward_stats` counts the backward passes of the module and those that did not converge. Log
    `backward_stats.unconverged` at the end of an epoch, then call `backward_stats.reset()`.

    Args:
        mu: Weight of the entropy in the objective (paper Eq. 9), default 0.1. `entropy` is its current value.
        learn_mu: Learn the weight, starting from `mu`. Default False.
        dustbin: Cost of leaving a point unmatched. Default: None, every point is matched.
        tolerance: L1 error of the marginals at which a sample stops, default 1e-6.
        max_iterations: Largest number of sweeps over rows and columns, default 1000.

    >>> import torch
    >>> from bpnp.layers import Sinkhorn
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
        """Return the assignment P (b, m, n) and its stats; see `sinkhorn`.

        Args:
            cost: Cost M (b, m, n).
            mask2d: True at real image points (b, m). Default: all are real.
            mask3d: True at real scene points (b, n). Default: all are real.
        """
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
        """Weight mu of the entropy in the objective (paper Eq. 9), learned or fixed; not the entropy of a plan."""
        return self.mu if self.log_mu is None else self.log_mu.exp()
