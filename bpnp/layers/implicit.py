"""The derivative of an optimum with respect to its problem (paper Lemmas 1 and 2), whatever solver found it.

If F(y, x) = 0 defines y(x), then dL/dx = -(dF/dx)^T w with (dF/dy)^T w = dL/dy: one linear solve and one
vector-Jacobian product; the iterations need not be kept. For a pose that is the derivative of one more Newton step
(`bpnp.layers.pnp`), for the transport plan a closed form (`bpnp.layers.laplacian.entropic_plan`). `BackwardStats` count
how often the solver of the linear system did not converge.
"""

import functools
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool
from torch import Tensor

from bpnp.precision import exact_products


@dataclass
class BackwardStats:
    """Number of samples whose gradient was solved for, and of those whose solver did not converge.

    A sample that did not converge still has a gradient, the last iterate; it is not finite where the sample was not.

    >>> from bpnp.layers import Sinkhorn
    >>> layer = Sinkhorn(mu=0.1)
    >>> cost = torch.rand(2, 5, 6, requires_grad=True)
    >>> layer(cost)[0].square().sum().backward()
    >>> layer.backward_stats
    BackwardStats(samples=2, unconverged=0)
    """

    samples: int = 0
    unconverged: int = 0

    def reset(self) -> None:
        self.samples = self.unconverged = 0


def record(stats: BackwardStats | None, layer: str, converged: Bool[Tensor, " b"]) -> None:
    """Count a backward pass in `stats`; without an object to count in, warn of samples that did not converge."""
    unconverged = int((~converged).sum())
    if stats is not None:
        stats.samples += len(converged)
        stats.unconverged += unconverged
    elif unconverged:
        warnings.warn(
            f"the gradient of {layer} did not converge for {unconverged} of {len(converged)} samples; "
            "pass `backward_stats` to count such samples instead",
            RuntimeWarning,
            stacklevel=2,
        )


def first_derivative(backward: Callable[..., Any]) -> Callable[..., Any]:
    """Decorator of the `backward` of a Function that has no second derivative; products are exact in it."""

    @functools.wraps(backward)
    def run(ctx: Any, gradient: Tensor) -> Any:
        refuse_second_derivative(gradient)
        with exact_products(gradient.device):
            return backward(ctx, gradient)

    return run


def refuse_second_derivative(gradient: Tensor) -> None:
    """In a backward pass, raise ValueError under `create_graph=True`: the gradient would have no graph."""
    if torch.is_grad_enabled():
        raise ValueError(
            "expected a first derivative, got create_graph=True: the layers have no second derivative; "
            "try create_graph=False"
        )
