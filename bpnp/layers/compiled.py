"""Passes over a transport plan, compiled for the CPU. Elsewhere `plan`, `laplacian` and `adjoint` do them in torch.

A row of the plan is used for both products of a conjugate gradient step while it is in the cache, so that a step reads
the plan once where torch reads it twice; sums of float32 are added up in float64 in short parts. Samples are divided
among torch's threads; each stops by itself. Loops take contiguous arrays and the range of samples to work on.
"""

from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from bpnp.compilation import compiler, in_threads

# Sums in any order, as in `bpnp.search.kernels.dense`, but NaN and infinity keep their meaning: they flag a sample.
compiled = compiler(fastmath={"reassoc", "contract", "arcp", "nsz"}, error_model="numpy")
SHORT_ROW, SHORT_COLUMN = 2048, 256  # terms that are added up in the precision of the data


def applies_to(tensor: Tensor) -> bool:
    """Whether the compiled passes can read this tensor; torch's are used elsewhere."""
    return tensor.is_cpu


def moments(
    plan: Float[Tensor, "b m n"], gradient: Float[Tensor, "b m n"]
) -> tuple[Float[Tensor, "b m"], Float[Tensor, "b m"], Float[Tensor, "b n"], Float[Tensor, "b n"]]:
    """P 1, the means w of the gradient V over the rows of P, P^T 1, and P^T (V - w 1^T), in one pass."""
    b, m, n = plan.shape
    rows, means, cols, centred = (plan.new_empty(b, k) for k in (m, m, n, n))
    run(_moments, (plan, gradient), (rows, means, cols, centred))
    return rows, means, cols, centred


def square_product(kernel: Float[Tensor, "b m n"], weight: Float[Tensor, "b m"]) -> Float[Tensor, "b n"]:
    """sum_i weight_i K_ij^2."""
    total = kernel.new_empty(len(kernel), kernel.shape[2])
    run(_squares, (kernel, weight), (total,))
    return total


def projected(
    plan: Float[Tensor, "b m n"],
    gradient: Float[Tensor, "b m n"],
    a: Float[Tensor, "b m"],
    b: Float[Tensor, "b n"],
    factor: Float[Tensor, " b"],
) -> Float[Tensor, "b m n"]:
    """factor P . (V - a 1^T - 1 b^T)."""
    result = plan.new_empty(plan.shape)
    run(_project, (plan, gradient, a, b, factor), (result,))
    return result


def conjugate_gradients(
    kernel: Float[Tensor, "b m n"],
    scalings: tuple[Float[Tensor, "b m"], Float[Tensor, "b n"]],
    sums: tuple[Float[Tensor, "b m"], Float[Tensor, "b n"]],
    degree: Float[Tensor, "b n"],
    rhs: Float[Tensor, "b n"],
    tolerance: Float[Tensor, " b"],
    limit: int,
) -> tuple[Float[Tensor, "b n"], Float[Tensor, "b m"], Bool[Tensor, " b"]]:
    """x with S x = rhs for P = diag(alpha) K diag(beta), P x / rows, and which samples met the tolerance.

    S = diag(cols) - P^T diag(1 / rows) P; degree: its diagonal, the preconditioner. The residual is measured in the
    norm with the weights 1 / cols, relative to the right-hand side.
    """
    x, mean = rhs.new_zeros(rhs.shape), rhs.new_zeros(sums[0].shape)
    solved = torch.zeros(len(rhs), dtype=torch.bool)
    limits = torch.full((len(rhs),), limit)
    run(_solve, (kernel, *scalings, *sums, degree, rhs, tolerance, limits), (x, mean, solved))
    return x, mean, solved


def run(loop: Any, inputs: tuple[Tensor, ...], outputs: tuple[Tensor, ...]) -> None:
    """Call loop(first, last, *inputs, *outputs) on shares of the samples, in as many threads as torch uses.

    Inputs may have any strides; outputs are written in place and have to be contiguous.
    """
    if not all(x.is_contiguous() for x in outputs):
        raise ValueError(f"expected contiguous outputs, got strides {[x.stride() for x in outputs]}")
    arrays = [x.detach().contiguous().numpy() for x in (*inputs, *outputs)]
    in_threads(lambda first, last: loop(first, last, *arrays), len(outputs[0]))


@compiled
def _moments(start: int, stop: int, plan: Any, gradient: Any, rows: Any, means: Any, cols: Any, centred: Any) -> None:
    """plan, gradient (b, m, n) -> rows, means (b, m), cols, centred (b, n)."""
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
    """kernel (b, m, n), weight (b, m) -> totals (b, n)."""
    m, n = kernel.shape[1:]
    for s in range(start, stop):
        total = totals[s]
        total[:] = 0
        for i in range(m):
            row, value = kernel[s, i], weight[s, i]
            for j in range(n):
                total[j] += value * row[j] * row[j]


@compiled
def _project(start: int, stop: int, plan: Any, gradient: Any, a: Any, b: Any, factor: Any, result: Any) -> None:
    """plan, gradient (b, m, n), a (b, m), b (b, n), factor (b,) -> result (b, m, n)."""
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

    kernel (m, n), x (n,), before, after (m,) -> y (m,), total (n,) in float64; part (n,) is scratch memory. Sums of
    thousands of terms in float32 lose the digits in which the Laplacian's terms differ: short sums are made in the
    data's precision and added up in float64.
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
    """Add `part` (n,) to `total` (n,), and set it to zero."""
    for j in range(len(part)):
        total[j] += part[j]
        part[j] = 0


@compiled
def _solve(
    start: int, stop: int, kernel: Any, alpha: Any, beta: Any, rows: Any, cols: Any, degree: Any, rhs: Any,
    tolerance: Any, limit: Any, x: Any, mean: Any, solved: Any,
) -> None:  # fmt: skip
    """kernel (b, m, n), alpha, rows (b, m), beta, cols, degree, rhs (b, n), tolerance, limit (b,)
    -> x (b, n), mean (b, m), solved (b,); x and mean are zero at the start."""
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
