"""The two sides of a problem with what is known of single points: their clusters, and as the compiled loops read them.

m bearings f_i have the weights a_i, n points p_j the weights b_j: how many of the given points they stand for, times
the probability that such a point has a partner. Under a pose a point counts b_j v_j, with its visibility

    v_j = min(max(1/2 + (n_j . c_j - k_j) / 2 h, l), 1),

n_j its normal, c_j the unit vector from it to the camera's centre, k_j the cosine at which it is half visible, h the
softness and l the least weight of a point that should not be seen (`settings.Facing`).
"""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bpnp.loops.vectors import F, part
from bpnp.search.settings import Facing, SearchSettings

Array = NDArray[np.float32]
FORWARD = np.array([0.0, 0.0, 1.0])


class WeightedBearings(NamedTuple):
    """f: (3, m) offsets (`kernels.dense`). a: (m,) weights. odds: (m,) share of the points that can be its partner, by
    which the density of outliers is multiplied. label: (m,), -1 fits any."""

    f: Array
    a: Array
    odds: Array
    label: NDArray[np.int32]


class WeightedPoints(NamedTuple):
    """p: (3, n). b: (n,) weights. odds: (n,) share of the bearings that can be its partner. label: (n,), -1 fits any.

    blocks: (k, 4) of clusters, which are in the order of their labels: the bearings from blocks[:, 0] to [:, 1] fit the
    points from [:, 2] to [:, 3].
    cones: (6, n), v_j = min(max((cones[:3, j] . C + cones[3, j]) / |C - p_j| + cones[4, j], cones[5, j]), 1), C the
    camera's centre; (6, 0) if all points are seen from everywhere.
    """

    p: Array
    b: Array
    odds: Array
    label: NDArray[np.int32]
    blocks: NDArray[np.uintp]
    cones: Array


@part
def visible_weights(points: Any, rotation: Any, translation: Any, weight: Any) -> None:
    """weight (n,): b_j v_j of points, a `WeightedPoints`, under a pose (3, 3), (3,)."""
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
    """One side of a problem in random order.

    points: (k, 3) offsets of bearings, or points. weights: (k,) probability of a partner, 1 where nothing is known.
    labels: (k,), -1 fits any. cones: (k, 4) unit normals and the cosine at which a point is half visible; (k, 0)
    for bearings, and for points that are seen from everywhere.
    """

    points: Array
    weights: Array
    labels: NDArray[np.int32]
    cones: Array

    def at(self, chosen: slice | NDArray[np.int64]) -> "Side":
        """Some of the points."""
        return Side(self.points[chosen], self.weights[chosen], self.labels[chosen], self.cones[chosen])

    def clustered(self, count: int, settings: SearchSettings, rng: np.random.Generator) -> "Side":
        """About `count` clusters in the order of their labels, each of points of one label; the weights add up.

        Points with normals are near each other if these are too: half an extent counts as much as half a radian.
        """
        parts = [self.at(slice(0))]  # in case no point has a partner: their clusters are dropped
        for label in np.unique(self.labels):
            members = np.flatnonzero(self.labels == label)
            share = count if len(members) == len(self.labels) else -(-count * len(members) // len(self.labels))
            parts.append(_clusters(self.at(members), share, settings, rng))
        return Side(*(np.concatenate(values) for values in zip(*parts, strict=True)))


def side_of(points: Array, scores: Any, labels: Any, cones: Any, order: NDArray[np.int64]) -> Side:
    """A side from points in this order already, and annotations in the user's, None for those that are missing."""
    k = len(points)
    return Side(
        points,
        np.ones(k, np.float32) if scores is None else np.asarray(scores[order], np.float32),
        np.full(k, -1, np.int32) if labels is None else np.asarray(labels[order], np.int32),
        np.empty((k, 0), np.float32) if cones is None else np.asarray(cones[order], np.float32),
    )


def with_partners(side: Side, other: Side) -> Side:
    """The side with the weight 0 for each point whose label none of the other side fits."""
    fitting = np.unique(other.labels)
    possible = np.isin(side.labels, fitting) | (side.labels < 0) | (-1 in fitting)
    return side._replace(weights=np.where(possible, side.weights, np.float32(0)))


def _clusters(side: Side, count: int, settings: SearchSettings, rng: np.random.Generator) -> Side:
    """At most `count` clusters of points of one label."""
    k = len(side.points)
    if k <= count:
        return side
    size = min(k, settings.sampled * count)
    chosen = slice(None) if size == k else rng.choice(k, size, replace=False)
    sample = np.concatenate([side.points, settings.facing.extent * side.cones], 1)[chosen]
    first = sample[rng.choice(size, count, replace=False)]
    centres, weights = lloyd(sample, first, settings.lloyd_iterations, side.weights[chosen])
    centres, weights = centres[weights > 0], weights[weights > 0]
    return Side(
        np.ascontiguousarray(centres[:, :3]),
        weights.astype(np.float32) * np.float32(k / size),
        np.full(len(centres), side.labels[0], np.int32),
        centres[:, 3:] / np.float32(settings.facing.extent),
    )


def lloyd(points: Array, centres: Array, iterations: int, weights: Array) -> tuple[Array, NDArray[np.float64]]:
    """Centres (k, d) after some iterations of k-means (Lloyd), and the weights of the points that were nearest to each.

    A centre that has lost all its points stays where it was, with the weight 0.
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


def kernel_sides(bearings: Side, points: Side, facing: Facing) -> tuple[WeightedBearings, WeightedPoints]:
    """Both sides as the compiled loops read them, before there are blocks (`blocks_of`)."""
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
            _cones(points, facing),
        ),
    )


def blocks_of(labels2d: NDArray[np.int32], labels3d: NDArray[np.int32]) -> NDArray[np.uintp]:
    """(k, 4) as `WeightedPoints` has them, of labels in ascending order."""
    blocks, free = [], int(np.searchsorted(labels2d, 0))
    for label in np.unique(labels3d):
        own = np.searchsorted(labels3d, (label, label + 1))
        if label < 0:
            blocks.append((0, len(labels2d), *own))
        else:
            blocks += [(0, free, *own), (*np.searchsorted(labels2d, (label, label + 1)), *own)]
    return np.array(blocks, np.uintp).reshape(-1, 4)


def _fitting(side: Side, other: Side) -> Array:
    """For each point the share, by weight, of the other side whose labels fit; above 0, for points without any."""
    if (side.labels < 0).all():
        return np.ones(len(side.labels), np.float32)
    values, place = np.unique(other.labels, return_inverse=True)
    weights, free = np.bincount(place, other.weights), other.weights[other.labels < 0].sum()
    at = np.minimum(np.searchsorted(values, side.labels), len(values) - 1)
    fitting = np.where(values[at] == side.labels, weights[at], 0.0) + free
    total = max(float(weights.sum()), 1e-12)
    return np.maximum(np.where(side.labels < 0, total, fitting) / total, 1e-6).astype(np.float32)


def _cones(points: Side, facing: Facing) -> Array:
    """(6, n) as `WeightedPoints` has them."""
    if not points.cones.shape[1]:
        return np.empty((6, 0), np.float32)
    normals, cosine, slope = points.cones[:, :3], points.cones[:, 3], 1 / (2 * facing.softness)
    towards = -slope * (normals * points.points).sum(1)
    rest = 0.5 - slope * cosine, np.full(len(cosine), facing.unseen)
    return np.ascontiguousarray(np.stack([*(slope * normals).T, towards, *rest]), np.float32)
