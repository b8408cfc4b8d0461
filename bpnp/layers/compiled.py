"""Conjugate gradients on the Laplacian of a transport plan, compiled for the CPU: `bpnp.layers.laplacian` in one pass.

A row of the plan is used for both products of a step while it is in the cache, so that a step reads the plan once where
torch reads it twice; sums of float32 are added up in float64 in short parts. Samples are divided among torch's threads;
each stops by itself.
"""

from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from bpnp.compilation import compiler, in_threads
from bpnp.layers.plan import SHORT_SUM, Plan

# Sums in any order, as in `bpnp.search.kernels.dense`, but NaN and infinity keep their meaning: they flag a sample.
compiled = compiler(fastmath={"reassoc", "contract", "arcp", "nsz"}, error_model="numpy")
SHORT_COLUMN = 256  # rows that are added up in the precision of the data


def applies_to(tensor: Tensor) -> bool:
    """Whether the compiled loop can read this tensor."""
    return tensor.is_cpu


def conjugate_gradients(
    plan: Plan,
    rows: Float[Tensor, "b m"],
    cols: Float[Tensor, "b n"],
    degree: Float[Tensor, "b n"],
    rhs: Float[Tensor, "b n"],
    tolerance: Float[Tensor, " b"],
    limit: int,
) -> tuple[Float[Tensor, "b n"], Float[Tensor, "b m"], Bool[Tensor, " b"]]:
    """`bpnp.layers.laplacian.conjugate_gradients`, same arguments and results; the inputs may have any strides."""
    inputs = plan.kernel, plan.alpha, plan.beta, rows, cols, degree, rhs, tolerance
    x, mean = rhs.new_zeros(rhs.shape), rhs.new_zeros(rows.shape)
    solved = torch.zeros(len(rhs), dtype=torch.bool)
    arrays = [value.detach().contiguous().numpy() for value in (*inputs, x, mean, solved)]
    in_threads(lambda first, last: _solve(first, last, limit, *arrays), len(rhs))
    return x, mean, solved


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
        for start in range(0, n, SHORT_SUM):
            sum0 = sum1 = sum2 = sum3 = zero
            for j in range(start, min(start + SHORT_SUM, n)):
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
    start: int, stop: int, limit: int, kernel: Any, alpha: Any, beta: Any, rows: Any, cols: Any, degree: Any, rhs: Any,
    tolerance: Any, x: Any, mean: Any, solved: Any,
) -> None:  # fmt: skip
    """Samples start to stop: kernel (b, m, n), alpha, rows (b, m), beta, cols, degree, rhs (b, n), tolerance (b,)
    -> x (b, n), mean (b, m), solved (b,); x and mean are zero at the start. limit: of the iterations."""
    for s in range(start, stop):
        inverse = np.where(degree[s] > 0, 1 / degree[s], 0).astype(rhs.dtype)
        unit = np.where(cols[s] > 0, 1 / cols[s], 0).astype(rhs.dtype)
        before = np.where(rows[s] > 0, alpha[s] / rows[s], 0).astype(rhs.dtype)
        r, p = rhs[s].copy(), inverse * rhs[s]
        y, part, total = np.empty_like(rows[s]), np.empty_like(r), np.empty(len(r))
        rz, target = (r * p).sum(), (unit * r * r).sum() * tolerance[s] ** 2
        solved[s] = not rz > 0
        for _ in range(limit):
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
