"""Both sides of a problem with the annotations of their points: clusters, and the arrays of the compiled loops.

m bearings f_i have the weights a_i, n points p_j the weights b_j. A weight is the number of given points that it stands
for, times the probability that such a point has a correspondence. Under a pose a point counts b_j v_j, with its
visibility

    v_j = min(max(1/2 + (n_j . c_j - k_j) / 2 h, l), 1),

n_j its normal, c_j the unit vector from it to the camera's centre, k_j the cosine at which it is half visible, h the
softness and l the least weight of a point that should not be seen.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bpnp.arrays import Array32
from bpnp.search.kernels.vectors import F, part

# Difference of the cosine between the edge of the viewing cone and full or least visibility. Poses during the annealing
# are some degrees off, and so are normals.
SOFTNESS = 0.2  # [1; calibration]
UNSEEN_WEIGHT = 0.02  # least weight of a point, for a point outside its viewing cone [weight; calibration]
# Distance, in extents of the scene, that clustering treats like one radian between normals.
NORMAL_EXTENT = 0.5  # [extents of the scene; calibration]
CLUSTERED_POINTS = 8  # number of points per cluster from which the cluster centres are computed [points; cost]
LLOYD_ITERATIONS = 5  # number of iterations of the clustering [iterations; cost]

FORWARD = np.array([0.0, 0.0, 1.0])


class WeightedBearings(NamedTuple):
    """Bearings with weights."""

    f: Array32  # (3, m) offsets (`kernels.dense`)
    a: Array32  # (m,) weights
    odds: Array32  # (m,) fraction of the points with a fitting label; it multiplies the density of outliers
    label: NDArray[np.int32]  # (m,); -1 fits any label


class WeightedPoints(NamedTuple):
    """Scene points with weights."""

    p: Array32  # (3, n)
    b: Array32  # (n,) weights
    odds: Array32  # (n,) fraction of the bearings with a fitting label
    label: NDArray[np.int32]  # (n,); -1 fits any label
    # (k, 4) of clusters in the order of their labels. The bearings from blocks[:, 0] to [:, 1] fit the points from
    # [:, 2] to [:, 3].
    blocks: NDArray[np.uintp]
    # (6, n) coefficients of the visibility, (6, 0) if all points are seen from everywhere:
    # v_j = min(max((cones[:3, j] . C + cones[3, j]) / |C - p_j| + cones[4, j], cones[5, j]), 1), C the camera's centre.
    cones: Array32


@part
def visible_weights(points: WeightedPoints, rotation: Any, translation: Any, weight: Any) -> None:
    """Fill weight (n,) with b_j v_j of points, a `WeightedPoints`, under a pose (3, 3), (3,)."""
    p, b, cones = points.p, points.b, points.cones
    if cones.shape[1] == 0:
        for j in range(len(b)):
            weight[j] = b[j]
        return
    x = -(rotation[0, 0] * translation[0] + rotation[1, 0] * translation[1] + rotation[2, 0] * translation[2])
    y = -(rotation[0, 1] * translation[0] + rotation[1, 1] * translation[1] + rotation[2, 1] * translation[2])
    z = -(rotation[0, 2] * translation[0] + rotation[1, 2] * translation[1] + rotation[2, 2] * translation[2])
    for j in range(len(b)):
        dx, dy, dz = x - p[0, j], y - p[1, j], z - p[2, j]
        inverse = F(1) / math.sqrt(dx * dx + dy * dy + dz * dz + F(1e-12))
        facing = (cones[0, j] * x + cones[1, j] * y + cones[2, j] * z + cones[3, j]) * inverse + cones[4, j]
        weight[j] = b[j] * min(max(facing, cones[5, j]), F(1))


class Side(NamedTuple):
    """One side of a problem in random order."""

    points: Array32  # (k, 3) offsets of bearings, or points
    weights: Array32  # (k,) probability of a correspondence; 1 without annotations
    labels: NDArray[np.int32]  # (k,); -1 fits any label
    # (k, 4) unit normals and the cosine at which a point is half visible. (k, 0) for bearings, and for points that are
    # seen from everywhere.
    cones: Array32

    def at(self, chosen: slice | NDArray[np.int64]) -> "Side":
        """Return a subset of the points."""
        return Side(self.points[chosen], self.weights[chosen], self.labels[chosen], self.cones[chosen])

    def clustered(self, count: int, rng: np.random.Generator) -> "Side":
        """Return about `count` clusters in the order of their labels, each of points of one label; the weights add up.

        Points with normals are only close if the normals are too: half an extent counts as much as half a radian.
        """
        parts = [self.at(slice(0))]  # an empty side, in case all clusters are dropped for a weight of 0
        for label in np.unique(self.labels):
            members = np.flatnonzero(self.labels == label)
            share = count if len(members) == len(self.labels) else -(-count * len(members) // len(self.labels))
            parts.append(_clusters(self.at(members), share, rng))
        return Side(*(np.concatenate(values) for values in zip(*parts, strict=True)))


def side_of(points: Array32, scores: Any, labels: Any, cones: Any, order: NDArray[np.int64]) -> Side:
    """Return a side of points (k, 3) that are in the given order (k,) of the user's indices already.

    The annotations are in the user's order: None for scores of 1, no labels, no cones.
    """
    k = len(points)
    return Side(
        points,
        np.ones(k, np.float32) if scores is None else np.asarray(scores[order], np.float32),
        np.full(k, -1, np.int32) if labels is None else np.asarray(labels[order], np.int32),
        np.empty((k, 0), np.float32) if cones is None else np.asarray(cones[order], np.float32),
    )


def with_partners(side: Side, other: Side) -> Side:
    """Return the side with weight 0 for each point whose label fits no point of the other side."""
    return side._replace(weights=np.where(fit_any(side.labels, other.labels), side.weights, np.float32(0)))


def fit_any(labels: NDArray[Any], others: NDArray[Any]) -> NDArray[np.bool_]:
    """Return which labels (k,) fit one of the others; -1 fits any.

    >>> fit_any(np.array([0, 1, -1]), np.array([1, 2])).tolist()
    [False, True, True]
    """
    return np.asarray((labels < 0) | np.isin(labels, others) | (others < 0).any())


def _clusters(side: Side, count: int, rng: np.random.Generator) -> Side:
    """Return at most `count` clusters of points of one label."""
    side = side.at(np.flatnonzero(side.weights > 0))  # a sample of the others may contain none of these
    k = len(side.points)
    if k <= count:
        return side
    size = min(k, CLUSTERED_POINTS * count)
    chosen = slice(None) if size == k else rng.choice(k, size, replace=False)
    sample = np.concatenate([side.points, NORMAL_EXTENT * side.cones], 1)[chosen]
    first = sample[rng.choice(size, count, replace=False)]
    centres, weights = lloyd(sample, first, LLOYD_ITERATIONS, side.weights[chosen])
    centres, weights = centres[weights > 0], weights[weights > 0]
    return Side(
        np.ascontiguousarray(centres[:, :3]),
        weights.astype(np.float32) * np.float32(k / size),
        np.full(len(centres), side.labels[0], np.int32),
        centres[:, 3:] / np.float32(NORMAL_EXTENT),
    )


def lloyd(points: Array32, centres: Array32, iterations: int, weights: Array32) -> tuple[Array32, NDArray[np.float64]]:
    """Run k-means (Lloyd) from initial centres (k, d); return the centres, and the weights (k,) of the points of each.

    A centre without points keeps its last value.
    """
    extended = np.column_stack([points, np.ones(len(points), points.dtype)])
    for i in range(iterations + 1):
        # |x - c|^2 without |x|^2: one product of matrices
        nearest = (extended @ np.column_stack([-2 * centres, (centres * centres).sum(1)]).T).argmin(1)
        members = np.bincount(nearest, weights, len(centres)).astype(np.float64)
        if i == iterations:
            break
        sums = np.stack([np.bincount(nearest, weights * axis, len(centres)) for axis in points.T], -1)
        mean = sums / np.maximum(members, 1e-12)[:, None]
        centres = np.where(members[:, None] > 0, mean, centres).astype(np.float32)
    return centres, members


def kernel_sides(bearings: Side, points: Side) -> tuple[WeightedBearings, WeightedPoints]:
    """Convert both sides to the arrays of the compiled loops; the blocks are empty (`blocks_of`)."""
    return (
        WeightedBearings(
            np.ascontiguousarray(bearings.points.T), bearings.weights, _fitting(bearings, points), bearings.labels
        ),
        WeightedPoints(
            np.ascontiguousarray(points.points.T),
            points.weights,
            _fitting(points, bearings),
            points.labels,
            np.empty((0, 4), np.uintp),
            _cones(points),
        ),
    )


def blocks_of(labels2d: NDArray[np.int32], labels3d: NDArray[np.int32]) -> NDArray[np.uintp]:
    """Return the blocks (k, 4) of `WeightedPoints` for labels in ascending order."""
    blocks, free = [], int(np.searchsorted(labels2d, 0))
    for label in np.unique(labels3d):
        own = np.searchsorted(labels3d, (label, label + 1))
        if label < 0:
            blocks.append((0, len(labels2d), *own))
        else:
            blocks += [(0, free, *own), (*np.searchsorted(labels2d, (label, label + 1)), *own)]
    return np.array(blocks, np.uintp).reshape(-1, 4)


def _fitting(side: Side, other: Side) -> Array32:
    """Return the fraction of the other side, by weight, with a fitting label; at least 1e-6, and 1 if it is empty."""
    if (side.labels < 0).all() or not len(other.labels):
        return np.ones(len(side.labels), np.float32)
    values, place = np.unique(other.labels, return_inverse=True)
    weights, free = np.bincount(place, other.weights), other.weights[other.labels < 0].sum()
    at = np.minimum(np.searchsorted(values, side.labels), len(values) - 1)
    fitting = np.where(values[at] == side.labels, weights[at], 0.0) + free
    total = max(float(weights.sum()), 1e-12)
    return np.maximum(np.where(side.labels < 0, total, fitting) / total, 1e-6).astype(np.float32)


def _cones(points: Side) -> Array32:
    """Return the coefficients (6, n) of the visibility of `WeightedPoints`."""
    if not points.cones.shape[1]:
        return np.empty((6, 0), np.float32)
    normals, cosine, slope = points.cones[:, :3], points.cones[:, 3], 1 / (2 * SOFTNESS)
    towards = -slope * (normals * points.points).sum(1)
    rest = 0.5 - slope * cosine, np.full(len(cosine), UNSEEN_WEIGHT)
    return np.ascontiguousarray(np.stack([*(slope * normals).T, towards, *rest]), np.float32)
