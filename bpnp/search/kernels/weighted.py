"""The two sides of a pair as the compiled loops read them: points, weights, labels and from where a point is seen.

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

from bpnp.search.kernels.vectors import F, part

Array = NDArray[np.float32]


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
