"""Layers of Campbell, Liu and Gould (ECCV 2020), written from the formulas of the paper: the baseline of `layers`.

Sinkhorn: scalings of exp(-lambda M), lambda = 1/mu, and the gradient of Lemma 2 through the inverse of the system of
its m + n - 1 independent constraints, by blocks. PnP: L-BFGS on Eq. 8 over all m n pairs for the whole batch at once,
and the gradient of Lemma 1 with the Hessian and the 6 x m n Jacobian from automatic differentiation. Everything stays
in the dtype of its input.

The inverse uses a Cholesky factor, since the remaining block of the symmetric system is positive definite. In torch
2.13 on the CPU `torch.linalg.inv`, `solve` and `lu_factor` of a few hundred rows fail inside oneMKL.
"""

from typing import Any

import roma
import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from bpnp.geometry import transform

MU, SINKHORN_ITERATIONS, SINKHORN_TOLERANCE = 0.1, 100, 1e-9
PNP_ITERATIONS = 75


class PaperSinkhorn(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, cost: Tensor, mu: float = MU, iterations: int = SINKHORN_ITERATIONS,
        tolerance: float = SINKHORN_TOLERANCE,
    ) -> Tensor:  # fmt: skip
        """Return P = diag(u) exp(-M / mu) diag(v) with uniform marginals.

        The iterations end when no row sum is off by more than `tolerance`, if that is positive.
        """
        b, m, n = cost.shape
        kernel = torch.exp(-cost / mu)
        v = cost.new_full((b, 1, n), 1 / n)
        # As row vectors: in torch 2.13 on the CPU a batched product with a column on the right is ten times slower.
        row_sums = v @ kernel.mT
        for _ in range(iterations):
            u = 1 / (m * row_sums)
            v = 1 / (n * (u @ kernel))
            row_sums = v @ kernel.mT
            if tolerance > 0 and float((u * row_sums - 1 / m).abs().max()) <= tolerance:
                break
        plan = u.mT * kernel * v
        ctx.save_for_backward(plan)
        ctx.mu = mu
        return plan

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        """Return dL/dM = -P (V - a 1^T - 1 b^T)/mu with [a; b] from the inverse of [diag(r) P; P^T diag(c)] without its
        last column.

        With D = diag(r), Q = P without its last column and S = diag(c) - Q^T D^-1 Q the inverse has the blocks
        [D^-1 + D^-1 Q S^-1 Q^T D^-1, -D^-1 Q S^-1; ., S^-1]. NaN where S has no Cholesky factor.
        """
        (plan,) = ctx.saved_tensors
        rows, cols, weighted = plan.sum(-1), plan.sum(-2)[:, :-1], plan * gradient
        reduced = plan[..., :-1]
        scaled = reduced / rows.unsqueeze(-1)
        factor, info = torch.linalg.cholesky_ex(torch.diag_embed(cols) - reduced.mT @ scaled)
        positive = (info == 0)[:, None, None]
        corner = torch.cholesky_inverse(torch.where(positive, factor, torch.eye(factor.shape[-1]).to(factor)))
        corner = torch.where(positive, corner, torch.nan)
        side = -scaled @ corner
        top = torch.diag_embed(1 / rows) - side @ scaled.mT
        row_term, col_term = weighted.sum(-1, keepdim=True), weighted.sum(-2).unsqueeze(-1)[:, :-1]
        a = top @ row_term + side @ col_term
        b = side.mT @ row_term + corner @ col_term
        by_cost = -plan * (gradient - a - nn.functional.pad(b, (0, 0, 0, 1)).mT) / ctx.mu
        return by_cost, None, None, None


def objective(pose: Tensor, assignment: Tensor, rays: Tensor, points3d: Tensor) -> Tensor:
    """Return Eq. 8 over all m n pairs for each sample; `pose` (b, 6) is the angle-axis vector and the translation."""
    camera = transform(roma.rotvec_to_rotmat(pose[:, :3]), pose[:, 3:], points3d)
    return (assignment * (1 - rays @ nn.functional.normalize(camera, dim=-1).mT)).sum((-2, -1))


class PaperPnP(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, assignment: Tensor, rays: Tensor, points3d: Tensor, start: Tensor) -> Tensor:
        """Return the poses (b, 6) of one L-BFGS for the batch: 75 iterations, or until the line search fails.

        The tolerances are 0, because torch's absolute defaults stop at the first step from a pose of RANSAC. In float32
        the line search stops early, because the values of Eq. 8 have too few digits; in float64 it continues.
        """
        pose, fixed = start.clone().requires_grad_(), assignment.detach()
        solver = torch.optim.LBFGS(
            [pose], max_iter=PNP_ITERATIONS, tolerance_grad=0.0, tolerance_change=0.0, line_search_fn="strong_wolfe"
        )

        def evaluate() -> Tensor:
            solver.zero_grad()
            with torch.enable_grad():
                value = objective(pose, fixed, rays, points3d).mean()
                value.backward()
            return value

        solver.step(evaluate)
        ctx.save_for_backward(pose.detach(), assignment, rays, points3d)
        return pose.detach()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        """Return dL/dP = dL/dpose D with D = -H^-1 B (b, 6, m n) (Lemma 1)."""
        pose, assignment, rays, points3d = ctx.saved_tensors
        pose, assignment = pose.detach().requires_grad_(), assignment.detach().requires_grad_()
        with torch.enable_grad():
            value = objective(pose, assignment, rays, points3d).sum()
            (slope,) = torch.autograd.grad(value, pose, create_graph=True)
            pulled = [torch.autograd.grad(x.sum(), (pose, assignment), retain_graph=True) for x in slope.unbind(-1)]
        hessian = torch.stack([row for row, _ in pulled], 1)
        mixed = torch.stack([row.flatten(1) for _, row in pulled], 1)
        factor, _ = torch.linalg.cholesky_ex(hessian)
        jacobian = -torch.cholesky_solve(mixed, factor)
        return (gradient.unsqueeze(1) @ jacobian).view_as(assignment), None, None, None
