"""The linear system behind the entropic transport plan: in its gradient, and in its Newton step.

[diag(P1) P; P^T diag(P^T 1)] [a; b] = [x; y] is singular along (1, -1) and consistent when sum x = sum y. Eliminating a
leaves S b = y - P^T (x / P1) with S = diag(P^T 1) - P^T diag(1 / P1) P, the Laplacian of a graph between columns.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from bpnp.layers.fused import SHORT_ROW, conjugate_gradients, moments, square_product
from bpnp.layers.pacing import unfinished, waits

CG_ITERATIONS = 150
CG_ITERATIONS_ON_GPU = 30
CG_TOLERANCE = {torch.float32: 5e-6, torch.float64: 1e-13}
CG_TOLERANCE_PROMOTED = 1e-8  # in float64 for float32 data
SHARP = 16.0  # mass per sum of the degrees, beyond which float32 loses the gradient's fifth digit
RIDGE = 1e-13
LOST = 100.0  # a degree of so many units of rounding has no digits as a difference


@dataclass(frozen=True)
class Plan:
    """P = diag(alpha) K diag(beta), in products with vectors only; without scalings P = K."""

    kernel: Float[Tensor, "b m n"]
    alpha: Float[Tensor, "b m"] | None = None
    beta: Float[Tensor, "b n"] | None = None

    def times(self, b: Float[Tensor, "b n"]) -> Float[Tensor, "b m"]:
        product = times(self.kernel, b if self.beta is None else self.beta * b)
        return product if self.alpha is None else self.alpha * product

    def transpose_times(self, a: Float[Tensor, "b m"]) -> Float[Tensor, "b n"]:
        product = transpose_times(self.kernel, a if self.alpha is None else self.alpha * a)
        return product if self.beta is None else self.beta * product

    def degree(self, rows: Float[Tensor, "b m"], cols: Float[Tensor, "b n"]) -> Float[Tensor, "b n"]:
        """Diagonal of S.

        As cols - sum P^2 / rows it would be noise when P is nearly a permutation: P is formed then for the sum of
        positive terms.
        """
        weight = divide(torch.ones_like(rows), rows)
        scaled = weight if self.alpha is None else self.alpha**2 * weight
        on_cpu = self.kernel.device.type == "cpu"
        shared = square_product(self.kernel, scaled) if on_cpu else transpose_times(self.kernel.square(), scaled)
        shared = shared if self.beta is None else self.beta**2 * shared
        degree = cols - shared
        weak = (degree < LOST * torch.finfo(cols.dtype).eps * cols).any(-1)
        if unfinished(weak):
            plan = self.formed()
            exact = (plan * (1 - plan * weight.unsqueeze(-1))).sum(-2)
            degree = torch.where(weak.unsqueeze(-1), exact, degree)
        # A column whose links are below rounding still has an equation, which zero would hide.
        return torch.maximum(degree, torch.finfo(cols.dtype).eps * cols)

    def formed(self) -> Float[Tensor, "b m n"]:
        scaled = self.kernel if self.alpha is None else self.kernel * self.alpha.unsqueeze(-1)
        return scaled if self.beta is None else scaled * self.beta.unsqueeze(-2)

    def samples(self, some: Tensor) -> "Plan":
        kept = [None if x is None else x[some] for x in (self.alpha, self.beta)]
        return Plan(self.kernel[some], *kept)


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
    rows, row_mean, cols, rhs = _moments(plan, gradient)
    system = Plan(plan)
    degree = system.degree(rows, cols)
    b, mean, solved = _conjugate_gradients(system, rows, cols, degree, rhs, tolerance)
    if plan.dtype == torch.float64 and not waits(plan.device) and not bool(solved.all()):
        b, mean = _factorise_rest(system, rows, cols, rhs, b, mean, solved)
    return row_mean - mean, b, solved & (cols.sum(-1) <= SHARP * degree.sum(-1))


def _moments(plan: Tensor, gradient: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """P 1, the rows' means w of the gradient V, P^T 1 and P^T (V - w 1^T)."""
    if plan.device.type == "cpu":
        return moments(plan, gradient)
    weighted, rows = plan * gradient, plan.sum(-1)
    means = divide(weighted.sum(-1), rows)
    return rows, means, plan.sum(-2), weighted.sum(-2) - transpose_times(plan, means)


