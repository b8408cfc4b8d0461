"""Annealing of a few poses on all points: at a small scale a point sees only its neighbours, found in a grid.

Bearings lie on the unit sphere, so a grid of cubes serves every field of view. An iteration costs O(m + n) times the
neighbours within three scales, not O(m n). Arrays and offsets are those of `bpnp.search.kernels.dense`.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bpnp.search.kernels.dense import F, compiled, direction, move, rotated

REACH = 3.0  # scales; the kernel is below 0.012 beyond
CAPACITY = 96  # neighbours kept of a point
SWEEPS = 4
CELLS = 64  # along the longest side of the grid


class Grid(NamedTuple):
    """Offsets of bearings (3, m), sorted by cell.

    Cell (i, j, k) holds f[:, start[c]:start[c + 1]], c = (i * shape[1] + j) * shape[2] + k.
    """

    f: NDArray[np.float32]
    start: NDArray[np.int32]
    low: NDArray[np.float32]
    cell: np.float32
    shape: NDArray[np.int32]
    order: NDArray[np.int64]  # f[:, i] is bearing order[i]


def build_grid(offsets: NDArray[np.float32], smallest: float) -> Grid:
    """A grid over offsets (m, 3) with cells of `smallest` or, where that would be too many, of 1/64 of the extent."""
    low, extent = offsets.min(0), np.ptp(offsets, axis=0)
    cell = max(smallest, float(extent.max()) / CELLS)
    shape = np.floor(extent / cell).astype(np.int64) + 1
    place = np.floor((offsets - low) / cell).astype(np.int64)
    key = (place[:, 0] * shape[1] + place[:, 1]) * shape[2] + place[:, 2]
    order = np.argsort(key, kind="stable")
    start = np.searchsorted(key[order], np.arange(shape.prod() + 1))
    return Grid(
        np.ascontiguousarray(offsets[order].T),
        start.astype(np.int32),
        low.astype(F),
        F(cell),
        shape.astype(np.int32),
        order,
    )


@compiled
def neighbours(grid: Any, x: Any, y: Any, z: Any, radius: Any, index: Any, squared: Any) -> int:
    """Bearings within `radius` of the offset (x, y, z): how many, at most as many as the arrays hold.

    index (k,), squared (k,): filled with their columns in `grid[0]` and the squared distances.
    """
    f, start, low, cell, shape = grid[0], grid[1], grid[2], grid[3], grid[4]
    count, bound = 0, radius * radius
    i0, i1 = (
        max(0, math.floor((x - radius - low[0]) / cell)),
        min(shape[0] - 1, math.floor((x + radius - low[0]) / cell)),
    )
    j0, j1 = (
        max(0, math.floor((y - radius - low[1]) / cell)),
        min(shape[1] - 1, math.floor((y + radius - low[1]) / cell)),
    )
    k0, k1 = (
        max(0, math.floor((z - radius - low[2]) / cell)),
        min(shape[2] - 1, math.floor((z + radius - low[2]) / cell)),
    )
    if k1 < k0:
        return 0
    for i in range(i0, i1 + 1):
        for j in range(j0, j1 + 1):
            row = (i * shape[1] + j) * shape[2]
            for e in range(start[row + k0], start[row + k1 + 1]):
                dx, dy, dz = f[0, e] - x, f[1, e] - y, f[2, e] - z
                distance = dx * dx + dy * dy + dz * dz
                if distance < bound and count < len(index):
                    index[count] = e
                    squared[count] = distance
                    count += 1
    return count


@compiled
def assign_sparse(grid: Any, p: Any, rotation: Any, translation: Any, scale: Any, outlier: Any, index: Any,
                  kernel: Any, count: Any, row: Any, column: Any, q: Any) -> Any:  # fmt: skip
    """Fill q by Sinkhorn with slack; return the mean log-likelihood of the bearings and the matched share.

    W_ij = a_i K_ij b_j, a_i = 1/(e + sum_j K_ij b_j), b_j = 1/(e + sum_i K_ij a_i), e^2 = o sqrt(m n): a lone pair is
    matched where its kernel exceeds e^2, where the outlier density takes over in the product form too.

    grid: the first five fields of a `Grid`; the other shapes are those of `bpnp.search.kernels.dense`. scale: radians.
    outlier: o of `Scene.outlier_density`. Scratch: index, kernel (n, CAPACITY), count, column (n,), row (m,).
    """
    f = grid[0]
    m, n = f.shape[1], p.shape[1]
    row[:] = F(0)
    sharp = F(-0.5) / (scale * scale)
    for j in range(n):
        x, y, z = rotated(rotation, p[0, j], p[1, j], p[2, j])
        x, y, z, _ = direction(x + translation[0], y + translation[1], z + translation[2])
        q[0, j], q[1, j], q[2, j] = x, y, z
        count[j] = neighbours(grid, x, y, z, F(REACH) * scale, index[j], kernel[j])
        for e in range(count[j]):
            kernel[j, e] = math.exp(sharp * kernel[j, e])
            row[index[j, e]] += kernel[j, e]
    likelihood = F(0)
    slack = math.sqrt(outlier * math.sqrt(F(m) * F(n)))
    for i in range(m):
        likelihood += math.log((row[i] / F(n) + outlier) / (scale * scale))
        row[i] = F(1) / math.sqrt(slack + row[i])
    for _ in range(SWEEPS):
        for j in range(n):
            total = F(0)
            for e in range(count[j]):
                total += kernel[j, e] * row[index[j, e]]
            column[j] = F(1) / (slack + total)
        row[:] = F(0)
        for j in range(n):
            for e in range(count[j]):
                row[index[j, e]] += kernel[j, e] * column[j]
        for i in range(m):
            row[i] = F(1) / (slack + row[i])
    matched = F(0)
    for j in range(n):
        q0, q1, q2, total = F(0), F(0), F(0), F(0)
        for e in range(count[j]):
            i = index[j, e]
            weight = kernel[j, e] * row[i] * column[j]
            total += weight
            q0 += weight * (f[0, i] - q[0, j])
            q1 += weight * (f[1, i] - q[1, j])
            q2 += weight * (f[2, i] - q[2, j])
        matched += total
        q[0, j], q[1, j], q[2, j], q[3, j] = q0, q1, q2, total
    return likelihood / F(m), matched / F(min(m, n))


@compiled
def copy_pose(rotation: Any, translation: Any, to_rotation: Any, to_translation: Any) -> None:
    """Element by element: numba compiles an assignment of arrays for 3 s, most of it the message of a wrong shape."""
    for r in range(3):
        for c in range(3):
            to_rotation[r, c] = rotation[r, c]
        to_translation[r] = translation[r]


@compiled
def descend_sparse(grid: Any, p: Any, rotation: Any, translation: Any, scales: Any, outlier: Any, patience: int,
                   result: Any) -> None:  # fmt: skip
    """Anneal starts (S, 3, 3), (S, 3) in place to the one of `scales` (k,), radians, that explains the bearings best.

    A start stops `patience` scales after its likelihood was highest and returns to the pose of that scale.
    result (S, 3): likelihood, matched share and scale there; -inf, 0, 0 for a pose that is not finite. outlier: o / s^2
    of `Scene.outlier_density`.
    """
    m, n = grid[0].shape[1], p.shape[1]
    for k in range(len(rotation)):
        index, kernel, count = np.empty((n, CAPACITY), np.int32), np.empty((n, CAPACITY), F), np.empty(n, np.int32)
        row, column, q = np.empty(m, F), np.empty(n, F), np.empty((4, n), F)
        hessian, gradient, step = np.empty((6, 6), F), np.empty(6, F), np.empty(6, F)
        best_rotation, best_translation = rotation[k].copy(), translation[k].copy()
        result[k, 0], result[k, 1], result[k, 2] = -np.inf, F(0), F(0)
        since = 0
        for scale in scales:
            if not (np.isfinite(rotation[k]).all() and np.isfinite(translation[k]).all()):
                break
            likelihood, matched = assign_sparse(
                grid, p, rotation[k], translation[k], scale, outlier * scale * scale, index, kernel, count, row,
                column, q,
            )  # fmt: skip
            since += 1
            if likelihood > result[k, 0]:
                result[k, 0], result[k, 1], result[k, 2] = likelihood, matched, scale
                copy_pose(rotation[k], translation[k], best_rotation, best_translation)
                since = 0
            if since > patience or not move(q, p, rotation[k], translation[k], F(1), hessian, gradient, step):
                break
        copy_pose(best_rotation, best_translation, rotation[k], translation[k])
