"""Truncated Gauss-Newton on the reprojection errors of candidate pairs: the local refinement of RANSAC."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from bpnp.geometry import retract
from bpnp.robust.scoring import Pairs, residuals

DAMPING = 1e-9  # share of the Hessian's mean diagonal


def refine_locally(
    poses: Float[Tensor, "b c 3 4"],
    pairs: Pairs,
    threshold2: float,
    steps: int,
    *,
    cauchy: Float[Tensor, "b c"] | None = None,
) -> Float[Tensor, "b c 3 4"]:
    """Reduce sum_i min(r_i^2, threshold2), or with Cauchy's loss sum_i min(s log(1 + r_i^2 / s), s log(1 + t / s)).

    Each step is a Gauss-Newton step on the inliers of the current pose, weighted by the derivative of the loss in r^2.
    Poses are refined independently, and the best one met on the way is returned, the initial pose included.

    threshold2: squared reprojection error t of an inlier. cauchy: scale s, squared residual units; None for r^2.
    """
    scale = None if cauchy is None else cauchy.clamp(min=1e-24).unsqueeze(-1)
    best = poses
    lowest = torch.full(poses.shape[:2], torch.inf, dtype=poses.dtype, device=poses.device)
    damping = DAMPING * torch.eye(6, dtype=poses.dtype, device=poses.device)
    for _ in range(steps + 1):
        squared, inlier, residual, camera = residuals(poses, pairs, threshold2)
        loss, weight = torch.where(inlier, squared, threshold2), inlier.to(squared.dtype)
        if scale is not None:
            loss, weight = scale * (loss / scale).log1p(), weight / (1 + loss / scale)
        score = loss.mul(pairs.real.unsqueeze(1)).sum(-1)
        better = score < lowest
        best, lowest = torch.where(better[..., None, None], poses, best), torch.where(better, score, lowest)
        jacobian = _jacobian(camera, camera - poses[..., None, :, 3], inlier)
        residual = torch.where(inlier.unsqueeze(-1), residual, 0)
        weighted = jacobian * weight.repeat(1, 1, 2).unsqueeze(-2)
        hessian = weighted @ jacobian.mT
        gradient = weighted @ residual.mT.flatten(-2).unsqueeze(-1)
        hessian = hessian + damping * (1e-9 + hessian.diagonal(dim1=-2, dim2=-1).mean(-1)[..., None, None])
        step = -torch.cholesky_solve(gradient, torch.linalg.cholesky_ex(hessian).L).squeeze(-1)
        rotation, translation = retract(step, poses[..., :3], poses[..., 3])
        poses = torch.cat([rotation, translation.unsqueeze(-1)], -1)
    return best


def _jacobian(
    camera: Float[Tensor, "b c k 3"], turned: Float[Tensor, "b c k 3"], inlier: Bool[Tensor, "b c k"]
) -> Float[Tensor, "b c 6 2*k"]:
    """Derivatives of x/z, then of y/z, by the step (w, s) of `retract`; zero for outliers.

    camera: y = R p + t, which a step moves by w x R p + s. turned: R p.
    """
    inverse = torch.where(inlier, 1 / camera[..., 2], 0)
    u, v = camera[..., 0] * inverse, camera[..., 1] * inverse
    a, b, c = (turned * inverse.unsqueeze(-1)).unbind(-1)
    zero = torch.zeros_like(u)
    along_x = torch.stack([-u * b, c + u * a, -b, inverse, zero, -u * inverse], -2)
    along_y = torch.stack([-c - v * b, v * a, a, zero, inverse, -v * inverse], -2)
    return torch.cat([along_x, along_y], -1)
