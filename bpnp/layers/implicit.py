"""The derivative of an optimum with respect to its problem (paper Lemmas 1 and 2), apart from how it was found.

If F(y, x) = 0 defines y(x), then dL/dx = -(dF/dx)^T w with (dF/dy)^T w = dL/dy: one linear solve, one vector-Jacobian
product, and no memory of the iterations. `at_optimum` is that statement for any small y; `_EntropicPlan` is the same
for the transport plan, whose (m + n) multipliers leave a closed form.
"""

from collections.abc import Callable
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from bpnp.layers.adjoint import solve_multipliers
from bpnp.layers.fused import projected


def at_optimum(
    solution: Tensor, optimality: Callable[..., Tensor], solve_adjoint: Callable[[Tensor], Tensor], *parameters: Tensor
) -> Tensor:
    """Return `solution` unchanged, with the gradient dL/dx = -(dF/dx)^T w, (dF/dy)^T w = dL/dy.

    solution: y with optimality(y, *parameters) = 0.
    optimality: F, differentiable in the parameters; the invariant that defines y.
    solve_adjoint: maps dL/dy to w; a sample that has no derivative must map to zero and be flagged by the caller.
    parameters: the x that receive gradients.
    """
    return _AtOptimum.apply(solution, optimality, solve_adjoint, *parameters)


class _AtOptimum(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        solution: Tensor,
        optimality: Callable[..., Tensor],
        solve_adjoint: Callable[[Tensor], Tensor],
        *parameters: Tensor,
    ) -> Tensor:
        ctx.save_for_backward(solution, *parameters)
        ctx.optimality, ctx.solve_adjoint = optimality, solve_adjoint
        return solution.clone()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        solution, *parameters = ctx.saved_tensors
        adjoint = ctx.solve_adjoint(gradient)
        needed = [i for i, wanted in enumerate(ctx.needs_input_grad[3:]) if wanted]
        with torch.enable_grad():
            variables = [p.detach().requires_grad_(i in needed) for i, p in enumerate(parameters)]
            residual = ctx.optimality(solution, *variables)
            pulled = torch.autograd.grad(residual, [variables[i] for i in needed], -adjoint)
        gradients: list[Tensor | None] = [None] * len(parameters)
        for i, value in zip(needed, pulled, strict=True):
            gradients[i] = value
        return None, None, None, *gradients


def entropic_plan(
    plan: Float[Tensor, "b m n"],
    cost: Float[Tensor, "b m n"],
    mu: float | Tensor,
    row_marginal: Float[Tensor, "b m"],
    col_marginal: Float[Tensor, "b n"],
) -> Float[Tensor, "b m n"]:
    """Return `plan`, the minimiser of <P, cost> + mu P (log P - 1) with the given marginals, with its gradients.

    With V = dL/dP and multipliers a, b from [diag(P1) P; P^T diag(P^T 1)] [a; b] = [(P.V)1; (P.V)^T 1]:
    dL/dcost = -P.(V - a1^T - 1b^T)/mu, dL/dmu = -sum P.(V - a1^T - 1b^T).log(P)/mu, dL/drow = a, dL/dcol = b
    (up to the one constant that P cannot tell apart, chosen so that the mean of b, weighted by c, is zero).
    The actual sums of P enter, so that a plan short of convergence has the gradient of the problem that it does solve.
    """
    mu_tensor = mu.to(cost) if isinstance(mu, Tensor) else cost.new_full((), mu)
    return _EntropicPlan.apply(plan, cost, mu_tensor, row_marginal, col_marginal)


class _EntropicPlan(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, plan: Tensor, cost: Tensor, mu: Tensor, row_marginal: Tensor, col_marginal: Tensor) -> Tensor:
        ctx.save_for_backward(plan, mu)
        return plan.clone() if ctx.needs_input_grad[0] else plan.view_as(plan)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        plan, mu = ctx.saved_tensors
        a, b = solve_multipliers(plan, gradient)
        if plan.device.type == "cpu":
            grad_cost = projected(plan, gradient, a, b, -1 / float(mu))
        else:
            grad_cost = (gradient - a.unsqueeze(-1)).sub_(b.unsqueeze(-2)).mul_(plan).div_(-mu)
        grad_mu = None
        if ctx.needs_input_grad[2]:
            grad_mu = torch.special.xlogy(grad_cost, plan).sum().reshape(mu.shape)
        return None, grad_cost, grad_mu, a, b
