"""The right answers in float64, by other means than ours: dense objectives, automatic differentiation and LAPACK."""

from typing import NamedTuple

import roma
import torch
from paper_layers import objective
from scipy.linalg import solve
from torch import Tensor

TOLERANCE, MOST_STEPS = 1e-12, 50


class Optimum(NamedTuple):
    """Angle-axis vector and translation (b, 6), as rotation and translation too."""

    pose: Tensor
    rotation: Tensor
    translation: Tensor


def pnp_optimum(assignment: Tensor, rays: Tensor, points3d: Tensor, start: Tensor) -> Optimum:
    """Minimum of Eq. 7 by Newton's method with the Hessian from automatic differentiation, sample by sample.

    start: (b, 6), near enough that full steps converge. Raises RuntimeError where the gradient does not fall to 1e-12.
    """
    found = []
    for p, f, x, pose in zip(*(v.double().split(1) for v in (assignment, rays, points3d, start)), strict=True):
        for _ in range(MOST_STEPS):
            slope, hessian = _slope_and_hessian(pose, p, f, x)
            if float(slope.detach().norm()) <= TOLERANCE:
                break
            pose = (pose - torch.linalg.solve(hessian, slope.detach())).detach()
        else:
            raise RuntimeError(f"expected a gradient of {TOLERANCE} in {MOST_STEPS} Newton steps, got {slope.norm()}")
        found.append(pose)
    pose = torch.cat(found).detach()
    return Optimum(pose, roma.rotvec_to_rotmat(pose[:, :3]), pose[:, 3:])


def pnp_gradient(
    optimum: Optimum, assignment: Tensor, rays: Tensor, points3d: Tensor, by_rotation: Tensor, by_translation: Tensor
) -> Tensor:
    """dL/dP for dL/dR (b, 3, 3) and dL/dt (b, 3) by automatic differentiation of the condition df/dpose = 0."""
    pose = optimum.pose.clone().requires_grad_()
    rotation = roma.rotvec_to_rotmat(pose[:, :3])
    (incoming,) = torch.autograd.grad((rotation * by_rotation).sum() + (pose[:, 3:] * by_translation).sum(), pose)
    gradients = []
    for v, p, f, x, y in zip(
        *(value.double().split(1) for value in (incoming, assignment, rays, points3d, optimum.pose)), strict=True
    ):
        p = p.clone().requires_grad_()
        slope, hessian = _slope_and_hessian(y, p, f, x)
        gradients.append(torch.autograd.grad((slope * -torch.linalg.solve(hessian, v)).sum(), p)[0])
    return torch.cat(gradients)


def _slope_and_hessian(pose: Tensor, assignment: Tensor, rays: Tensor, points3d: Tensor) -> tuple[Tensor, Tensor]:
    """df/dpose (1, 6), differentiable in the assignment, and its derivative (1, 6, 6)."""
    pose = pose.detach().requires_grad_()
    value = objective(pose, assignment, rays, points3d).sum()
    (slope,) = torch.autograd.grad(value, pose, create_graph=True)
    hessian = torch.stack([torch.autograd.grad(x, pose, retain_graph=True)[0] for x in slope.squeeze(0)], 1)
    return slope, hessian


def plan_gradient(plan: Tensor, gradient: Tensor, mu: float) -> Tensor:
    """dL/dM for the plan as it is: the m + n multipliers by LAPACK, one of them fixed to zero."""
    results = []
    for p, v in zip(plan.double().numpy(), gradient.double().numpy(), strict=True):
        rows, cols = p.sum(1), p.sum(0)
        row_mean = (p * v).sum(1) / rows
        laplacian = -(p.T / rows) @ p
        laplacian[range(len(cols)), range(len(cols))] = 0
        laplacian[range(len(cols)), range(len(cols))] = -laplacian.sum(1)
        rhs = (p * v).sum(0) - p.T @ row_mean
        b = torch.zeros(len(cols), dtype=torch.float64).numpy()
        b[:-1] = solve(laplacian[:-1, :-1], rhs[:-1], assume_a="pos")
        a = row_mean - p @ b / rows
        results.append(torch.as_tensor(-p * (v - a[:, None] - b) / mu))
    return torch.stack(results)


def relative_error(value: Tensor, exact: Tensor) -> float:
    """Largest |value - exact| / |exact| over the samples, Frobenius norms; NaN counts as NaN."""
    return float(((value - exact).flatten(1).norm(dim=1) / exact.flatten(1).norm(dim=1)).amax())
