"""Annealing of a few poses on all points: at a small scale a point sees only its neighbours, found in tiles.

An iteration costs O(m + n) times the neighbours within three scales, not O(m n). Arrays and offsets are those of
`bpnp.search.kernels.dense`.
"""

import math
from typing import Any

import numpy as np

from bpnp.search.kernels.dense import directions, move
from bpnp.search.kernels.tiles import (
    LANES,
    MOST_TILES,
    Tiles,
    add_moments,
    add_to_bearings,
    add_to_points,
    meet,
    sort_points,
)
from bpnp.search.kernels.vectors import F, compiled, part, sum_of
from bpnp.search.kernels.weighted import visible_weights

SWEEPS = 2
LEAST_SEEN = 0.25  # of all weights: if fewer points face the camera, they count as so many


@part
def assign_sparse(tiles: Any, points: Any, weight: Any, rotation: Any, translation: Any, scale: Any, outlier: Any,
                  u: Any, pairs: Any, sums: Any, row: Any, column: Any, q: Any) -> Any:  # fmt: skip
    """Fill q by Sinkhorn with slack; return the mean log-likelihood of the bearings and the matched share.

    W_ij = x_i K_ij y_j, x_i = a_i/(e_i + sum_j K_ij y_j), y_j = b_j/(e_j + sum_i K_ij x_i), e^2 = o sqrt(A B) times the
    odds, A and B the sums of the weights a and b: of points of weight 1 a lone pair is matched where its kernel exceeds
    e^2, where the outlier density takes over in the product form too.

    tiles, points: `Tiles` and a `WeightedPoints` as tuples. weight (n,): b_j, of the points under this pose. scale:
    radians. outlier: o of `Scene.outlier_density`. Scratch: u (3, n), pairs (`sparse_scratch`), sums, row (c, LANES),
    column (n,).
    """
    f, a, odds2d = tiles[0], tiles[1], tiles[2]
    p, odds3d, labels = points[0], points[2], points[3]
    n = p.shape[1]
    cells, start, order, met, point, kernel, end = pairs
    directions(p, rotation, translation, u)
    sort_points(tiles, u, cells, start, order)
    meet(tiles, labels, u, scale, start, order, met, point, kernel, end)
    add_to_bearings(weight, point, kernel, end, sums)
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
        add_to_points(row, point, kernel, end, column)
        for j in range(n):
            column[j] = weight[j] / (slack * odds3d[j] + column[j])
        add_to_bearings(column, point, kernel, end, sums)
        for t in range(len(a)):
            for k in range(LANES):
                row[t, k] = a[t, k] / (slack * odds2d[t, k] + sums[t, k])
    add_moments(f, u, row, column, point, kernel, end, q)
    matched = sum_of(q[3])
    return likelihood / total_a, matched / min(total_a, max(total_b, F(LEAST_SEEN) * sum_of(points[1])))


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
def descend_sparse(tiles: Any, points: Any, rotation: Any, translation: Any, scales: Any, outlier: Any, patience: int,
                   result: Any, scratch: Any) -> None:  # fmt: skip
    """Anneal starts (S, 3, 3), (S, 3) in place to the one of `scales` (k,), radians, that explains the bearings best.

    A start stops `patience` scales after its likelihood was highest and returns to the pose of that scale.
    result (S, 3): likelihood, matched share and scale there; -inf, 0, 0 for a pose that is not finite. outlier: o / s^2
    of `Scene.outlier_density`. scratch: `sparse_scratch`.
    """
    p = points[0]
    u, pairs, sums, row, column, q, weight, system, best_rotation, best_translation = scratch
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
                tiles, points, weight, rotation[k], translation[k], scale, outlier * scale * scale, u, pairs, sums,
                row, column, q,
            )  # fmt: skip
            since += 1
            if likelihood > result[k, 0]:
                result[k, 0], result[k, 1], result[k, 2] = likelihood, matched, scale
                copy_pose(rotation[k], translation[k], best_rotation, best_translation)
                since = 0
            if since > patience or not move(q, p, rotation[k], translation[k], F(1), system):
                break
        copy_pose(best_rotation, best_translation, rotation[k], translation[k])


def sparse_scratch(tiles: Tiles, n: int) -> tuple[Any, ...]:
    """What `descend_sparse` overwrites, for n points."""
    most, k = n * MOST_TILES + 1, len(tiles.f)
    cells, order, met, point = (np.empty(size, np.int32) for size in (n, n, n, most))
    start, end = np.empty(tiles.shape.prod() + 1, np.int32), np.zeros(k + 1, np.int32)
    u, kernel, *rest = (
        np.empty(shape, F) for shape in ((3, n), (most, LANES), (k, LANES), (k, LANES), n, (4, n), n, (8, 6), (3, 3), 3)
    )
    return u, (cells, start, order, met, point, kernel, end), *rest
