"""The layers' linear algebra on a CPU: one loop for each sample, that reads the plan once an iteration.

`bpnp.layers.adjoint` states the transport's in torch, for other devices. A row of the plan is used for both products
while it is in the cache, samples run on different cores without waiting for each other, and each stops by itself.
"""

from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from bpnp.compilation import compiler
from bpnp.layers.memory import empty
from bpnp.thread_pool import spread

# Sums in any order, as in `bpnp.search.kernels.dense`, but NaN and infinity keep their meaning: they flag a sample.
compiled = compiler(fastmath={"reassoc", "contract", "arcp", "nsz"}, error_model="numpy")
SHORT_ROW, SHORT_COLUMN = 2048, 256  # terms that are added up in the precision of the data


def moments(
    plan: Float[Tensor, "b m n"], gradient: Float[Tensor, "b m n"]
) -> tuple[Float[Tensor, "b m"], Float[Tensor, "b m"], Float[Tensor, "b n"], Float[Tensor, "b n"]]:
    """Row sums of P, means w of the gradient V over the rows, column sums of P, and P^T (V - w 1^T)."""
    b, m, n = plan.shape
    rows, means, cols, centred = (plan.new_empty(b, k) for k in (m, m, n, n))
    run(_moments, plan, gradient, rows, means, cols, centred)
    return rows, means, cols, centred


def square_product(kernel: Float[Tensor, "b m n"], weight: Float[Tensor, "b m"]) -> Float[Tensor, "b n"]:
    """sum_i weight_i K_ij^2."""
    total = kernel.new_empty(len(kernel), kernel.shape[2])
    run(_squares, kernel, weight, total)
    return total


def outer_products(
    left: Float[Tensor, "b m 3"], right: Float[Tensor, "b n 3"]
) -> Float[Tensor, "b m n"]:  # fmt: skip
    """left @ right^T in one pass of writing: a product made for many more columns takes twice as long."""
    result = empty(torch.Size((*left.shape[:2], right.shape[1])), dtype=left.dtype, device=left.device)
    run(_outer, left, right.mT, result)
    return result


def projected(
    plan: Float[Tensor, "b m n"],
    gradient: Float[Tensor, "b m n"],
    a: Float[Tensor, "b m"],
    b: Float[Tensor, "b n"],
    factor: float,
) -> Float[Tensor, "b m n"]:
    """factor P . (V - a 1^T - 1 b^T)."""
    result = empty(plan.shape, dtype=plan.dtype, device=plan.device)
    run(_project, plan, gradient, a, b, torch.full_like(plan[:, 0, 0], factor), result)
    return result


def conjugate_gradients(
    kernel: Float[Tensor, "b m n"],
    scalings: tuple[Float[Tensor, "b m"], Float[Tensor, "b n"]],
    sums: tuple[Float[Tensor, "b m"], Float[Tensor, "b n"]],
    degree: Float[Tensor, "b n"],
    rhs: Float[Tensor, "b n"],
    tolerance: float | Float[Tensor, " b"],
    limit: int,
) -> tuple[Float[Tensor, "b n"], Float[Tensor, "b m"], Bool[Tensor, " b"]]:
    """x with S x = rhs for P = diag(alpha) K diag(beta), P x / rows, and which samples met the tolerance."""
    x, mean = torch.zeros_like(rhs), torch.zeros_like(sums[0])
    solved = torch.zeros(len(rhs), dtype=torch.bool)
    bound = torch.zeros_like(rhs[:, 0]) + tolerance
    limits = torch.full_like(solved, limit, dtype=torch.long)
    run(_solve, kernel, *scalings, *sums, degree, rhs, bound, limits, x, mean, solved)
    return x, mean, solved


def run(loop: Any, *values: Tensor) -> None:
    """Call a loop over samples, which stops for no other, on as many threads as torch uses."""
    arrays = [x.detach().contiguous().numpy() for x in values]
    spread(lambda first, last: loop(first, last, *arrays), len(values[0]))


@compiled
def _moments(start: int, stop: int, plan: Any, gradient: Any, rows: Any, means: Any, cols: Any, centred: Any) -> None:
    m, n = plan.shape[1:]
    for s in range(start, stop):
        mass, pull = cols[s], centred[s]
        short_mass, short_pull = np.zeros_like(mass), np.zeros_like(pull)
        long_mass, long_pull = np.zeros(n), np.zeros(n)
        for i in range(m):
            row, slope = plan[s, i], gradient[s, i]
            total, weighted = mass.dtype.type(0), mass.dtype.type(0)
            for j in range(n):
                total += row[j]
                weighted += row[j] * slope[j]
            mean = weighted / total if total > 0 else mass.dtype.type(0)
            rows[s, i], means[s, i] = total, mean
            for j in range(n):
                short_mass[j] += row[j]
                short_pull[j] += row[j] * (slope[j] - mean)
            if i % SHORT_COLUMN == SHORT_COLUMN - 1 or i == m - 1:
                _flush(short_mass, long_mass)
                _flush(short_pull, long_pull)
        mass[:] = long_mass
        pull[:] = long_pull


