"""The linear system behind the entropic transport plan: in its gradient, and in its Newton step.

[diag(P1) P; P^T diag(P^T 1)] [a; b] = [x; y] is singular along (1, -1) and consistent when sum x = sum y. Eliminating a
leaves S b = y - P^T (x / P1) with S = diag(P^T 1) - P^T diag(1 / P1) P, the Laplacian of a graph between columns.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from bpnp.layers.pacing import unfinished, waits

CG_ITERATIONS = 30
CG_TOLERANCE = {torch.float32: 1e-6, torch.float64: 1e-13}
CG_TOLERANCE_PROMOTED = 1e-8  # in float64 for float32 data
NEWTON_TOLERANCE = 1e-2
SHARP = 16.0  # cols / degree beyond which float32 loses the gradient's sixth digit
RIDGE = 1e-13


def solve_multipliers(
    plan: Float[Tensor, "b m n"], gradient: Float[Tensor, "b m n"]
) -> tuple[Float[Tensor, "b m"], Float[Tensor, "b n"]]:
    """Multipliers (a, b) of the projection of `gradient` onto plans with the marginals of `plan`; sum(P^T 1 . b) = 0.

    Conjugate gradients, two products a step. Samples whose plan is sharp, where differences of nearly equal numbers
    decide, and samples that stall are solved in float64; what stalls there too by one Cholesky factorisation. A GPU
    is not waited for: it solves all in float64, without a factorisation.
    """
    if plan.dtype == torch.float64:
        return _solve(plan, gradient, CG_TOLERANCE[torch.float64])[:2]
    if waits(plan.device):
        a, b, _ = _solve(plan.double(), gradient.double(), CG_TOLERANCE_PROMOTED)
        return a.to(plan.dtype), b.to(plan.dtype)
    a, b, trusted = _solve(plan, gradient, CG_TOLERANCE[torch.float32])
    if not bool(trusted.all()):
        hard = (~trusted).nonzero().squeeze(-1)
        exact_a, exact_b, _ = _solve(plan[hard].double(), gradient[hard].double(), CG_TOLERANCE_PROMOTED)
        a, b = a.index_copy(0, hard, exact_a.to(a.dtype)), b.index_copy(0, hard, exact_b.to(b.dtype))
    return a, b


def _solve(
    plan: Tensor, gradient: Tensor, tolerance: float
) -> tuple[Float[Tensor, "b m"], Float[Tensor, "b n"], Bool[Tensor, " b"]]:
    """(a, b) in the precision of the plan, and whether that precision is enough."""
    weighted = plan * gradient
    rows, cols = plan.sum(-1), plan.sum(-2)
    row_mean = _divide(weighted.sum(-1), rows)
    rhs = weighted.sum(-2) - _transpose_times(plan, row_mean)
    degree = _degree(plan, rows, cols)
    b, solved = _conjugate_gradients(plan, rows, cols, degree, rhs, tolerance)
    if plan.dtype == torch.float64 and not waits(plan.device) and not bool(solved.all()):
        b = _factorise_rest(plan, rows, cols, rhs, b, solved)
    trusted = solved & (_divide(cols, degree).amax(-1) <= SHARP)
    return row_mean - _divide(_times(plan, b), rows), b, trusted


def newton_direction(
    plan: Float[Tensor, "b m n"], row_marginal: Float[Tensor, "b m"], col_marginal: Float[Tensor, "b n"]
) -> tuple[Float[Tensor, "b m"], Float[Tensor, "b n"]]:
    """Change (x, y) of the log scalings after which diag(e^x) P diag(e^y) has the marginals, to first order."""
    rows, cols = plan.sum(-1), plan.sum(-2)
    row_error = _divide(row_marginal - rows, rows)
    rhs = col_marginal - cols - _transpose_times(plan, row_error)
    y, solved = _conjugate_gradients(plan, rows, cols, _degree(plan, rows, cols), rhs, NEWTON_TOLERANCE)
    if not waits(plan.device) and not bool(solved.all()):
        y = _factorise_rest(plan, rows, cols, rhs, y, solved)
    return row_error - _divide(_times(plan, y), rows), y


def _degree(plan: Tensor, rows: Tensor, cols: Tensor) -> Float[Tensor, "b n"]:
    """Diagonal of S as a sum of positive terms: cols - sum P^2 / rows would be noise when P is nearly a permutation."""
    degree = (plan * (1 - _divide(plan, rows.unsqueeze(-1)))).sum(-2)
    # A column whose links are below rounding still has an equation, which zero would hide.
    return torch.maximum(degree, torch.finfo(plan.dtype).eps * cols)


def _conjugate_gradients(
    plan: Tensor, rows: Tensor, cols: Tensor, degree: Tensor, rhs: Tensor, tolerance: float
) -> tuple[Float[Tensor, "b n"], Bool[Tensor, " b"]]:
    """Preconditioned by the diagonal of S; each sample stops by itself, at a residual measured per unit of mass.

    In the preconditioner's own measure columns with weak links would outweigh all others.
    """
    inverse, unit = _divide(torch.ones_like(cols), degree), _divide(torch.ones_like(cols), cols)
    x = torch.zeros_like(rhs)
    r = rhs
    p = z = inverse * r
    rz = (r * z).sum(-1)
    target = (unit * r * r).sum(-1) * tolerance**2
    active = rz > 0
    solved = ~active
    for _ in range(CG_ITERATIONS):
        if not unfinished(active):
            break
        sp = cols * p - _transpose_times(plan, _divide(_times(plan, p), rows))
        curvature = (p * sp).sum(-1)
        # A sample that has converged exactly has 0/0 here one step later: it must stop by itself.
        alpha = torch.where(active & (curvature > 0), rz / curvature, 0).unsqueeze(-1)
        x = x + alpha * p
        r = r - alpha * sp
        solved = solved | (active & ((unit * r * r).sum(-1) <= target))
        z = inverse * r
        rz_new = (r * z).sum(-1)
        beta = torch.where(active & (rz > 0), rz_new / rz, 0).unsqueeze(-1)
        p = torch.where(active.unsqueeze(-1), z + beta * p, p)
        rz = torch.where(active, rz_new, rz)
        active = active & ~solved & (curvature > 0)
    return _centre(x, cols), solved


def _factorise_rest(
    plan: Tensor, rows: Tensor, cols: Tensor, rhs: Tensor, b: Tensor, solved: Bool[Tensor, " b"]
) -> Float[Tensor, "b n"]:
    hard = (~solved).nonzero().squeeze(-1)
    exact = _factorised(*(x[hard].double() for x in (plan, rows, cols, rhs)))
    return b.index_copy(0, hard, exact.to(b.dtype))


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
