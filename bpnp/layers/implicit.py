"""Derivative of an optimum with respect to its problem, whatever solver found it (paper Lemmas 1 and 2).

If F(y, x) = 0 defines y(x), then dL/dx = -(dF/dx)^T w with (dF/dy)^T w = dL/dy: one linear solve and one
vector-Jacobian product. The iterations need not be stored. For a pose this is the derivative of one more Newton step
(`bpnp.layers.pnp`), for the transport plan a closed form (`bpnp.layers.laplacian.entropic_plan`).
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
    """Number of samples in backward passes, and of those whose linear system did not converge.

    A sample that did not converge has the gradient of the last iterate.

    Attributes:
        samples: Samples so far.
        unconverged: Samples whose solver did not converge.

    >>> import torch
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
        """Set both counts to zero."""
        self.samples = self.unconverged = 0


def record(stats: BackwardStats | None, layer: str, converged: Bool[Tensor, " b"]) -> None:
    """Count a backward pass, or warn of samples that did not converge if there is nothing to count in.

    The warning names the layer; `converged` is that of the linear solver.
    """
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
    """Decorate the `backward` of a Function without a second derivative; its matrix products are exact."""

    @functools.wraps(backward)
    def run(ctx: Any, gradient: Tensor) -> Any:
        refuse_second_derivative(gradient)
        with exact_products(gradient.device):
            return backward(ctx, gradient)

    return run


def refuse_second_derivative(gradient: Tensor) -> None:
    """Raise ValueError in a backward pass under `create_graph=True`, because the gradient would have no graph."""
    if torch.is_grad_enabled():
        raise ValueError(
            "create_graph=True asks for a second derivative, which the layers do not have; use create_graph=False"
        )