def newton_direction(
    plan: Plan,
    rows: Float[Tensor, "b m"],
    row_marginal: Float[Tensor, "b m"],
    col_marginal: Float[Tensor, "b n"],
    tolerance: Float[Tensor, " b"],
) -> tuple[Float[Tensor, "b m"], Float[Tensor, "b n"], Bool[Tensor, " b"]]:
    """Change (x, y) of the log scalings after which diag(e^x) P diag(e^y) has the marginals, to first order.

    rows: P 1; the columns have their sums already. tolerance: relative to the error of the rows, for each sample.
    Where conjugate gradients stall, float64 factorises; the last value tells which samples float32 has no step for.
    """
    row_error = divide(row_marginal - rows, rows)
    rhs = -plan.transpose_times(row_error)
    degree = plan.degree(rows, col_marginal)
    y, mean, solved = _conjugate_gradients(plan, rows, col_marginal, degree, rhs, tolerance)
    if waits(rows.device):
        return row_error - mean, y, torch.ones_like(solved)
    if rows.dtype == torch.float64 and not bool(solved.all()):
        y, mean = _factorise_rest(plan, rows, col_marginal, rhs, y, mean, solved)
        solved = torch.ones_like(solved)
    return row_error - mean, y, solved


def _conjugate_gradients(
    plan: Plan, rows: Tensor, cols: Tensor, degree: Tensor, rhs: Tensor, tolerance: float | Tensor
) -> tuple[Float[Tensor, "b n"], Float[Tensor, "b m"], Bool[Tensor, " b"]]:
    """b and P b / rows, preconditioned by the diagonal of S; each sample stops by itself.

    The residual is measured per unit of mass: in the preconditioner's own measure columns with weak links would
    outweigh all others.
    """
    if rhs.device.type == "cpu":
        alpha = torch.ones_like(rows) if plan.alpha is None else plan.alpha
        beta = torch.ones_like(cols) if plan.beta is None else plan.beta
        x, mean, solved = conjugate_gradients(
            plan.kernel, (alpha, beta), (rows, cols), degree, rhs, tolerance, CG_ITERATIONS
        )
        return _centred(x, mean, rows, cols, solved)
    inverse, unit, per_row = (divide(torch.ones_like(x), x) for x in (degree, cols, rows))
    x, mean = torch.zeros_like(rhs), torch.zeros_like(rows)
    r = rhs
    p = z = inverse * r
    rz = torch.linalg.vecdot(r, z)
    target = torch.linalg.vecdot(unit * r, r) * tolerance**2
    active = rz > 0
    solved = ~active
    for _ in range(CG_ITERATIONS_ON_GPU):
        mean_p = per_row * plan.times(p)
        sp = torch.addcmul(-plan.transpose_times(mean_p), cols, p)
        curvature = torch.linalg.vecdot(p, sp)
        positive = curvature > 0
        # A sample that has converged exactly has 0/0 here one step later: it must stop by itself.
        alpha = torch.where(active & positive, rz / curvature, 0).unsqueeze(-1)
        x = torch.addcmul(x, alpha, p)
        mean = torch.addcmul(mean, alpha, mean_p)
        r = torch.addcmul(r, alpha, sp, value=-1)
        solved = solved | (active & (torch.linalg.vecdot(unit * r, r) <= target))
        active = active & positive & ~solved
        z = inverse * r
        rz_new = torch.linalg.vecdot(r, z)
        p = torch.addcmul(z, divide(rz_new, rz).unsqueeze(-1), p)
        rz = rz_new
    return _centred(x, mean, rows, cols, solved)


