"""Annealing of a few poses on all points: at a small scale a point sees only its neighbours, found in tiles.

An iteration costs O(m + n) times the neighbours within three scales, not O(m n). Arrays and offsets are those of
`bpnp.search.kernels.dense`.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from bpnp.search.kernels.dense import directions, move
from bpnp.search.kernels.tiles import LANES, Near, Tiles, add_moments, add_to_bearings, add_to_points, meet, sort_points
from bpnp.search.kernels.vectors import F, compiled, part, sum_of
from bpnp.search.kernels.weighted import WeightedPoints, visible_weights

SWEEPS = 2
TILES = 12  # with neighbours, of a point in the mean, before there is place for more
LEAST_SEEN = 0.25  # of all weights: if fewer points face the camera, they count as so many


class SparseScratch(NamedTuple):
    """What `descend_sparse` overwrites, for c tiles and n points: directions u (3, n), cells (n,), start (of a cell)
    and order (n,) of the points in the grid, the pairs that are near, sums and row (c, LANES), column and weight (n,),
    q (4, n), the normal equations (8, 6), the best pose of a start and its first one (4, 3)."""

    u: Any
    cells: Any
    start: Any
    order: Any
    near: Near
    sums: Any
    row: Any
    column: Any
    weight: Any
    q: Any
    system: Any
    best: Any
    first: Any


def sparse_scratch(tiles: Tiles, n: int, pairs: int = 0) -> SparseScratch:
    """pairs: of a tile and a point, at least."""
    most, c = max(pairs, n * TILES) + 1, len(tiles.f)
    cells, order, start, point = (np.empty(k, np.int32) for k in (n, n, tiles.shape.prod() + 1, most))
    near = Near(point, np.empty((most, LANES), F), np.zeros(c + 1, np.int32))
    shapes = (3, n), (c, LANES), (c, LANES), n, n, (4, n), (8, 6), (4, 3), (4, 3)
    u, *rest = (np.empty(shape, F) for shape in shapes)
    return SparseScratch(u, cells, start, order, near, *rest)


@part
def assign_sparse(
    tiles: Any, points: Any, rotation: Any, translation: Any, scale: Any, outlier: Any, scratch: Any
) -> Any:
    """Fill q by Sinkhorn with slack; return the mean log-likelihood of the bearings, the matched share, and whether
    there was place for all pairs that are near.

    W_ij = x_i K_ij y_j, x_i = a_i/(e_i + sum_j K_ij y_j), y_j = b_j/(e_j + sum_i K_ij x_i), e^2 = o sqrt(A B) times the
    odds, A and B the sums of the weights a and b: of points of weight 1 a lone pair is matched where its kernel exceeds
    e^2, where the outlier density takes over in the product form too.

    tiles, points: `Tiles` and a `WeightedPoints`, whose weights b_j under this pose are in the scratch. scale: radians.
    outlier: o of `Scene.outlier_density`.
    """
    a, odds2d, odds3d, n = tiles.a, tiles.odds, points.odds, points.p.shape[1]
    u, near, sums, row, column, weight = (
        scratch.u,
        scratch.near,
        scratch.sums,
        scratch.row,
        scratch.column,
        scratch.weight,
    )
    directions(points.p, rotation, translation, u)
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
def descend_on_points(
    tiles: Any, points: Any, rotation: Any, translation: Any, scales: Any, outlier: Any, patience: int, result: Any,
    scratch: Any,
) -> int:  # fmt: skip
    """`descend_sparse`, of as many starts as there was place for; the next one is as it was."""
    best, first = scratch.best, scratch.first
    for k in range(len(rotation)):
        copy_pose(rotation[k], translation[k], best, best[3])
        copy_pose(rotation[k], translation[k], first, first[3])
        result[k, 0], result[k, 1], result[k, 2] = -np.inf, F(0), F(0)
        since = 0
        for step in range(len(scales)):
            scale = scales[step]
            if not is_finite(rotation[k], translation[k]):
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


def descend_sparse(
    tiles: Any, points: Any, rotation: Any, translation: Any, scales: Any, outlier: Any, patience: int, result: Any,
    scratch: SparseScratch,
) -> None:  # fmt: skip
    """Anneal starts (S, 3, 3), (S, 3) in place to the one of `scales` (k,), radians, that explains the bearings best.

    A start stops `patience` scales after its likelihood was highest and returns to the pose of that scale.
    result (S, 3): likelihood, matched share and scale there; -inf, 0, 0 for a pose that is not finite. outlier: o / s^2
    of `Scene.outlier_density`. scratch: `sparse_scratch`, or a larger one where more points lie together.
    """
    tiles, points, done = Tiles(*tiles), WeightedPoints(*points), 0
    while True:
        rest = rotation[done:], translation[done:], scales, outlier, patience, result[done:], scratch
        done += int(descend_on_points(tiles, points, *rest))
        if done == len(rotation):
            return
        scratch = sparse_scratch(tiles, len(points.b), 2 * len(scratch.near.point))