@compiled
def _squares(start: int, stop: int, kernel: Any, weight: Any, totals: Any) -> None:
    m, n = kernel.shape[1:]
    for s in range(start, stop):
        total = totals[s]
        total[:] = 0
        for i in range(m):
            row, value = kernel[s, i], weight[s, i]
            for j in range(n):
                total[j] += value * row[j] * row[j]


@compiled
def _outer(start: int, stop: int, left: Any, right: Any, result: Any) -> None:
    m, n = result.shape[1:]
    for s in range(start, stop):
        x, y, z = right[s, 0], right[s, 1], right[s, 2]
        for i in range(m):
            row, a, b, c = result[s, i], left[s, i, 0], left[s, i, 1], left[s, i, 2]
            for j in range(n):
                row[j] = a * x[j] + b * y[j] + c * z[j]


@compiled
def _project(start: int, stop: int, plan: Any, gradient: Any, a: Any, b: Any, factor: Any, result: Any) -> None:
    m, n = plan.shape[1:]
    for s in range(start, stop):
        column = b[s]
        for i in range(m):
            out, row, slope, mean = result[s, i], plan[s, i], gradient[s, i], a[s, i]
            for j in range(n):
                out[j] = factor[s] * row[j] * (slope[j] - mean - column[j])


@compiled
def _products(kernel: Any, x: Any, before: Any, after: Any, y: Any, part: Any, total: Any) -> None:
    """y = before . (K x) and total = K^T (after . y), four rows at a time.

    Sums of thousands of terms in float32 lose the digits in which the Laplacian's terms differ: they are kept short,
    and added up in float64 (`total`).
    """
    m, n = kernel.shape
    zero = part.dtype.type(0)
    total[:] = 0
    part[:] = 0
    whole = m - m % 4
    for i in range(0, whole, 4):
        row0, row1, row2, row3 = kernel[i], kernel[i + 1], kernel[i + 2], kernel[i + 3]
        dot0 = dot1 = dot2 = dot3 = 0.0
        for start in range(0, n, SHORT_ROW):
            sum0 = sum1 = sum2 = sum3 = zero
            for j in range(start, min(start + SHORT_ROW, n)):
                sum0 += row0[j] * x[j]
                sum1 += row1[j] * x[j]
                sum2 += row2[j] * x[j]
                sum3 += row3[j] * x[j]
            dot0 += sum0
            dot1 += sum1
            dot2 += sum2
            dot3 += sum3
        y[i], y[i + 1], y[i + 2], y[i + 3] = dot0, dot1, dot2, dot3
        for k in range(i, i + 4):
            y[k] *= before[k]
        mean0, mean1 = after[i] * y[i], after[i + 1] * y[i + 1]
        mean2, mean3 = after[i + 2] * y[i + 2], after[i + 3] * y[i + 3]
        for j in range(n):
            part[j] += (mean0 * row0[j] + mean1 * row1[j]) + (mean2 * row2[j] + mean3 * row3[j])
        if i % SHORT_COLUMN == SHORT_COLUMN - 4:
            _flush(part, total)
    for i in range(whole, m):
        row = kernel[i]
        dot0 = 0.0
        for j in range(n):
            dot0 += row[j] * x[j]
        y[i] = before[i] * dot0
        mean0 = after[i] * y[i]
        for j in range(n):
            part[j] += mean0 * row[j]
    _flush(part, total)


@compiled
def _flush(part: Any, total: Any) -> None:
    for j in range(len(part)):
        total[j] += part[j]
        part[j] = 0


@compiled
def _solve(
    start: int, stop: int, kernel: Any, alpha: Any, beta: Any, rows: Any, cols: Any, degree: Any, rhs: Any,
    tolerance: Any, limit: Any, x: Any, mean: Any, solved: Any,
) -> None:  # fmt: skip
    for s in range(start, stop):
        inverse = np.where(degree[s] > 0, 1 / degree[s], 0).astype(rhs.dtype)
        unit = np.where(cols[s] > 0, 1 / cols[s], 0).astype(rhs.dtype)
        before = np.where(rows[s] > 0, alpha[s] / rows[s], 0).astype(rhs.dtype)
        r, p = rhs[s].copy(), inverse * rhs[s]
        y, part, total = np.empty_like(rows[s]), np.empty_like(r), np.empty(len(r))
        rz, target = (r * p).sum(), (unit * r * r).sum() * tolerance[s] ** 2
        solved[s] = not rz > 0
        for _ in range(limit[s]):
            if solved[s]:
                break
            _products(kernel[s], beta[s] * p, before, alpha[s], y, part, total)
            sp = (cols[s] * p - beta[s] * total).astype(rhs.dtype)
            curvature = (p * sp).sum()
            if not curvature > 0:
                break
            step = rz / curvature
            x[s] += step * p
            mean[s] += step * y
            r -= step * sp
            solved[s] = (unit * r * r).sum() <= target
            z = inverse * r
            previous, rz = rz, (r * z).sum()
            p = z + (rz / previous) * p
