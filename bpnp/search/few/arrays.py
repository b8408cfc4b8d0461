"""What the compiled loops read: a scene's points with the tables of their triples, and an image's points in a grid."""

import functools
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from bpnp.search.few.triangles import triangle_table, triples_within
from bpnp.search.starts import turned_to

Array = NDArray[np.float64]
Labels = NDArray[np.int64]
DENSE = 64  # points up to which all are ranked; beyond, only the nearest of each
OPPOSITE = -0.8  # cosine of two normals that no camera faces at once
CELLS = 48  # of the grid, a side
SCENES = 8  # whose tables are remembered


class SceneArrays:
    """Scene points around their centre in units of their extent, and the triples of near points, nearest first.

    arrays: points (n, 3), normals (n, 3) or (0, 3), labels (n,); writable, since the loops are compiled for such.
    """

    def __init__(self, points3d: Array, normals3d: Array | None, labels3d: Labels | None) -> None:
        self.centre = points3d.mean(0)
        local = points3d - self.centre
        self.size = max(float(np.sqrt((local**2).sum(-1).mean())), 1e-300)
        points = np.ascontiguousarray(local / self.size)
        normals = np.empty((0, 3)) if normals3d is None else np.array(normals3d, np.float64, order="C")
        labels = np.full(len(points), -1) if labels3d is None else np.array(labels3d, np.int64)
        self.arrays = points, normals, labels
        self.order, self.rank = neighbours_of(points, normals)
        self._tables: dict[int, tuple[NDArray[Any], ...]] = {}
        self._pairs: dict[int, NDArray[np.int64]] = {}

    def triples(self, near: int) -> tuple[NDArray[Any], ...]:
        """`triangle_table` of a point and two of its `near` nearest; those of fewer are the first rows."""
        near = min(near, self.order.shape[1])
        if near not in self._tables:
            found = triples_within(self.order, self.rank, near)
            self._tables[near] = triangle_table(*self.arrays[:2], found)
        return self._tables[near]

    def pairs(self, near: int) -> NDArray[np.int64]:
        """Pairs (t, 2) of a point and one of its `near` nearest, nearest first."""
        if near not in self._pairs:
            self._pairs[near] = pairs_within(self.order, self.rank, near)
        return self._pairs[near]