def _centred(x: Tensor, mean: Tensor, rows: Tensor, cols: Tensor, solved: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Without the component along the null vector."""
    shift = _mean(x, cols)
    return torch.where(cols > 0, x - shift, 0), torch.where(rows > 0, mean - shift, 0), solved


def _factorise_rest(
    plan: Plan, rows: Tensor, cols: Tensor, rhs: Tensor, b: Tensor, mean: Tensor, solved: Bool[Tensor, " b"]
) -> tuple[Float[Tensor, "b n"], Float[Tensor, "b m"]]:
    hard = (~solved).nonzero().squeeze(-1)
    kept = plan.samples(hard)
    exact = _factorised(kept.formed().double(), *(x[hard].double() for x in (rows, cols, rhs))).to(b.dtype)
    exact_mean = divide(kept.times(exact), rows[hard])
    return b.index_copy(0, hard, exact), mean.index_copy(0, hard, exact_mean)


def _factorised(plan: Tensor, rows: Tensor, cols: Tensor, rhs: Tensor) -> Tensor:
    """Cholesky of S, in float64.

    The diagonal is the sum of the other entries of its row: as a difference from `cols` it would be noise when P is
    almost a permutation.
    """
    laplacian = plan.mT @ (plan * divide(-torch.ones_like(rows), rows).unsqueeze(-1))
    diagonal = laplacian.diagonal(dim1=-2, dim2=-1)
    diagonal.zero_()
    # Between groups of columns that hardly share a row, the right-hand side is rounding and S nearly singular. The
    # ridge, relative to the marginals, keeps the difference of their b small where it hardly matters.
    diagonal.copy_(torch.where(cols > 0, RIDGE * cols - laplacian.sum(-1), 1))
    factor, _ = torch.linalg.cholesky_ex(laplacian)
    b = torch.cholesky_solve(rhs.unsqueeze(-1), factor).squeeze(-1)
    return torch.where(cols > 0, b - _mean(b, cols), 0)


def _mean(b: Tensor, cols: Tensor) -> Tensor:
    """Component along the null vector (b, 1)."""
    return (cols * b).sum(-1, keepdim=True) / cols.sum(-1, keepdim=True)


def times(matrix: Float[Tensor, "b m n"], b: Float[Tensor, "b n"]) -> Float[Tensor, "b m"]:
    """Product from a row vector: in torch 2.13 on the CPU a batched one with a column takes eight times as long."""
    if _is_long(matrix):
        return _long_product(matrix.mT, b)
    return (b.unsqueeze(-2) @ matrix.mT).squeeze(-2)


def transpose_times(matrix: Float[Tensor, "b m n"], a: Float[Tensor, "b m"]) -> Float[Tensor, "b n"]:
    return _long_product(matrix, a) if _is_long(matrix) else (a.unsqueeze(-2) @ matrix).squeeze(-2)


def _is_long(matrix: Tensor) -> bool:
    return matrix.dtype == torch.float32 and matrix.device.type == "cpu" and max(matrix.shape[-2:]) > 2 * SHORT_ROW


def _long_product(matrix: Float[Tensor, "b m n"], a: Float[Tensor, "b m"]) -> Float[Tensor, "b n"]:
    """a^T M, its short sums added up in float64: one float32 sum of 15,000 terms is wrong by 1e-6."""
    parts = zip(matrix.split(SHORT_ROW, -2), a.split(SHORT_ROW, -1), strict=True)
    total = torch.stack([(vector.unsqueeze(-2) @ rows).squeeze(-2) for rows, vector in parts])
    return total.sum(0, dtype=torch.float64).to(matrix.dtype)


def divide(numerator: Tensor, denominator: Tensor) -> Tensor:
    """Quotient, zero at padded rows and columns, whose sum is zero."""
    return torch.where(denominator > 0, numerator / denominator, 0)
