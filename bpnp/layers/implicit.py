"""The derivative of an optimum with respect to its problem (paper Lemmas 1 and 2), whatever solver found it.

If F(y, x) = 0 defines y(x), then dL/dx = -(dF/dx)^T w with (dF/dy)^T w = dL/dy: one linear solve and one
vector-Jacobian product; the iterations need not be kept. For a pose that is the derivative of one more Newton step
(`bpnp.layers.pnp`). `entropic_plan` is the closed form for the transport plan. The caller passes the solver of the
linear system; `BackwardStats` count how often it did not converge.
"""

import functools
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from bpnp.layers.plan import cached_parts
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
    """In a backward pass: raise ValueError under `create_graph=True`, whose gradient would lack the graph asked for."""
    if torch.is_grad_enabled():
        raise ValueError(
            "expected a first derivative, got create_graph=True: the layers have no second derivative; "
            "try create_graph=False"
        )


PlanAdjoint = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]


def entropic_plan(
    plan: Float[Tensor, "b m n"],
    cost: Float[Tensor, "b m n"],
    mu: Float[Tensor, ""],
    row_marginal: Float[Tensor, "b m"],
    col_marginal: Float[Tensor, "b n"],
    solve_adjoint: PlanAdjoint,
) -> Float[Tensor, "b m n"]:
    """Return `plan`, the minimiser of <P, cost> + mu P (log P - 1) with the given marginals, with its gradients.

    With V = dL/dP and multipliers a, b from [diag(P1) P; P^T diag(P^T 1)] [a; b] = [(P.V)1; (P.V)^T 1]:
    dL/dcost = -P.(V - a1^T - 1b^T)/mu, dL/dmu = <dL/dcost, log P>, dL/drow = a, dL/dcol = b
    (up to one constant added to a and taken from b, chosen so that the mean of b, weighted by c, is zero).
    The actual sums of P enter, so that a plan short of convergence has the gradient of the problem that it does solve.

    solve_adjoint: maps P and V to a and b.
    """
    return _EntropicPlan.apply(plan, cost, mu, row_marginal, col_marginal, solve_adjoint)


def projected(
    plan: Tensor, gradient: Tensor, a: Tensor, b: Tensor, factor: float | Tensor = 1.0
) -> Float[Tensor, "b m n"]:
    """factor P.(V - a1^T - 1b^T)."""
    result = torch.empty_like(plan)
    for out, p, v, x, y in cached_parts(result, plan, gradient, a, b):
        torch.sub(v, x.unsqueeze(-1), out=out).sub_(y.unsqueeze(-2)).mul_(p).mul_(factor)
    return result


class _EntropicPlan(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, plan: Tensor, cost: Tensor, mu: Tensor, rows: Tensor, cols: Tensor, solve_adjoint: PlanAdjoint
    ) -> Tensor:
        ctx.save_for_backward(plan, mu)
        ctx.solve_adjoint = solve_adjoint
        return plan.view_as(plan)

    @staticmethod
    @first_derivative
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        plan, mu = ctx.saved_tensors
        a, b = ctx.solve_adjoint(plan, gradient)
        to_cost = projected(plan, gradient, a, b, -1 / mu)
        to_mu = torch.special.xlogy(to_cost, plan).sum() if ctx.needs_input_grad[2] else None
        return None, to_cost, to_mu, a, b, None
