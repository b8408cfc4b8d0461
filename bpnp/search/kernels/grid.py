"""Annealing of a few poses on all points: at a small scale a point sees only its neighbours, found in a grid.

Bearings are sorted by the cells of a grid across the view; in one of more than 180 degrees a cell holds directions of
both hemispheres. An iteration costs O(m + n) times the neighbours within three scales, not O(m n). Arrays and offsets
are those of `bpnp.search.kernels.dense`.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bpnp.search.kernels.dense import move
from bpnp.search.kernels.vectors import F, compiled, direction, part, rotated, sum_of
from bpnp.search.kernels.weighted import WeightedBearings, visible_weights

REACH = 3.0  # scales; the kernel is below 0.012 beyond
CAPACITY = 96  # neighbours kept of a point
SWEEPS = 2
LEAST_SEEN = 0.25  # of all weights: if fewer points face the camera, they count as so many
CELLS = 64  # along the longer side of the grid


class Grid(NamedTuple):
    """Bearings, sorted by cell: the fields of a `WeightedBearings`, and where the cells begin.

    Cell (i, j), by x and y, holds f[:, start[c]:start[c + 1]], c = i * shape[1] + j.
    """

    f: NDArray[np.float32]
    a: NDArray[np.float32]
    odds: NDArray[np.float32]
    label: NDArray[np.int32]
    start: NDArray[np.int32]
    low: NDArray[np.float32]
    cell: np.float32
    shape: NDArray[np.int32]


def build_grid(bearings: WeightedBearings, smallest: float) -> Grid:
    """A grid over bearings with cells of `smallest` or, where that would be too many, of 1/64 of the extent."""
    offsets = bearings.f[:2].T
    low, extent = offsets.min(0), np.ptp(offsets, axis=0)
    cell = max(smallest, float(extent.max()) / CELLS)
    shape = np.floor(extent / cell).astype(np.int64) + 1
    place = np.floor((offsets - low) / cell).astype(np.int64)
    key = place @ [shape[1], 1]
    order = np.argsort(key, kind="stable")
    start = np.searchsorted(key[order], np.arange(shape.prod() + 1))
    return Grid(
        np.ascontiguousarray(bearings.f[:, order]),
        bearings.a[order],
        bearings.odds[order],
        bearings.label[order],
        start.astype(np.int32),
        low.astype(F),
        F(cell),
        shape.astype(np.int32),
    )


@part
def cells_within(x: Any, radius: Any, cell: Any, size: Any) -> tuple[int, int]:
    """First and last of `size` cells that lie within `radius` of x along an axis."""
    first, last = math.floor((x - radius) / cell), math.floor((x + radius) / cell)
    return first if first > 0 else 0, last if last < size else size - 1


@part
def neighbours(grid: Any, label: Any, x: Any, y: Any, z: Any, radius: Any, index: Any, squared: Any) -> int:
    """Bearings of a label within `radius` of the offset (x, y, z): how many, at most as many as the arrays hold.

    index (k,), squared (k,): filled with their columns in `grid[0]` and the squared distances.
    """
    f, labels, start, low, cell, shape = grid[0], grid[3], grid[4], grid[5], grid[6], grid[7]
    count, bound = 0, radius * radius
    i0, i1 = cells_within(x - low[0], radius, cell, shape[0])
    j0, j1 = cells_within(y - low[1], radius, cell, shape[1])
    if j1 < j0:
        return 0
    for i in range(i0, i1 + 1):
        for e in range(start[i * shape[1] + j0], start[i * shape[1] + j1 + 1]):
            dx, dy, dz = f[0, e] - x, f[1, e] - y, f[2, e] - z
            distance = dx * dx + dy * dy + dz * dz
            partners = label < 0 or labels[e] < 0 or labels[e] == label
            if distance < bound and partners and count < len(index):
                index[count] = e
                squared[count] = distance
                count += 1
    return count


@part
def assign_sparse(grid: Any, points: Any, weight: Any, rotation: Any, translation: Any, scale: Any, outlier: Any,
                  index: Any, kernel: Any, count: Any, row: Any, column: Any, q: Any) -> Any:  # fmt: skip
    """Fill q by Sinkhorn with slack; return the mean log-likelihood of the bearings and the matched share.

    W_ij = x_i K_ij y_j, x_i = a_i/(e_i + sum_j K_ij y_j), y_j = b_j/(e_j + sum_i K_ij x_i), e^2 = o sqrt(A B) times the
    odds, A and B the sums of the weights a and b: of points of weight 1 a lone pair is matched where its kernel exceeds
    e^2, where the outlier density takes over in the product form too.

    grid, points: a `Grid` and a `WeightedPoints` as tuples. weight (n,): b_j, of the points under this pose. scale:
    radians. outlier: o of `Scene.outlier_density`. Scratch: index, kernel (n, CAPACITY), count, column (n,), row (m,).
    """
    f, a, odds2d = grid[0], grid[1], grid[2]
    p, odds3d, labels = points[0], points[2], points[3]
    m, n = f.shape[1], p.shape[1]
    total_a, total_b = sum_of(a), sum_of(weight) + F(1e-20)
    clear(row)
    sharp = F(-0.5) / (scale * scale)
    for j in range(n):
        x, y, z = rotated(rotation, p[0, j], p[1, j], p[2, j])
        x, y, z, _ = direction(x + translation[0], y + translation[1], z + translation[2])
        q[0, j], q[1, j], q[2, j] = x, y, z
        count[j] = neighbours(grid, labels[j], x, y, z, F(REACH) * scale, index[j], kernel[j])
        for e in range(count[j]):
            kernel[j, e] = math.exp(sharp * kernel[j, e])
            row[index[j, e]] += weight[j] * kernel[j, e]
    likelihood = F(0)
    slack = math.sqrt(outlier * math.sqrt(total_a * total_b))
    for i in range(m):
        likelihood += a[i] * math.log((row[i] / total_b + outlier * odds2d[i]) / (scale * scale))
        row[i] = a[i] / math.sqrt(slack * odds2d[i] + row[i])
    for _ in range(SWEEPS):
        for j in range(n):
            mass = F(0)
            for e in range(count[j]):
                mass += kernel[j, e] * row[index[j, e]]
            column[j] = weight[j] / (slack * odds3d[j] + mass)
        clear(row)
        for j in range(n):
            for e in range(count[j]):
                row[index[j, e]] += kernel[j, e] * column[j]
        for i in range(m):
            row[i] = a[i] / (slack * odds2d[i] + row[i])
    matched = F(0)
    for j in range(n):
        q0, q1, q2, q3 = F(0), F(0), F(0), F(0)
        for e in range(count[j]):
            i = index[j, e]
            mass = kernel[j, e] * row[i] * column[j]
            q3 += mass
            q0 += mass * (f[0, i] - q[0, j])
            q1 += mass * (f[1, i] - q[1, j])
            q2 += mass * (f[2, i] - q[2, j])
        matched += q3
        q[0, j], q[1, j], q[2, j], q[3, j] = q0, q1, q2, q3
    return likelihood / total_a, matched / min(total_a, max(total_b, F(LEAST_SEEN) * sum_of(points[1])))


@part
def clear(values: Any) -> None:
    """Zero in all places of values (k,)."""
    for i in range(len(values)):
        values[i] = 0


@part
def is_finite(rotation: Any, translation: Any) -> bool:
    """Whether a pose has neither NaN nor infinity."""
    finite = True
    for r in range(3):
        for c in range(3):
            finite = finite and math.isfinite(rotation[r, c])
        finite = finite and math.isfinite(translation[r])
    return finite


@part
def copy_pose(rotation: Any, translation: Any, to_rotation: Any, to_translation: Any) -> None:
    """Element by element: numba compiles an assignment of arrays for 3 s, most of it the message of a wrong shape."""
    for r in range(3):
        for c in range(3):
            to_rotation[r, c] = rotation[r, c]
        to_translation[r] = translation[r]


@compiled
def descend_sparse(grid: Any, points: Any, rotation: Any, translation: Any, scales: Any, outlier: Any, patience: int,
                   result: Any, scratch: Any) -> None:  # fmt: skip
    """Anneal starts (S, 3, 3), (S, 3) in place to the one of `scales` (k,), radians, that explains the bearings best.

    A start stops `patience` scales after its likelihood was highest and returns to the pose of that scale.
    result (S, 3): likelihood, matched share and scale there; -inf, 0, 0 for a pose that is not finite. outlier: o / s^2
    of `Scene.outlier_density`. scratch: `sparse_scratch`.
    """
    p = points[0]
    index, kernel, count, row, column, q, weight, system, best_rotation, best_translation = scratch
    for k in range(len(rotation)):
        copy_pose(rotation[k], translation[k], best_rotation, best_translation)
        result[k, 0], result[k, 1], result[k, 2] = -np.inf, F(0), F(0)
        since = 0
        for step in range(len(scales)):
            scale = scales[step]
            if not is_finite(rotation[k], translation[k]):
                break
            visible_weights(points, rotation[k], translation[k], weight)
            likelihood, matched = assign_sparse(
                grid, points, weight, rotation[k], translation[k], scale, outlier * scale * scale, index, kernel,
                count, row, column, q,
            )  # fmt: skip
            since += 1
            if likelihood > result[k, 0]:
                result[k, 0], result[k, 1], result[k, 2] = likelihood, matched, scale
                copy_pose(rotation[k], translation[k], best_rotation, best_translation)
                since = 0
            if since > patience or not move(q, p, rotation[k], translation[k], F(1), system):
                break
        copy_pose(best_rotation, best_translation, rotation[k], translation[k])


def sparse_scratch(m: int, n: int) -> tuple[NDArray[Any], ...]:
    """What `descend_sparse` overwrites, for m bearings and n points."""
    index, count = np.empty((n, CAPACITY), np.int32), np.empty(n, np.int32)
    kernel, row, *rest = (np.empty(shape, F) for shape in ((n, CAPACITY), m, n, (4, n), n, (8, 6), (3, 3), 3))
    return index, kernel, count, row, *rest
