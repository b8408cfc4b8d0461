"""Triangles of near points: in order of promise, what P3P needs of each, from which sides it is seen, and the pose that
places it on its rays."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bpnp.search.few.matching import part, turned

Array = NDArray[np.float64]
Places = NDArray[np.int64]
FLAT = 1e-12  # squared height of a triangle over its squared longest side
SLACK = math.cos(math.radians(95.0))  # the lines of sight to three points are not quite parallel
EDGE_ON = 0.15  # sine of an angle to the triangle's plane, below which either orientation is possible


@part
def triangle_axes(
    x0: float, y0: float, z0: float, x1: float, y1: float, z1: float, x2: float, y2: float, z2: float, axes: Any
) -> bool:
    """Orthonormal axes fixed to a triangle, rows of `axes` (3, 3): the side 12, its perpendicular, the normal.

    Returns False if the triangle is flat.
    """
    ax, ay, az = x1 - x2, y1 - y2, z1 - z2
    bx, by, bz = x0 - x2, y0 - y2, z0 - z2
    length2 = ax * ax + ay * ay + az * az
    if not length2 > 0:
        return False
    scale = 1 / math.sqrt(length2)
    ax, ay, az = ax * scale, ay * scale, az * scale
    nx, ny, nz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    height2 = nx * nx + ny * ny + nz * nz
    if not height2 > FLAT * length2:
        return False
    scale = 1 / math.sqrt(height2)
    nx, ny, nz = nx * scale, ny * scale, nz * scale
    axes[0, 0], axes[0, 1], axes[0, 2] = ax, ay, az
    axes[1, 0], axes[1, 1], axes[1, 2] = ny * az - nz * ay, nz * ax - nx * az, nx * ay - ny * ax
    axes[2, 0], axes[2, 1], axes[2, 2] = nx, ny, nz
    return True


@part
def pose_of_triangle(
    rays: Any, i: int, j: int, k: int, depths: Any, side: float, frame: Any, middle: Any, axes: Any, pose: Any
) -> bool:
    """The pose (12,), R by rows and t, that puts the triangle at its depths along the rays i, j, k; False if flat.

    depths: (3,) in units of `side`. frame, middle: of `triangle_table`. axes: (3, 3), overwritten.
    """
    d0, d1, d2 = side * depths[0], side * depths[1], side * depths[2]
    x0, y0, z0 = d0 * rays[i, 0], d0 * rays[i, 1], d0 * rays[i, 2]
    x1, y1, z1 = d1 * rays[j, 0], d1 * rays[j, 1], d1 * rays[j, 2]
    x2, y2, z2 = d2 * rays[k, 0], d2 * rays[k, 1], d2 * rays[k, 2]
    if not triangle_axes(x0, y0, z0, x1, y1, z1, x2, y2, z2, axes):
        return False
    for r in range(3):
        for c in range(3):
            pose[3 * r + c] = axes[0, r] * frame[0, c] + axes[1, r] * frame[1, c] + axes[2, r] * frame[2, c]
    x, y, z = turned(pose, middle[0], middle[1], middle[2])
    pose[9], pose[10], pose[11] = (x0 + x1 + x2) / 3 - x, (y0 + y1 + y2) / 3 - y, (z0 + z1 + z2) / 3 - z
    return True


def triples_within(order: Places, rank: Places, near: int) -> Places:
    """Triples (t, 3) of a point and two of its `near` nearest.

    Every set of three comes once, from the point to which the farther one of the other two is nearest in rank, and
    nearer triples come first. order: (n, k) each point's nearest. rank: (n, n) the place of one among another's.
    """
    own, parts = np.arange(len(order)), [np.empty((0, 3), np.int64)]
    for farther in range(1, min(near, order.shape[1])):
        i, a, b = np.broadcast_arrays(own, order[:, :farther].T, order[:, farther])
        once = np.ones(a.shape, np.bool_)
        for one, other in ((a, b), (b, a)):
            back = np.maximum(rank[one, i], rank[one, other])
            once &= (back > farther) | ((back == farther) & (one > i))
        parts.append(np.stack([i[once], a[once], b[once]], -1))
    return np.concatenate(parts)


def orders_of_triples(rays: Array, triples: Places) -> tuple[NDArray[Any], ...]:
    """The six orders of image triples (t, 3), one after the other: places (6 t, 3), the squared chords 01, 12 and 20
    between their rays (m, 3), and 1 where these turn right-handed, else 2."""
    orders = triples[:, [[0, 1, 2], [1, 2, 0], [2, 0, 1], [0, 2, 1], [1, 0, 2], [2, 1, 0]]].reshape(-1, 3)
    f = rays[orders]
    hands = np.where((f[:, 0] * np.cross(f[:, 1], f[:, 2])).sum(-1) > 0, 1, 2)
    return orders, ((f - np.roll(f, -1, 1)) ** 2).sum(-1), hands


def triangle_table(points: Array, normals: Array, triples: Places) -> tuple[NDArray[Any], ...]:
    """What P3P needs of scene triples (t, 3), of those that a camera can see: the triples, turned so that the longest
    side is 12; sides (t, 3), |p_0 - p_1|^2 / s^2, |p_2 - p_0|^2 / s^2 and s = |p_1 - p_2|; frames (t, 3, 3) of
    `triangle_axes`; middles (t, 3); orientations (t,).

    The latter are 1 where a camera can face all three points and see them in the order of their triangle's normal, 2 in
    the other order, 3 either. points: (n, 3). normals: (n, 3) or (0, 3).
    """
    p = points[triples]
    opposite = ((np.roll(p, -1, 1) - np.roll(p, -2, 1)) ** 2).sum(-1)
    turn = (opposite.argmax(1)[:, None] + np.arange(3)) % 3
    triples, p = np.take_along_axis(triples, turn, 1), np.take_along_axis(p, turn[..., None], 1)
    length2 = np.maximum(opposite.max(1), 1e-300)
    along = (p[:, 1] - p[:, 2]) / np.sqrt(length2)[:, None]
    normal = np.cross(along, p[:, 0] - p[:, 2])
    height2 = (normal**2).sum(-1)
    normal /= np.sqrt(np.maximum(height2, 1e-300))[:, None]
    frames = np.stack([along, np.cross(normal, along), normal], 1)
    a, b = (((p[:, 0] - p[:, k]) ** 2).sum(-1) / length2 for k in (1, 2))
    orientation: Places = np.full(len(triples), 3)
    if len(normals):
        facing = (normals @ DIRECTIONS.T > SLACK)[triples].all(1)
        above = normal @ DIRECTIONS.T
        orientation = np.stack([(facing & (side * above < EDGE_ON)).any(1) for side in (-1, 1)], -1) @ (1, 2)
    seen = (height2 > FLAT * length2) & (orientation > 0)
    tables = triples, np.stack([a, b, np.sqrt(length2)], -1), frames, p.mean(1), orientation
    return tuple(np.ascontiguousarray(table[seen]) for table in tables)


def sphere(count: int) -> Array:
    """Unit vectors (count, 3) spread evenly: the golden spiral."""
    z = 1 - (2 * np.arange(count) + 1) / count
    angle = math.pi * (3 - math.sqrt(5)) * np.arange(count)
    radius = np.sqrt(1 - z * z)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z], -1)


DIRECTIONS = sphere(192)
