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
    """Multipliers (a, b) of the projection of `gradient` onto plans with the marginals of `plan`.

    Rows are centred before the elimination, so that the right-hand side loses no digits when P is almost a permutation.
    Conjugate gradients, two products a step; samples where they stall are solved by one Cholesky factorisation.
    """
    weighted = plan * gradient
    rows, cols = plan.sum(-1), plan.sum(-2)
    row_mean = _divide(weighted.sum(-1), rows)
    rhs = weighted.sum(-2) - _transpose_times(plan, row_mean)
    b = _solve_columns(plan, rows, cols, rhs, CG_TOLERANCE[plan.dtype])
    a = row_mean - _divide(_times(plan, b), rows)
    return a, b


def newton_direction(
    plan: Float[Tensor, "b m n"], row_marginal: Float[Tensor, "b m"], col_marginal: Float[Tensor, "b n"]
) -> tuple[Float[Tensor, "b m"], Float[Tensor, "b n"]]:
    """Change (x, y) of the log scalings after which diag(e^x) P diag(e^y) has the marginals, to first order."""
    rows, cols = plan.sum(-1), plan.sum(-2)
    row_error = _divide(row_marginal - rows, rows)
    rhs = col_marginal - cols - _transpose_times(plan, row_error)
    y = _solve_columns(plan, rows, cols, rhs, NEWTON_TOLERANCE)
    return row_error - _divide(_times(plan, y), rows), y


def _solve_columns(
    plan: Float[Tensor, "b m n"],
    rows: Float[Tensor, "b m"],
    cols: Float[Tensor, "b n"],
    rhs: Float[Tensor, "b n"],
    tolerance: float,
) -> Float[Tensor, "b n"]:
    """Solve S b = rhs with sum(cols * b) = 0, per sample, to a residual smaller by `tolerance`."""
    b, solved = _conjugate_gradients(plan, rows, cols, rhs, tolerance)
    if not bool(solved.all()):
        hard = (~solved).nonzero().squeeze(-1)
        b = b.index_copy(0, hard, _factorised(plan[hard], rows[hard], cols[hard], rhs[hard]).to(b.dtype))
    return b


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
    """Cholesky of S in float64. The diagonal is the sum of the other entries of its row: as a difference from `cols` it
    would be noise when P is almost a permutation."""
    plan, rows, cols, rhs = plan.double(), rows.double(), cols.double(), rhs.double()
    weights = plan.mT @ (plan * _divide(torch.ones_like(rows), rows).unsqueeze(-1))
    weights.diagonal(dim1=-2, dim2=-1).zero_()
    degree = weights.sum(-1)
    # Columns that share no row with another have no off-diagonal entry: their b is free, zero is taken. The relative
    # ridge does the same for groups of columns, and makes S definite.
    isolated = degree <= torch.finfo(degree.dtype).tiny
    laplacian = -weights
    laplacian.diagonal(dim1=-2, dim2=-1).add_(torch.where(isolated, 1, degree * (1 + RIDGE)))
    factor, _ = torch.linalg.cholesky_ex(laplacian)
    solution = torch.cholesky_solve(torch.where(isolated, 0, rhs).unsqueeze(-1), factor).squeeze(-1)
    return _centre(solution, cols)


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
