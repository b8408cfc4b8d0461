"""A transport plan as a kernel and two scalings: rescaling it, and making the kernel again when they grow large."""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from bpnp.layers.adjoint import times, transpose_times
from bpnp.layers.pacing import unfinished, waits

LARGEST_LOG_SCALING = 20.0  # twice this is far from where entries of K underflow in float32


@dataclass(frozen=True)
class Scaled:
    """P = diag(alpha) K diag(beta), K = exp((u + v - M) / mu), and its row sums."""

    kernel: Tensor
    u: Tensor
    v: Tensor
    alpha: Tensor
    beta: Tensor
    row_sums: Tensor

    @classmethod
    def start(cls, kernel: Tensor, u: Tensor, v: Tensor) -> "Scaled":
        ones = torch.ones_like(v)
        return cls(kernel, u, v, torch.ones_like(u), ones, times(kernel, ones))

    def samples(self, some: Int[Tensor, " s"]) -> "Scaled":
        if len(some) == len(self.u):
            return self
        return Scaled(*(x[some] for x in (self.kernel, self.u, self.v, self.alpha, self.beta, self.row_sums)))

    def with_scalings(self, some: Int[Tensor, " s"], part: "Scaled") -> "Scaled":
        if len(some) == len(self.u):
            return part
        names = ("alpha", "beta", "row_sums")
        return replace(self, **{x: getattr(self, x).index_copy(0, some, getattr(part, x)) for x in names})


def from_row_minima(cost: Tensor, rows: Tensor, v: Tensor, mu: Float[Tensor, " b"], kernel: Tensor) -> Scaled:
    """K, written to `kernel`, whose largest entry in each row is one. A row without mass has the potential -inf."""
    u = torch.sub(cost, v.unsqueeze(-2), out=kernel).amin(-1)
    u = torch.where(rows > 0, u, -math.inf)
    kernel.sub_(u.unsqueeze(-1)).div_(-mu[:, None, None]).exp_()
    return Scaled.start(kernel, u, v)


def absorb(state: Scaled, cost: Tensor, mu: Float[Tensor, " b"], active: Bool[Tensor, " b"]) -> Scaled:
    """Move large scalings of active samples into the potentials and make their K again.

    In place, a sample at a time: K may be nearly all the memory there is. A GPU makes all, and keeps some.
    """
    log_alpha, log_beta = state.alpha.log(), state.beta.log()
    large = active & (torch.maximum(log_alpha.abs().amax(-1), log_beta.abs().amax(-1)) > LARGEST_LOG_SCALING)
    if not unfinished(large):
        return state
    move = torch.where(large, mu, 0).unsqueeze(-1)
    u, v = state.u + move * log_alpha, state.v + move * log_beta
    if waits(cost.device):
        fresh = (u.unsqueeze(-1) - cost).add_(v.unsqueeze(-2)).div_(mu[:, None, None]).exp_()
        state.kernel.copy_(torch.where(large[:, None, None], fresh, state.kernel))
    else:
        for i in large.nonzero().flatten().tolist():
            kernel = torch.sub(u[i].unsqueeze(-1), cost[i], out=state.kernel[i])
            kernel.add_(v[i]).div_(mu[i]).exp_()
    fresh_state = Scaled.start(state.kernel, u, v)
    kept = ((fresh_state.alpha, state.alpha), (fresh_state.beta, state.beta), (fresh_state.row_sums, state.row_sums))
    return Scaled(state.kernel, u, v, *(torch.where(large.unsqueeze(-1), new, old) for new, old in kept))


def sweep(
    state: Scaled, rows: Tensor, cols: Tensor, active: Bool[Tensor, " b"], tolerance: float, sweeps: int
) -> tuple[Scaled, Float[Tensor, " b"], Int[Tensor, " b"]]:
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
