"""Triangles of near points: in order of promise, what P3P needs of each, from which sides it is seen, and the pose that
places it on its rays."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bpnp.compilation import compiler
from bpnp.search.few.matching import turned

compiled = compiler(error_model="numpy", boundscheck=False)
FLAT = 1e-12  # squared height of a triangle over its squared longest side
SLACK = math.cos(math.radians(95.0))  # the lines of sight to three points are not quite parallel
EDGE_ON = 0.15  # sine of an angle to the triangle's plane, below which either orientation is possible


@compiled
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


@compiled
def triangle_table(points: Any, triples: Any, sides: Any, frames: Any, middles: Any, usable: Any) -> None:
    """What P3P needs of each scene triple, once: triples (t, 3) are turned so that the longest side is 12.

    points: (n, 3). sides: (t, 3), |p_0 - p_1|^2 / s^2, |p_2 - p_0|^2 / s^2 and s = |p_1 - p_2|. frames: (t, 3, 3) of
    `triangle_axes`. middles: (t, 3). usable: (t,), False where the triangle is flat.
    """
    for t in range(len(triples)):
        apex = 0
        best = -1.0
        for k in range(3):
            p, q = triples[t, (k + 1) % 3], triples[t, (k + 2) % 3]
            side2 = 0.0
            for x in range(3):
                side2 += (points[p, x] - points[q, x]) ** 2
            if side2 > best:
                apex, best = k, side2
        i, j, k = triples[t, apex], triples[t, (apex + 1) % 3], triples[t, (apex + 2) % 3]
        triples[t, 0], triples[t, 1], triples[t, 2] = i, j, k
        a = b = 0.0
        for x in range(3):
            a += (points[i, x] - points[j, x]) ** 2
            b += (points[k, x] - points[i, x]) ** 2
            middles[t, x] = (points[i, x] + points[j, x] + points[k, x]) / 3
        sides[t, 0], sides[t, 1], sides[t, 2] = a / best, b / best, math.sqrt(best)
        usable[t] = triangle_axes(
            points[i, 0], points[i, 1], points[i, 2], points[j, 0], points[j, 1], points[j, 2],
            points[k, 0], points[k, 1], points[k, 2], frames[t],
        )  # fmt: skip


@compiled
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


@compiled
def list_triples(order: Any, rank: Any, first: int, last: int, triples: Any) -> int:
    """Triples of a point, one of its `first` to `last` nearest (counted from 1), and a nearer one.

    Every set of three comes once, from the point to which the farther one of the other two is nearest in rank, and
    nearer triples come first. order: (n, k) each point's nearest. rank: (n, n) the place of one among another's.
    triples: (t, 3), written up to its length. Returns how many there are.
    """
    count = 0
    for farther in range(max(first - 1, 1), min(last, order.shape[1])):
        for nearer in range(farther):
            for i in range(len(order)):
                a, b = order[i, nearer], order[i, farther]
                from_a, from_b = max(rank[a, i], rank[a, b]), max(rank[b, i], rank[b, a])
                if from_a < farther or from_b < farther:
                    continue
                if (from_a == farther and a < i) or (from_b == farther and b < i):
                    continue
                if count < len(triples):
                    triples[count, 0], triples[count, 1], triples[count, 2] = i, a, b
                count += 1
    return count


def sphere(count: int) -> NDArray[np.float64]:
    """Unit vectors (count, 3) spread evenly: the golden spiral."""
    z = 1 - (2 * np.arange(count) + 1) / count
    angle = math.pi * (3 - math.sqrt(5)) * np.arange(count)
    radius = np.sqrt(1 - z * z)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z], -1)


@compiled
def orientations(triples: Any, frames: Any, normals: Any, directions: Any, usable: Any, sides: Any) -> None:
    """sides (t,): 1 where a camera can face all three points and see them in the order of their triangle's normal,
    2 in the other order, 3 either; 0 if none can, or the triangle is flat. normals: (n, 3) or (0, 3)."""
    for t in range(len(triples)):
        sides[t] = 3 if usable[t] else 0
        if not usable[t] or not len(normals):
            continue
        i, j, k = triples[t, 0], triples[t, 1], triples[t, 2]
        seen = 0
        for v in range(len(directions)):
            x, y, z = directions[v, 0], directions[v, 1], directions[v, 2]
            if (
                normals[i, 0] * x + normals[i, 1] * y + normals[i, 2] * z > SLACK
                and normals[j, 0] * x + normals[j, 1] * y + normals[j, 2] * z > SLACK
                and normals[k, 0] * x + normals[k, 1] * y + normals[k, 2] * z > SLACK
            ):
                height = frames[t, 2, 0] * x + frames[t, 2, 1] * y + frames[t, 2, 2] * z
                seen |= (height > -EDGE_ON) + 2 * (height < EDGE_ON)
                if seen == 3:
                    break
        sides[t] = seen
