"""Annealing of a few poses on all points: at a small scale only neighbours interact, and tiles find them.

An iteration costs O(m + n) times the neighbours within three scales, not O(m n). Bearings are sorted into tiles of 16
that lie near each other, points under a pose into the cells of a grid across the view. A tile is paired with the points
of the cells around it. In a view of more than 180 degrees a cell holds directions of both hemispheres. Arrays and
offsets are those of `bpnp.search.kernels.dense`. The loops over the bearings of a tile have a constant length, so that
compilers use the widest vector instructions.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bpnp.arrays import Array32
from bpnp.search.kernels.dense import move, see
from bpnp.search.kernels.sides import WeightedBearings, WeightedPoints, visible_weights
from bpnp.search.kernels.vectors import F, compiled, copy_pose, part, sum_of

SWEEPS = 2  # alternating normalisations of the assignment on all points, of rows and columns [sweeps; not tuned]
FIRST_TILES = 12  # mean number of tiles near a point in the first buffer; a larger one is made if needed [tiles; cost]
LEAST_SEEN = 0.25  # least weight of the points that face the camera, a fraction of all weights [fraction; not tuned]
KERNEL_REACH = 3.0  # distance beyond which the kernel on all points, below 0.012, is 0 [scales of the annealing; cost]
LANES = 16  # bearings of a tile [bearings; cost]
SCENE_CELLS = 64  # cells along the longer side of the grid of scene points [cells; cost]


class Tiles(NamedTuple):
    """Bearings in c tiles of `LANES`, and a grid across the view.

    Cell (i, j) of the grid is number 1 + i * shape[1] + j; number 0 is outside.
    """

    f: Array32  # (c, 3, lanes) offsets
    a: Array32  # (c, lanes) weights; the last tile is filled up with bearings of weight 0
    odds: Array32  # (c, lanes), as in `WeightedBearings`
    label: NDArray[np.int32]  # (c, lanes), as in `WeightedBearings`
    box: Array32  # (c, 4) least x and y of a tile, and largest
    low: Array32  # (2,) corner of the grid
    cell: np.float32  # width of a cell
    shape: NDArray[np.int32]  # (2,) cells along x and y

    def with_margin(self, scale: float) -> "Tiles":
        """Return the tiles with a grid that covers the bearings and the reach of a kernel of this scale, radians."""
        margin = F(KERNEL_REACH * scale)
        low, high = self.box[:, :2].min(0) - margin, self.box[:, 2:].max(0) + margin
        cell = F((high - low).max() / SCENE_CELLS)
        return self._replace(low=low, cell=cell, shape=np.floor((high - low) / cell).astype(np.int32) + 1)


class Near(NamedTuple):
    """Pairs e of a tile and a point near it, in the order of the tiles: those of tile t from end[t] to end[t + 1]."""

    point: NDArray[np.int32]  # (e,) indices of points
    kernel: Array32  # (e, lanes) kernel of the tile's bearings and this point
    end: NDArray[np.int32]  # (c + 1,)


def build_tiles(bearings: WeightedBearings) -> Tiles:
    """Cut bearings into tiles, from stripes across x that are sorted by y; the grid is set by `with_margin`."""
    x, y = bearings.f[:2]
    m = len(x)
    stripe = np.empty(m, np.int64)
    stripe[np.argsort(x, kind="stable")] = np.arange(m) // (LANES * math.ceil(math.sqrt(m / LANES)))
    order = np.lexsort((y, stripe))
    order = np.append(order, np.repeat(order[-1:], -m % LANES))
    a, odds = (values[order].reshape(-1, LANES) for values in (bearings.a, bearings.odds))
    a.flat[m:] = 0
    f = np.ascontiguousarray(bearings.f[:, order].reshape(3, -1, LANES).transpose(1, 0, 2))
    box = np.concatenate([f[:, :2].min(2), f[:, :2].max(2)], 1)
    label = bearings.label[order].reshape(-1, LANES)
    return Tiles(f, a, odds, label, box, box[0, :2], F(1), np.ones(2, np.int32))


@part
def sort_points(tiles: Tiles, u: Any, cells: Any, start: Any, order: Any) -> None:
    """Fill order (n,) with the points, seen in directions u (3, n), by their cells; those of cell c end at start[c]."""
    low, shape = tiles.low, tiles.shape
    inverse = F(1) / tiles.cell
    for c in range(len(start)):
        start[c] = 0
    for j in range(len(cells)):
        x, y = (u[0, j] - low[0]) * inverse, (u[1, j] - low[1]) * inverse
        inside = (x >= 0) & (y >= 0) & (x < shape[0]) & (y < shape[1])
        cells[j] = 1 + int(x) * shape[1] + int(y) if inside else 0
    for j in range(len(cells)):
        start[cells[j]] += 1
    total = 0
    for c in range(len(start)):
        count = start[c]
        start[c] = total
        total += count
    for j in range(len(cells)):
        order[start[cells[j]]] = j
        start[cells[j]] += 1


@part
def cells_between(first: Any, last: Any, low: Any, cell: Any, size: Any) -> tuple[int, int]:
    """Return the first and last of `size` cells along an axis that overlap an interval."""
    i, j = math.floor((first - low) / cell), math.floor((last - low) / cell)
    return i if i > 0 else 0, j if j < size else size - 1


@part
def meet(tiles: Tiles, labels: Any, u: Any, scale: Any, start: Any, order: Any, near: Near) -> bool:
    """Fill `near` with the pairs of a tile and a point within reach, and their kernels; False if it is too small.

    The kernel is (1 + y + y^2/2 + y^3/6)^64, y = -|f - u|^2 / 128 s^2, within 1e-4 of exp(64 y), and 0 beyond
    `KERNEL_REACH`. It is also 0 for labels that do not fit. u (3, n) are the offsets of the points' directions, s the
    scale in radians; `start` and `order` are those of `sort_points`.
    """
    f, label, box, low, cell, shape = tiles.f, tiles.label, tiles.box, tiles.low, tiles.cell, tiles.shape
    point, kernel, end = near
    radius = F(KERNEL_REACH) * scale
    bound, sharp = radius * radius, F(-1 / 128) / (scale * scale)
    place = end[0]
    for t in range(len(f)):
        i0, i1 = cells_between(box[t, 0] - radius, box[t, 2] + radius, low[0], cell, shape[0])
        j0, j1 = cells_between(box[t, 1] - radius, box[t, 3] + radius, low[1], cell, shape[1])
        for i in range(i0, i1 + 1):
            for e in range(start[i * shape[1] + j0], start[1 + i * shape[1] + j1]):
                if place + 1 >= len(point):
                    return False
                j = order[e]
                x, y, z, wanted, total = u[0, j], u[1, j], u[2, j], labels[j], F(0)
                for k in range(LANES):
                    dx, dy, dz = f[t, 0, k] - x, f[t, 1, k] - y, f[t, 2, k] - z
                    squared = dx * dx + dy * dy + dz * dz
                    partners = (wanted < 0) | (label[t, k] < 0) | (label[t, k] == wanted)
                    v = sharp * min(squared, bound)
                    v = F(1) + v * (F(1) + v * (F(0.5) + v * F(1 / 6)))
                    v = v * v
                    v = v * v
                    v = v * v
                    v = v * v
                    v = v * v
                    v = v * v if (squared < bound) & partners else F(0)
                    kernel[place, k] = v
                    total += v
                # Without a branch: the next pair overwrites one whose kernel is 0.
                point[place] = j
                place += total > 0
        end[t + 1] = place
    return True


@part
def add_to_bearings(values: Any, near: Near, sums: Any) -> None:
    """Fill sums (c, lanes) with sum_j K_ij values_j."""
    point, kernel, end = near
    for t in range(len(sums)):
        for k in range(LANES):
            sums[t, k] = 0
        for e in range(end[t], end[t + 1]):
            value = values[point[e]]
            for k in range(LANES):
                sums[t, k] += kernel[e, k] * value


@part
def add_to_points(values: Any, near: Near, sums: Any) -> None:
    """Fill sums (n,) with sum_i K_ij values_i, of values (c, lanes)."""
    point, kernel, end = near
    for j in range(len(sums)):
        sums[j] = 0
    for t in range(len(values)):
        for e in range(end[t], end[t + 1]):
            total = F(0)
            for k in range(LANES):
                total += kernel[e, k] * values[t, k]
            sums[point[e]] += total


@part
def add_moments(f: Any, u: Any, row: Any, column: Any, near: Near, q: Any) -> None:
    """Fill q (4, n) with sum_i W_ij (f_i - u_j) and sum_i W_ij, W_ij = row_i K_ij column_j."""
    point, kernel, end = near
    for j in range(len(column)):
        q[0, j], q[1, j], q[2, j], q[3, j] = F(0), F(0), F(0), F(0)
    for t in range(len(f)):
        for e in range(end[t], end[t + 1]):
            j = point[e]
            x, y, z = u[0, j], u[1, j], u[2, j]
            q0, q1, q2, q3 = F(0), F(0), F(0), F(0)
            for k in range(LANES):
                mass = kernel[e, k] * row[t, k]
                q0 += mass * (f[t, 0, k] - x)
                q1 += mass * (f[t, 1, k] - y)
                q2 += mass * (f[t, 2, k] - z)
                q3 += mass
            b = column[j]
            q[0, j] += b * q0
            q[1, j] += b * q1
            q[2, j] += b * q2
            q[3, j] += b * q3


class SparseScratch(NamedTuple):
    """Buffers of `descend_sparse`, for c tiles and n points."""

    u: Any  # (3, n) directions of the points
    cells: Any  # (n,) their cells
    start: Any  # end of each cell in the order, which is the start of the next
    order: Any  # (n,) points by their cells
    near: Near
    sums: Any  # (c, lanes)
    row: Any  # (c, lanes)
    column: Any  # (n,)
    weight: Any  # (n,)
    q: Any  # (4, n)
    system: Any  # (8, 6) normal equations
    best: Any  # (4, 3) best pose of an annealing
    first: Any  # (4, 3) its initial pose


def sparse_scratch(tiles: Tiles, n: int, pairs: int = 0) -> SparseScratch:
    """Allocate the buffers of `descend_sparse`, for n points and at least `pairs` pairs of a tile and a point."""
    most, c = max(pairs, n * FIRST_TILES) + 1, len(tiles.f)
    cells, order, start, point = (np.empty(k, np.int32) for k in (n, n, tiles.shape.prod() + 1, most))
    near = Near(point, np.empty((most, LANES), F), np.zeros(c + 1, np.int32))
    shapes = (3, n), (c, LANES), (c, LANES), n, n, (4, n), (8, 6), (4, 3), (4, 3)
    u, *rest = (np.empty(shape, F) for shape in shapes)
    return SparseScratch(u, cells, start, order, near, *rest)


@part
def assign_sparse(
    tiles: Tiles,
    points: WeightedPoints,
    rotation: Any,
    translation: Any,
    scale: Any,
    outlier: Any,
    scratch: "SparseScratch",
) -> Any:
    """Fill q by Sinkhorn iterations with slack at a scale in radians.

    W_ij = x_i K_ij y_j, x_i = a_i/(e_i + sum_j K_ij y_j), y_j = b_j/(e_j + sum_i K_ij x_i), e^2 = o sqrt(A B) times the
    odds, A and B the sums of the weights a and b. Among points of weight 1 a lone pair is matched where its kernel
    exceeds e^2. The outlier density dominates below that in the product form too. The weights b_j under this pose are
    in the scratch; `outlier` is o of `SearchFrame.outlier_density`. Return the mean log-likelihood of the bearings, the
    matched fraction, and False if the scratch is too small for all pairs.
    """
    a, odds2d, odds3d, n = tiles.a, tiles.odds, points.odds, points.p.shape[1]
    u, near, sums = scratch.u, scratch.near, scratch.sums
    row, column, weight = scratch.row, scratch.column, scratch.weight
    see(points.p, rotation, translation, u)
    sort_points(tiles, u, scratch.cells, scratch.start, scratch.order)
    if not meet(tiles, points.label, u, scale, scratch.start, scratch.order, near):
        return F(0), F(0), False
    add_to_bearings(weight, near, sums)
    total_a, total_b, likelihood = F(0), sum_of(weight) + F(1e-20), F(0)
    for t in range(len(a)):
        for k in range(LANES):
            total_a += a[t, k]
    slack = math.sqrt(outlier * math.sqrt(total_a * total_b))
    for t in range(len(a)):
        for k in range(LANES):
            density = (sums[t, k] / total_b + outlier * odds2d[t, k]) / (scale * scale)
            likelihood += a[t, k] * math.log(density)
            row[t, k] = a[t, k] / math.sqrt(slack * odds2d[t, k] + sums[t, k])
    for _ in range(SWEEPS):
        add_to_points(row, near, column)
        for j in range(n):
            column[j] = weight[j] / (slack * odds3d[j] + column[j])
        add_to_bearings(column, near, sums)
        for t in range(len(a)):
            for k in range(LANES):
                row[t, k] = a[t, k] / (slack * odds2d[t, k] + sums[t, k])
    add_moments(tiles.f, u, row, column, near, scratch.q)
    most = min(total_a, max(total_b, F(LEAST_SEEN) * sum_of(points.b)))
    return likelihood / total_a, sum_of(scratch.q[3]) / most, True


@compiled
def descend_sparse(
    tiles: Tiles,
    points: WeightedPoints,
    rotation: Any,
    translation: Any,
    scales: Any,
    outlier: Any,
    patience: int,
    result: Any,
    scratch: "SparseScratch",
) -> int:
    """Anneal poses (S, 3, 3), (S, 3) in place to the scale that explains the bearings best.

    An annealing stops `patience` scales after its likelihood was highest and returns to the pose of that scale. The
    scales (k,) are in radians; `outlier` is o / s^2 of `SearchFrame.outlier_density`. The result (S, 3) is likelihood,
    matched fraction and scale; -inf, 0, 0 for a pose that is not finite. Return the number of poses annealed: if it is
    less than S, the scratch was too small for the next pose, left unchanged.
    """
    best, first = scratch.best, scratch.first
    for k in range(len(rotation)):
        copy_pose(rotation[k], translation[k], best, best[3])
        copy_pose(rotation[k], translation[k], first, first[3])
        result[k, 0], result[k, 1], result[k, 2] = -np.inf, F(0), F(0)
        since = 0
        for step in range(len(scales)):
            scale, total = scales[step], F(0)
            for r in range(3):
                total += rotation[k, r, 0] + rotation[k, r, 1] + rotation[k, r, 2] + translation[k, r]
            if not math.isfinite(total):
                break
            visible_weights(points, rotation[k], translation[k], scratch.weight)
            likelihood, matched, enough = assign_sparse(
                tiles, points, rotation[k], translation[k], scale, outlier * scale * scale, scratch
            )
            if not enough:
                copy_pose(first, first[3], rotation[k], translation[k])
                return k
            since += 1
            if likelihood > result[k, 0]:
                result[k, 0], result[k, 1], result[k, 2] = likelihood, matched, scale
                copy_pose(rotation[k], translation[k], best, best[3])
                since = 0
            if since > patience or not move(scratch.q, points.p, rotation[k], translation[k], F(1), scratch.system):
                break
        copy_pose(best, best[3], rotation[k], translation[k])
    return len(rotation)
