"""Conjugate gradients on the Laplacian of a transport plan, compiled for the CPU: `bpnp.layers.laplacian` in one pass.

A row of the plan is used for both products of a step while it is in the cache, so that a step reads the plan once where
torch reads it twice. Samples are divided among torch's threads; each stops by itself.
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
    """y = before . (K x) and total = K^T (after . y).

    kernel (m, n), x (n,), before, after (m,) -> y (m,), total (n,) in float64; part (n,) is scratch memory. Sums of
    thousands of terms in float32 lose the digits in which the Laplacian's terms differ: short sums are made in the
    data's precision and added up in float64.
    """
    total[:] = 0
    part[:] = 0
    for i in range(len(kernel)):
        row = kernel[i]
        y[i] = before[i] * _dot(row, x)
        mean = after[i] * y[i]
        for j in range(len(part)):
            part[j] += mean * row[j]
        if i % SHORT_COLUMN == SHORT_COLUMN - 1:
            _flush(part, total)
    _flush(part, total)


@compiled
def _dot(row: Any, x: Any) -> float:
    """row . x, both (n,). The loop is over slices: an index that might be negative is not made a vector instruction."""
    total = 0.0
    for start in range(0, len(x), SHORT_SUM):
        some, factors = row[start : start + SHORT_SUM], x[start : start + SHORT_SUM]
        short = x.dtype.type(0)
        for j in range(len(some)):
            short += some[j] * factors[j]
        total += short
    return total


@compiled
def _flush(part: Any, total: Any) -> None:
    """Add `part` (n,) to `total` (n,), and set it to zero."""
    for j in range(len(part)):
        total[j] += part[j]
        part[j] = 0


@compiled
def _invert(values: Any, result: Any) -> None:
    """1 / values into `result`, both (n,), which stays zero where a value is not positive."""
    for j in range(len(values)):
        if values[j] > 0:
            result[j] = 1 / values[j]


@compiled
def _solve(
    start: int, stop: int, limit: int, kernel: Any, alpha: Any, beta: Any, rows: Any, cols: Any, degree: Any, rhs: Any,
    tolerance: Any, x: Any, mean: Any, solved: Any,
) -> None:  # fmt: skip
    """Samples start to stop: kernel (b, m, n), alpha, rows (b, m), beta, cols, degree, rhs (b, n), tolerance (b,)
    -> x (b, n), mean (b, m), solved (b,); x and mean are zero at the start. limit: of the iterations. In loops, for
    numpy's expressions of several arrays take seconds to compile."""
    for s in range(start, stop):
        inverse, unit, before = np.zeros_like(rhs[s]), np.zeros_like(rhs[s]), np.zeros_like(rows[s])
        _invert(degree[s], inverse)
        _invert(cols[s], unit)
        _invert(rows[s], before)
        for i in range(len(before)):
            before[i] *= alpha[s, i]
        r, p, sp, weighed = rhs[s].copy(), np.empty_like(unit), np.empty_like(unit), np.empty_like(unit)
        y, part, total = np.empty_like(before), np.empty_like(r), np.empty(len(r))
        rz = target = 0.0
        for j in range(len(r)):
            p[j] = inverse[j] * r[j]
            rz += r[j] * p[j]
            target += unit[j] * r[j] * r[j] * tolerance[s] ** 2
        solved[s] = not rz > 0
        for _ in range(limit):
            if solved[s]:
                break
            for j in range(len(p)):
                weighed[j] = beta[s, j] * p[j]
            _products(kernel[s], weighed, before, alpha[s], y, part, total)
            curvature = 0.0
            for j in range(len(p)):
                sp[j] = cols[s, j] * p[j] - beta[s, j] * total[j]
                curvature += p[j] * sp[j]
            if not curvature > 0:
                break
            step, previous, rz, residual = rz / curvature, rz, 0.0, 0.0
            for i in range(len(y)):
                mean[s, i] += step * y[i]
            for j in range(len(p)):
                x[s, j] += step * p[j]
                r[j] -= step * sp[j]
                residual += unit[j] * r[j] * r[j]
                rz += inverse[j] * r[j] * r[j]
            solved[s] = residual <= target
            for j in range(len(p)):
                p[j] = inverse[j] * r[j] + rz / previous * p[j]