class ImageArrays:
    """Bearings in a frame whose z axis is their mean, stereographic, in a grid.

    turn: R, f in this frame = R f. rays: (m, 4), with one over the radius. arrays: flat (m, 2), gain (m,), labels (m,)
    and the grid's corner, starts and items (`grid_of`). density: the chance that one scene point falls
    within one radius of a given image point, if it may be anywhere among them.
    """

    def __init__(self, bearings: Array, radius: float | Array, labels2d: Labels | None, reach: float) -> None:
        self.turn = turned_to(bearings.mean(0))
        rays = bearings @ self.turn.T
        inverse = np.broadcast_to(1 / np.asarray(radius, np.float64), len(rays))
        self.rays = np.ascontiguousarray(np.column_stack([rays, inverse]))
        flat = np.ascontiguousarray(rays[:, :2] / np.maximum(1 + rays[:, 2:], 1e-9))
        gain = np.ascontiguousarray((1 + rays[:, 2]) * inverse)
        labels = np.full(len(rays), -1) if labels2d is None else np.array(labels2d, np.int64)
        self.arrays = (flat, gain, labels, *grid_of(flat, gain, reach))
        self.density = float(math.pi * (1 / gain**2).mean() / _area(flat, float(1 / gain.mean())))

    @functools.cached_property
    def _neighbours(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        return neighbours_of(self.rays[:, :3], np.empty((0, 3)))

    def triples(self, near: int) -> NDArray[np.int64]:
        """Triples (t, 3) of an image point and two of its `near` nearest, nearest first."""
        return triples_within(*self._neighbours, near)

    def pairs(self, near: int) -> NDArray[np.int64]:
        """Pairs (s, 2) of an image point and one of its `near` nearest, nearest first."""
        return pairs_within(*self._neighbours, near)


def pairs_within(order: NDArray[np.int64], rank: NDArray[np.int64], near: int) -> NDArray[np.int64]:
    """Pairs (t, 2) of a point and one of its `near` nearest, each pair once, nearest in rank first."""
    own, parts = np.arange(len(order)), []
    for k in range(min(near, order.shape[1])):
        other = order[:, k]
        back = rank[other, own]
        once = (back > k) | ((back == k) & (own < other))
        parts.append(np.stack([own, other], -1)[once])
    return np.ascontiguousarray(np.concatenate(parts))


def scene_arrays(points3d: Array, normals3d: Array | None, labels3d: Labels | None) -> SceneArrays:
    """The arrays of a scene; those of the last few are remembered, for a device is seen in frame after frame."""
    return _remembered(_packed(points3d), _packed(normals3d), _packed(labels3d))


@functools.lru_cache(maxsize=SCENES)
def _remembered(points3d: bytes, normals3d: bytes | None, labels3d: bytes | None) -> SceneArrays:
    return SceneArrays(
        np.frombuffer(points3d).reshape(-1, 3),
        None if normals3d is None else np.frombuffer(normals3d).reshape(-1, 3),
        None if labels3d is None else np.frombuffer(labels3d, np.int64),
    )


def _packed(values: NDArray[Any] | None) -> bytes | None:
    return None if values is None else np.ascontiguousarray(values).tobytes()


def neighbours_of(points: Array, normals: Array) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Each point's nearest (n, k), and the rank of each point among another's (n, n), n where it is not one of them.

    Points whose normals no camera can face at once come last. normals: (n, 3) or (0, 3).
    """
    n = len(points)
    rank = np.full((n, n), n)
    if n > DENSE:
        order = cKDTree(points).query(points, DENSE)[1]
        order = np.array([row[row != i][: DENSE - 1] for i, row in enumerate(order)], np.int64)
    else:
        distance2 = ((points[:, None] - points[None]) ** 2).sum(-1)
        if len(normals):
            distance2 += np.where(normals @ normals.T < OPPOSITE, 1e6 * (distance2.max() + 1e-300), 0.0)
        np.fill_diagonal(distance2, np.inf)
        order = np.argsort(distance2, axis=1, kind="stable")[:, :-1]
    np.put_along_axis(rank, order, np.broadcast_to(np.arange(order.shape[1]), order.shape), axis=1)
    return np.ascontiguousarray(order, np.int64), rank


def grid_of(flat: Array, gain: Array, reach: float) -> tuple[Array, NDArray[np.int64], NDArray[np.int64]]:
    """Cells of the plane with the image points (m, 2) that lie within `reach` radii of each.

    Returns the lower corner and cells a unit (3,); where the items of a cell begin (CELLS^2 + 1,), cells along the
    second coordinate next to each other; and the items.
    """
    around = reach / gain[:, None]
    low, high = (flat - around).min(0), (flat + around).max(0)
    per_cell = CELLS / (float((high - low).max()) * (1 + 1e-9) + 1e-12)
    first, last = (
        np.clip(((flat + side * around - low) * per_cell).astype(np.int64), 0, CELLS - 1) for side in (-1, 1)
    )
    size = last - first + 1
    count = size.prod(1)
    item = np.repeat(np.arange(len(flat)), count)
    nth = np.arange(len(item)) - np.repeat(np.cumsum(count) - count, count)
    row, column = first[item].T + np.stack(np.divmod(nth, size[item, 1]))
    cell = row * CELLS + column
    order = np.argsort(cell, kind="stable")
    return np.append(low, per_cell), np.searchsorted(cell[order], np.arange(CELLS**2 + 1)), item[order]


def _area(flat: Array, radius: float) -> float:
    """Area of the rectangle along the principal axes of the points that holds them, no side below two radii."""
    centred = flat - flat.mean(0)
    axes = np.linalg.eigh(centred.T @ centred)[1]
    sides = np.ptp(centred @ axes, axis=0) + 2 * radius
    return float(sides.prod())
