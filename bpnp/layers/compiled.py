"""Conjugate gradients on the Laplacian of a transport plan, compiled for the CPU.

Both products of an iteration use four rows of the plan while these are in the cache, so the plan is read once where
torch reads it twice. Samples are divided among torch's threads, and each stops by itself.
"""

from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from bpnp.layers.plan import SHORT_SUM, Plan
from bpnp.runtime import FAST, compiler, in_threads

compiled = compiler(fastmath=FAST)
part = compiler(fastmath=FAST, part=True, forceinline=True)  # for functions called by compiled code only
SHORT_COLUMN = 256  # rows summed in the precision of the data before the sum is added in float64


def applies_to(tensor: Tensor) -> bool:
    """Return True if the compiled loops can read this tensor."""
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
    """Solve S x = rhs by preconditioned conjugate gradients, as `bpnp.layers.laplacian.conjugate_gradients` does.

    The inputs are on the CPU and may have any strides.

    Args:
        plan: P (b, m, n).
        rows: Row sums of P (b, m).
        cols: Column sums of P (b, n).
        degree: Preconditioner (b, n).
        rhs: Right-hand side (b, n).
        tolerance: Relative tolerance (b,).
        limit: Largest number of iterations.

    Returns:
        x (b, n), P x / rows (b, m), and which samples met the tolerance (b,).
    """
    inputs = plan.kernel, plan.alpha, plan.beta, rows, cols, degree, rhs, tolerance
    x, mean = rhs.new_zeros(rhs.shape), rhs.new_zeros(rows.shape)
    solved = torch.zeros(len(rhs), dtype=torch.bool, device=rhs.device)
    arrays = [value.contiguous().numpy() for value in (*inputs, x, mean, solved)]
    (_, m, n), dtype = plan.kernel.shape, arrays[0].dtype

    def work(first: int, last: int) -> None:
        vectors = *np.empty((2, m), dtype), *np.empty((7, n), dtype)
        _solve(first, last, limit, *arrays, (*vectors, np.empty(n), np.empty(4, dtype)))

    in_threads(work, len(rhs))
    return x, mean, solved


@part
def _products(kernel: Any, x: Any, before: Any, after: Any, y: Any, short: Any, total: Any, four: Any) -> None:
    """Compute y = before . (K x) and total = K^T (after . y).

    Sums of thousands of float32 terms lose the digits in which the terms of the Laplacian differ. Short sums are
    therefore made in the precision of the data and added up in float64.

    Args:
        kernel: K (m, n).
        x: Vector (n,).
        before: Factors (m,).
        after: Factors (m,).
        y: Result (m,).
        short: Scratch memory (n,).
        total: Result (n,), float64.
        four: Scratch memory (4,).
    """
    total[:] = 0
    short[:] = 0
    last = len(kernel) - 1
    for i in range(0, len(kernel), 4):
        a, b, c, d = kernel[i], kernel[min(i + 1, last)], kernel[min(i + 2, last)], kernel[min(i + 3, last)]
        sums = _dots(a, b, c, d, x)
        four[:] = 0
        for k in range(min(4, len(kernel) - i)):
            y[i + k] = before[i + k] * sums[k]
            four[k] = after[i + k] * y[i + k]
        ya, yb, yc, yd = four[0], four[1], four[2], four[3]
        for j in range(len(short)):
            short[j] += ya * a[j] + yb * b[j] + yc * c[j] + yd * d[j]
        if i % SHORT_COLUMN == SHORT_COLUMN - 4:
            _flush(short, total)
    _flush(short, total)


@part
def _dots(a: Any, b: Any, c: Any, d: Any, x: Any) -> tuple[float, float, float, float]:
    """Return the products of four rows (n,) with x (n,).

    The loop runs over slices, because numba does not vectorise a loop whose index might be negative.
    """
    sums = 0.0, 0.0, 0.0, 0.0
    for start in range(0, len(x), SHORT_SUM):
        stop = start + SHORT_SUM
        ra, rb, rc, rd, factors = a[start:stop], b[start:stop], c[start:stop], d[start:stop], x[start:stop]
        sa = sb = sc = sd = x.dtype.type(0)
        for j in range(len(factors)):
            sa += ra[j] * factors[j]
            sb += rb[j] * factors[j]
            sc += rc[j] * factors[j]
            sd += rd[j] * factors[j]
        sums = sums[0] + sa, sums[1] + sb, sums[2] + sc, sums[3] + sd
    return sums


@part
def _flush(short: Any, total: Any) -> None:
    """Add `short` (n,) to `total` (n,), and set it to zero."""
    for j in range(len(short)):
        total[j] += short[j]
        short[j] = 0


@part
def _invert(values: Any, result: Any) -> None:
    """Write 1 / values to `result`, both (n,); zero where a value is not positive."""
    for j in range(len(values)):
        result[j] = 1 / values[j] if values[j] > 0 else 0


@compiled
def _solve(
    start: int,
    stop: int,
    limit: int,
    kernel: Any,
    alpha: Any,
    beta: Any,
    rows: Any,
    cols: Any,
    degree: Any,
    rhs: Any,
    tolerance: Any,
    x: Any,
    mean: Any,
    solved: Any,
    scratch: Any,
) -> None:
    """Solve samples `start` to `stop`, writing x (b, n), mean (b, m) and solved (b,); x and mean are zero at first.

    It is written in loops, because numpy expressions of several arrays take seconds to compile.

    Args:
        start: First sample.
        stop: Sample after the last.
        limit: Largest number of iterations.
        kernel: K (b, m, n).
        alpha: Row scalings (b, m).
        beta: Column scalings (b, n).
        rows: Row sums (b, m).
        cols: Column sums (b, n).
        degree: Preconditioner (b, n).
        rhs: Right-hand side (b, n).
        tolerance: Relative tolerance (b,).
        x: Result (b, n).
        mean: Result (b, m).
        solved: Result (b,).
        scratch: Overwritten.
    """
    before, y, inverse, unit, r, p, sp, weighed, short, total, four = scratch
    for s in range(start, stop):
        _invert(degree[s], inverse)
        _invert(cols[s], unit)
        _invert(rows[s], before)
        for i in range(len(before)):
            before[i] *= alpha[s, i]
        rz = target = 0.0
        for j in range(len(r)):
            r[j] = rhs[s, j]
            p[j] = inverse[j] * r[j]
            rz += r[j] * p[j]
            target += unit[j] * r[j] * r[j] * tolerance[s] ** 2
        solved[s] = not rz > 0
        for _ in range(limit):
            if solved[s]:
                break
            for j in range(len(p)):
                weighed[j] = beta[s, j] * p[j]
            _products(kernel[s], weighed, before, alpha[s], y, short, total, four)
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
