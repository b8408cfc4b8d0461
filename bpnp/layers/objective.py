"""The weighted blind PnP objective (paper Eq. 7) and its derivatives in the pose.

f(R, t) = sum_ij P_ij (1 - f_i . g(R p_j + t)),  g(y) = y / |y|.
It is linear in the bearings: with q_j = sum_i P_ij f_i, f = sum P - sum_j q_j . g(R p_j + t). After one product the
cost of an evaluation is O(n), not O(m n). Perturbations act on the left: y = exp([w]x) R p + t + s.
"""

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from bpnp.geometry import transform
from bpnp.layers.fused import outer_products
from bpnp.layers.fused_objective import fused_derivatives

NEAR = 1e-12  # distances below this count as this: a point at the camera centre has no direction


def dense_objective(
    assignment: Float[Tensor, "b m n"],
    bearings: Float[Tensor, "b m 3"],
    points3d: Float[Tensor, "b n 3"],
    rotation: Float[Tensor, "b 3 3"],
    translation: Float[Tensor, "b 3"],
) -> Float[Tensor, " b"]:
    """Eq. 7 as it is written, over all m n pairs."""
    directions = torch.nn.functional.normalize(transform(rotation, translation, points3d), dim=-1, eps=NEAR)
    return (assignment * (1 - bearings @ directions.mT)).sum((-2, -1))


def aggregate(
    assignment: Float[Tensor, "b m n"], bearings: Float[Tensor, "b m 3"]
) -> Float[Tensor, "b n 3"]:  # fmt: skip
    """q_j = sum_i P_ij f_i: one mean bearing for each 3D point, with its weight as its length."""
    return _Aggregate.apply(assignment, bearings.to(assignment.dtype))


class _Aggregate(torch.autograd.Function):
    """Its gradient in P is most of the layer's: m n numbers, written once."""

    @staticmethod
    def forward(ctx: Any, assignment: Tensor, bearings: Tensor) -> Tensor:
        ctx.save_for_backward(assignment, bearings)
        # As (F^T P)^T: in torch 2.13 on the CPU the product with three columns on the right takes four times as long.
        return (bearings.mT @ assignment).mT

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, Tensor | None]:
        assignment, bearings = ctx.saved_tensors
        to_assignment = to_bearings = None
        if ctx.needs_input_grad[0]:
            on_cpu = gradient.device.type == "cpu"
            to_assignment = outer_products(bearings, gradient) if on_cpu else bearings @ gradient.mT
        if ctx.needs_input_grad[1]:
            to_bearings = (gradient.mT @ assignment.mT).mT
        return to_assignment, to_bearings


@dataclass(frozen=True)
class Derivatives:
    """Value (b,), gradient (b, 6) and Hessian (b, 6, 6) of -sum_j q_j . g(R p_j + t) in (w, s) at zero."""

    value: Tensor
    gradient: Tensor
    hessian: Tensor


def pose_gradient(q: Tensor, points3d: Tensor, rotation: Tensor, translation: Tensor) -> Float[Tensor, "b 6"]:
    """Gradient in the left perturbation (w, s): the optimality condition of the layer."""
    rotated = points3d @ rotation.mT
    return _gradient(rotated, _point_gradient(q, rotated + translation.unsqueeze(-2)))


def derivatives(q: Tensor, points3d: Tensor, rotation: Tensor, translation: Tensor) -> Derivatives:
    """All three in one pass over the points.

    With u = y/|y|, d = |y|: h = -(q - (q.u) u)/d is the gradient in y and G = [(q.u)(I - 3 u u^T) + q u^T + u q^T]/d^2
    its Hessian; a rotation also bends the path, which adds sym(Rp h^T) - (Rp . h) I to the rotation block.
    """
    followed = torch.is_grad_enabled() and (q.requires_grad or points3d.requires_grad)
    if q.device.type == "cpu" and not followed:
        return Derivatives(*fused_derivatives(q, points3d, rotation, translation, NEAR))
    rotated = points3d @ rotation.mT
    y = rotated + translation.unsqueeze(-2)
    d = torch.linalg.vector_norm(y, dim=-1, keepdim=True).clamp_min(NEAR)
    u = y / d
    qu = (q * u).sum(-1, keepdim=True)
    h = _point_gradient(q, y)
    eye = torch.eye(3, dtype=q.dtype, device=q.device)
    outer = u.unsqueeze(-1) * (q - 1.5 * qu * u).unsqueeze(-2)
    g = (qu.unsqueeze(-1) * eye + outer + outer.mT) / d.unsqueeze(-1) ** 2
    crossed = torch.linalg.cross(rotated.unsqueeze(-1).expand_as(g), g, dim=-2)
    rotation_block = torch.linalg.cross(rotated.unsqueeze(-2).expand_as(g), crossed, dim=-1).sum(-3)
    bend = rotated.mT @ h
    bend = 0.5 * (bend + bend.mT) - bend.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None] * eye
    mixed = crossed.sum(-3)
    top = torch.cat([rotation_block + bend, mixed], -1)
    bottom = torch.cat([mixed.mT, g.sum(-3)], -1)
    return Derivatives(-qu.sum((-2, -1)), _gradient(rotated, h), torch.cat([top, bottom], -2))


def _point_gradient(q: Tensor, y: Tensor) -> Tensor:
    d = torch.linalg.vector_norm(y, dim=-1, keepdim=True).clamp_min(NEAR)
    u = y / d
    return ((q * u).sum(-1, keepdim=True) * u - q) / d


def _gradient(rotated: Tensor, h: Tensor) -> Tensor:
    return torch.cat([torch.linalg.cross(rotated, h, dim=-1).sum(-2), h.sum(-2)], -1)
