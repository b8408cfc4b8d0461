"""Alignment of many poses in torch, all starts at once: `kernels_dense` for other devices."""

import math

import roma
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from bpnp.geometry import hat
from bpnp.search.kernels_dense import LARGEST_TURN, POWER

CHUNK = 2**26  # entries of the kernels held at a time, 256 MB


def descend(
    f: Float[Tensor, "m 3"],
    a: Float[Tensor, " m"],
    p: Float[Tensor, "n 3"],
    b: Float[Tensor, " n"],
    rotation: Float[Tensor, "s 3 3"],
    translation: Float[Tensor, "s 3"],
    scales: list[float],
    outlier: float,
    relaxation: float,
) -> tuple[Float[Tensor, "s 3 3"], Float[Tensor, "s 3"], Float[Tensor, " s"]]:
    """Every start annealed through `scales`, and its likelihood at the last one, -inf where the pose was lost.

    f, a: bearings and their weights. p, b: points and theirs. outlier: o / s^2 of `Scene.outlier_density`.
    """
    size = max(1, CHUNK // (len(f) * len(p)))
    parts = [
        _descend(f, a, p, b, turns, shifts, scales, outlier, relaxation)
        for turns, shifts in zip(rotation.split(size), translation.split(size), strict=True)
    ]
    turned, shifted, score = (torch.cat(part) for part in zip(*parts, strict=True))
    return turned, shifted, score


def _descend(
    f: Tensor, a: Tensor, p: Tensor, b: Tensor, rotation: Tensor, translation: Tensor, scales: list[float],
    outlier: float, relaxation: float,
) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
    score = f.new_zeros(len(rotation))
    for scale in scales:
        likelihood, q = assign(f, a, p, b, rotation, translation, scale, outlier * scale**2)
        rotation, translation, fixed = move(q, p, rotation, translation, relaxation)
        # A lost pose stays lost: its score is -inf from here on.
        score = torch.where(fixed & score.isfinite(), likelihood, -math.inf)
    return rotation, translation, score


def assign(
    f: Float[Tensor, "m 3"],
    a: Float[Tensor, " m"],
    p: Float[Tensor, "n 3"],
    b: Float[Tensor, " n"],
    rotation: Float[Tensor, "s 3 3"],
    translation: Float[Tensor, "s 3"],
    scale: float,
    outlier: float,
) -> tuple[Float[Tensor, " s"], Float[Tensor, "s n 3"]]:
    """Mean log-likelihood of the bearings, and q_j = sum_i W_ij f_i of the product form (docs/search.md)."""
    rays = torch.nn.functional.normalize(p @ rotation.mT + translation.unsqueeze(1), dim=-1)
    sharp = 1 / (POWER * scale**2)
    kernel = (1 - sharp + sharp * (rays @ f.mT)).clamp_(min=0).pow_(POWER)
    column, row = kernel @ a, b @ kernel + outlier * b.sum()
    likelihood = (a * (row / (b.sum() * scale**2)).log()).sum(-1) / a.sum()
    q = kernel.square_().mul_((a / row).unsqueeze(1)) @ f
    return likelihood, q * (b / (column + outlier * a.sum())).unsqueeze(-1)


def move(
    q: Float[Tensor, "s n 3"],
    p: Float[Tensor, "n 3"],
    rotation: Float[Tensor, "s 3 3"],
    translation: Float[Tensor, "s 3"],
    relaxation: float,
) -> tuple[Float[Tensor, "s 3 3"], Float[Tensor, "s 3"], Bool[Tensor, " s"]]:
    """One Gauss-Newton step on -sum_j q_j . g(R p_j + t), and which poses the points fix; others stay."""
    turned = p @ rotation.mT
    y = turned + translation.unsqueeze(1)
    near = 1 / y.norm(dim=-1, keepdim=True).clamp(min=1e-6)
    u = y * near
    h = (q - (q * u).sum(-1, keepdim=True) * u) * near
    gradient = torch.cat([torch.linalg.cross(turned, h).sum(1), h.sum(1)], -1)
    across = torch.eye(3, dtype=u.dtype, device=u.device) - u.unsqueeze(-1) * u.unsqueeze(-2)
    weight = q.norm(dim=-1, keepdim=True) * near**2
    curvature = weight.unsqueeze(-1) * across
    # y moves by w x Rp + s: its derivative is [-[Rp]x, I].
    chain = torch.cat([-hat(turned), torch.eye(3, dtype=u.dtype, device=u.device).expand(*y.shape, 3)], -1)
    hessian = (chain.mT @ curvature @ chain).sum(1)
    trace = hessian.diagonal(dim1=-2, dim2=-1).sum(-1)
    damping = 1e-3 * hessian.diagonal(dim1=-2, dim2=-1) + (1e-6 * trace + 1e-20).unsqueeze(-1)
    factor, failed = torch.linalg.cholesky_ex(hessian + torch.diag_embed(damping))
    step = relaxation * torch.cholesky_solve(gradient.unsqueeze(-1), factor).squeeze(-1)
    fixed = (failed == 0) & step.isfinite().all(-1)
    step = torch.where(fixed.unsqueeze(-1), step, 0)
    angle = step[:, :3].norm(dim=-1, keepdim=True)
    turn = step[:, :3] * (LARGEST_TURN / angle.clamp(min=1e-20)).clamp(max=1)
    return roma.rotvec_to_rotmat(turn) @ rotation, translation + step[:, 3:], fixed
