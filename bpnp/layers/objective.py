"""The weighted blind PnP objective (paper Eq. 7), its derivatives in the pose, and its solver.

f(R, t) = sum_ij P_ij (1 - f_i . g(R p_j + t)),  g(y) = y / |y|.
It is linear in the bearings: with q_j = sum_i P_ij f_i, f = sum P - sum_j q_j . g(R p_j + t). After one product the
cost of an evaluation is O(n), not O(m n). A step (w, s) acts on the left: y = exp([w]x) R p + t + s.
The q_j and p_j are the columns of (b, 3, n) tensors: torch adds up three rows of n numbers faster than n rows of three.
"""

from typing import Any, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from bpnp.geometry import choose, hat, retract
from bpnp.layers.implicit import first_derivative

Columns = Float[Tensor, "b 3 n"]
Rotations = Float[Tensor, "b 3 3"]
Translations = Float[Tensor, "b 3"]
NEAR = 1e-12  # scene radii; smaller distances are set to this: a point at the camera centre has no direction


def aggregate(assignment: Float[Tensor, "b m n"], bearings: Float[Tensor, "b m 3"]) -> Columns:
    """q_j = sum_i P_ij f_i: the mean bearing of each 3D point, its length the point's weight."""
    return _Aggregate.apply(assignment, bearings.to(assignment.dtype))


class _Aggregate(torch.autograd.Function):
    """F^T P, whose gradients are exact products too."""

    @staticmethod
    def forward(ctx: Any, assignment: Tensor, bearings: Tensor) -> Tensor:
        ctx.save_for_backward(assignment, bearings)
        return bearings.mT @ assignment

    @staticmethod
    @first_derivative
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, Tensor | None]:
        assignment, bearings = ctx.saved_tensors
        to_assignment, to_bearings = ctx.needs_input_grad
        return bearings @ gradient if to_assignment else None, assignment @ gradient.mT if to_bearings else None


class Derivatives(NamedTuple):
    """Value, gradient and Hessian of -sum_j q_j . g(R p_j + t) in the step (w, s) at zero."""

    value: Float[Tensor, " b"]
    gradient: Float[Tensor, "b 6"]
    hessian: Float[Tensor, "b 6 6"]


def pose_gradient(q: Columns, points: Columns, rotation: Rotations, translation: Translations) -> Float[Tensor, "b 6"]:
    """Gradient in the step (w, s), differentiable in all arguments: the optimality condition of the layer."""
    rotated = rotation @ points
    _, _, h = _point_gradient(q, rotated + translation.unsqueeze(-1))
    return _gradient(rotated @ h.mT, h)


def derivatives(q: Columns, points: Columns, rotation: Rotations, translation: Translations) -> Derivatives:
    """Value, gradient and Hessian together.

    With x = R p, y = x + t, d = |y|, u = y/d, the derivative of a term in y is h = ((q.u) u - q)/d, and its second
    derivative G = [(q.u)(I - 3 u u^T) + q u^T + u q^T]/d^2. Since dy = D (w, s) with D = [-[x]x, I], the Hessian is
    sum D^T G D, plus sym(x h^T) - (x.h) I in its rotation block, the second derivative of exp([w]x) x.
    G is written as (q.u)/d^2 I + v k^T + k v^T with v = u/d, k = (q - 1.5 (q.u) u)/d.
    """
    x = rotation @ points
    y = x + translation.unsqueeze(-1)
    u, inverse, h = _point_gradient(q, y)
    along = (q * u).sum(-2, keepdim=True)
    v = inverse * u
    k = inverse * q - 1.5 * along * v
    # D^T v = (x cross v, v), and x cross y = x cross t.
    dv = torch.cat([hat(translation).mT @ v, v], -2)
    dk = torch.cat([torch.linalg.cross(x, k, dim=-2), k], -2)
    low_rank = dv @ dk.mT
    curvature = along * inverse.square()
    weighted = curvature * x
    second, bend = x @ weighted.mT, x @ h.mT
    eye = torch.eye(3, dtype=q.dtype, device=q.device)
    # sum c D^T D = [[c (|x|^2 I - x x^T), c [x]x], [.., c I]]
    trace = (second - bend).diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None]
    rotation_block = trace * eye - second + 0.5 * (bend + bend.mT)
    mixed = hat(weighted.sum(-1))
    top = torch.cat([rotation_block, mixed], -1)
    bottom = torch.cat([mixed.mT, curvature.sum(-1, keepdim=True) * eye], -1)
    hessian = low_rank + low_rank.mT + torch.cat([top, bottom], -2)
    return Derivatives(-along.sum((-2, -1)), _gradient(bend, h), hessian)


def _point_gradient(q: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """u = y/d (b, 3, n), 1/d (b, 1, n) with d = |y|, and h = ((q.u) u - q)/d (b, 3, n)."""
    inverse = y.square().sum(-2, keepdim=True).clamp_min(NEAR**2).rsqrt()
    u = inverse * y
    return u, inverse, ((q * u).sum(-2, keepdim=True) * u - q) * inverse


def _gradient(outer: Tensor, h: Tensor) -> Float[Tensor, "b 6"]:
    """(sum x cross h, sum h) of columns x, h with outer = sum x h^T."""
    twist = outer - outer.mT
    return torch.stack([twist[:, 1, 2], twist[:, 2, 0], twist[:, 0, 1], *h.sum(-1).unbind(-1)], -1)


EQUAL = 1e-13  # values of the objective (weights sum to one) that agree to this differ by rounding only


def newton(
    q: Columns,
    points: Columns,
    rotation: Rotations,
    translation: Translations,
    *,
    tolerance: float,
    max_iterations: int,
) -> tuple[Rotations, Translations, Int[Tensor, " b"]]:
    """Newton's method with Levenberg's damping on the aggregated objective, for all samples of a batch at once.

    Returns the pose near the start at which the gradient's norm is at most `tolerance`, and the iterations per sample.
    q, points: weighted bearings and points of unit size, the weights of a sample summing to one. Each sample has its
    own damping, zero until a step fails, and its own stop.
    """
    current = derivatives(q, points, rotation, translation)
    damping = torch.zeros_like(current.value)
    iterations = torch.zeros(len(q), dtype=torch.long, device=q.device)
    eye = torch.eye(6, dtype=q.dtype, device=q.device)
    for _ in range(max_iterations):
        active = current.gradient.norm(dim=-1) > tolerance
        if not bool(active.any()):
            break
        iterations += active
        factor, info = torch.linalg.cholesky_ex(current.hessian + damping[:, None, None] * eye)
        step = -torch.cholesky_solve(current.gradient.unsqueeze(-1), factor).squeeze(-1)
        usable = active & (info == 0) & step.isfinite().all(-1)
        new_rotation, new_translation = retract(torch.where(usable[:, None], step, 0), rotation, translation)
        trial = derivatives(q, points, new_rotation, new_translation)
        # Near the optimum the values agree to rounding; there the smaller gradient decides.
        flat = (trial.value - current.value).abs() <= EQUAL
        lower = (trial.value < current.value) | (flat & (trial.gradient.norm(dim=-1) < current.gradient.norm(dim=-1)))
        accept = usable & lower
        rotation, translation = choose(accept, new_rotation, rotation), choose(accept, new_translation, translation)
        current = Derivatives(*(choose(accept, *both) for both in zip(trial, current, strict=True)))
        raised = (10 * damping).clamp_min(1e-3)
        lowered = torch.where(damping > 1e-6, damping / 10, 0)
        damping = torch.where(active, torch.where(accept, lowered, raised), damping)
    return rotation, translation, iterations
