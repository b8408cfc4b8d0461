"""The linear system behind the entropic transport plan: in its gradient, and in its Newton step.

[diag(P1) P; P^T diag(P^T 1)] [a; b] = [x; y] is singular along (1, -1) and consistent when sum x = sum y. Eliminating a
leaves S b = y - P^T (x / P1) with S = diag(P^T 1) - P^T diag(1 / P1) P, the Laplacian of a graph between columns.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

CG_ITERATIONS = 30
CG_TOLERANCE = {torch.float32: 1e-6, torch.float64: 1e-13}
NEWTON_TOLERANCE = 1e-2
RIDGE = 1e-13


def solve_multipliers(
    plan: Float[Tensor, "b m n"], gradient: Float[Tensor, "b m n"]
) -> tuple[Float[Tensor, "b m"], Float[Tensor, "b n"]]:
    """Multipliers (a, b) of the projection of `gradient` onto plans with the marginals of `plan`; sum(P^T 1 . b) = 0.

    Conjugate gradients, two products a step; samples where they stall are solved by one Cholesky factorisation. These
    have groups of points with weak links, which magnify the rounding of the right-hand side: it is made in float64 too.
    """
    rows, cols = plan.sum(-1), plan.sum(-2)
    row_mean, rhs = _reduce(plan, gradient, rows)
    b, solved = _conjugate_gradients(plan, rows, cols, rhs, CG_TOLERANCE[plan.dtype])
    if not bool(solved.all()):
        hard = (~solved).nonzero().squeeze(-1)
        part = plan[hard].double()
        part_rows, part_cols = part.sum(-1), part.sum(-2)
        _, part_rhs = _reduce(part, gradient[hard].double(), part_rows)
        b = b.index_copy(0, hard, _factorised(part, part_rows, part_cols, part_rhs).to(b.dtype))
    return row_mean - _divide(_times(plan, b), rows), b


def _reduce(plan: Tensor, gradient: Tensor, rows: Tensor) -> tuple[Tensor, Tensor]:
    """Mean of `gradient` in each row, and the right-hand side that is left once the rows are eliminated."""
    weighted = plan * gradient
    row_mean = _divide(weighted.sum(-1), rows)
    return row_mean, weighted.sum(-2) - _transpose_times(plan, row_mean)


def newton_direction(
    plan: Float[Tensor, "b m n"], row_marginal: Float[Tensor, "b m"], col_marginal: Float[Tensor, "b n"]
) -> tuple[Float[Tensor, "b m"], Float[Tensor, "b n"]]:
    """Change (x, y) of the log scalings after which diag(e^x) P diag(e^y) has the marginals, to first order."""
    rows, cols = plan.sum(-1), plan.sum(-2)
    row_error = _divide(row_marginal - rows, rows)
    rhs = col_marginal - cols - _transpose_times(plan, row_error)
    y, solved = _conjugate_gradients(plan, rows, cols, rhs, NEWTON_TOLERANCE)
    if not bool(solved.all()):
        hard = (~solved).nonzero().squeeze(-1)
        exact = _factorised(*(x[hard].double() for x in (plan, rows, cols, rhs)))
        y = y.index_copy(0, hard, exact.to(y.dtype))
    return row_error - _divide(_times(plan, y), rows), y


def _conjugate_gradients(
    plan: Tensor, rows: Tensor, cols: Tensor, rhs: Tensor, tolerance: float
) -> tuple[Float[Tensor, "b n"], Bool[Tensor, " b"]]:
    """Preconditioned by diag(cols), in the metric where S has eigenvalues in [0, 1]; each sample stops by itself."""
    inverse = _divide(torch.ones_like(cols), cols)
    x = torch.zeros_like(rhs)
    r = rhs
    z = _centre(inverse * r, cols)
    p = z
    rz = (r * z).sum(-1)
    target = rz * tolerance**2
    active = rz > 0
    for _ in range(CG_ITERATIONS):
        if not bool(active.any()):
            break
        sp = cols * p - _transpose_times(plan, _divide(_times(plan, p), rows))
        curvature = (p * sp).sum(-1)
        # A sample that has converged exactly has 0/0 here one step later: it must stop by itself.
        alpha = torch.where(active & (curvature > 0), rz / curvature, 0).unsqueeze(-1)
        x = x + alpha * p
        r = r - alpha * sp
        z = _centre(inverse * r, cols)
        rz_new = (r * z).sum(-1)
        beta = torch.where(active & (rz > 0), rz_new / rz, 0).unsqueeze(-1)
        p = torch.where(active.unsqueeze(-1), z + beta * p, p)
        rz = torch.where(active, rz_new, rz)
        active = active & (rz > target) & (curvature > 0)
    return x, rz <= target


def _factorised(plan: Tensor, rows: Tensor, cols: Tensor, rhs: Tensor) -> Tensor:
    """Cholesky of S, in float64.

    The diagonal is the sum of the other entries of its row: as a difference from `cols` it would be noise when P is
    almost a permutation.
    """
    laplacian = plan.mT @ (plan * _divide(-torch.ones_like(rows), rows).unsqueeze(-1))
    diagonal = laplacian.diagonal(dim1=-2, dim2=-1)
    diagonal.zero_()
    # Between groups of columns that hardly share a row, the right-hand side is rounding and S nearly singular. The
    # ridge, relative to the marginals, keeps the difference of their b small where it hardly matters.
    diagonal.copy_(torch.where(cols > 0, RIDGE * cols - laplacian.sum(-1), 1))
    factor, _ = torch.linalg.cholesky_ex(laplacian)
    return _centre(torch.cholesky_solve(rhs.unsqueeze(-1), factor).squeeze(-1), cols)


def _centre(b: Tensor, cols: Tensor) -> Tensor:
    """Remove the component along the null vector; padded columns stay zero."""
    return torch.where(cols > 0, b - (cols * b).sum(-1, keepdim=True) / cols.sum(-1, keepdim=True), 0)


def _times(plan: Tensor, b: Tensor) -> Tensor:
    return (plan @ b.unsqueeze(-1)).squeeze(-1)


def _transpose_times(plan: Tensor, a: Tensor) -> Tensor:
    return (a.unsqueeze(-2) @ plan).squeeze(-2)


def _divide(numerator: Tensor, denominator: Tensor) -> Tensor:
    """Quotient, zero at padded rows and columns, whose sum is zero."""
    return torch.where(denominator > 0, numerator / denominator, 0)
