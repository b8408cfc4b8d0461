"""One-to-one matches of few points under a pose, and their evidence: compiled, without an allocation.

Directions are compared on a plane: stereographic coordinates (x, y) / (|p| + z) about the mean bearing, which is the z
axis here. A difference s there is an angle of s (1 + cos theta), theta from that axis, so that `gain` (m,) turns
differences near image point i into units of its radius. Poses are (12,): R by rows, then t. Normals without a row mean
that every point can be seen.
"""

import math
from typing import Any

from bpnp.compilation import compiler

compiled = compiler(error_model="numpy", _nrt=False)
part = compiler(error_model="numpy", _nrt=False, no_cpython_wrapper=True)  # called by compiled functions alone
WIDEST_MATCHED = math.cos(math.radians(87.0))  # of the angle between a normal and the line of sight: no match beyond
WIDEST_EXPECTED = math.cos(math.radians(72.0))  # a point is expected to be seen up to this angle
RADII = 5  # of the ladder 1, 1/2, 1/4 ... at which matches are counted
MISSED = 1.5  # nats that an expected but missing point costs: one in five is missed


@part
def turned(pose: Any, x: float, y: float, z: float) -> tuple[float, float, float]:
    """R (x, y, z)."""
    return (
        pose[0] * x + pose[1] * y + pose[2] * z,
        pose[3] * x + pose[4] * y + pose[5] * z,
        pose[6] * x + pose[7] * y + pose[8] * z,
    )


@part
def sight(pose: Any, points: Any, normals: Any, j: int) -> tuple[float, float, float]:
    """Where point j is seen on the plane, and the cosine of its normal to the line of sight (1 without normals)."""
    x, y, z = turned(pose, points[j, 0], points[j, 1], points[j, 2])
    cx, cy, cz = x + pose[9], y + pose[10], z + pose[11]
    length = math.sqrt(cx * cx + cy * cy + cz * cz)
    cosine = 1.0
    if len(normals):
        nx, ny, nz = turned(pose, normals[j, 0], normals[j, 1], normals[j, 2])
        cosine = -(nx * cx + ny * cy + nz * cz) / length
    scale = 1 / (length + cz)
    return cx * scale, cy * scale, cosine


@part
def nearest(
    u: float, v: float, label: int, reach2: float, flat: Any, gain: Any, labels2d: Any, corner: Any, starts: Any,
    items: Any,
) -> tuple[int, float]:  # fmt: skip
    """The image point nearest to (u, v) whose label fits, -1 for none within the root of reach2, and squared radii."""
    g = int(math.sqrt(len(starts) - 1))
    a, b = (u - corner[0]) * corner[2], (v - corner[1]) * corner[2]
    found = -1
    if not (a >= 0 and b >= 0 and a < g and b < g):
        return found, reach2
    cell = int(a) * g + int(b)
    for place in range(starts[cell], starts[cell + 1]):
        i = items[place]
        if label >= 0 and labels2d[i] >= 0 and label != labels2d[i]:
            continue
        d2 = gain[i] * gain[i] * ((u - flat[i, 0]) ** 2 + (v - flat[i, 1]) ** 2)
        if d2 < reach2:
            found, reach2 = i, d2
    return found, reach2


@part
def match(pose: Any, reach: float, scene: Any, image: Any, matched: Any, distance2: Any) -> tuple[int, int, int]:
    """Each image point's nearest scene point among those that have it as their nearest, within `reach` radii.

    matched: (m,), written: a scene point or -1. distance2: (m,), written: squared, in radii. scene: points, normals,
    labels; image: flat, gain, labels and the grid. Returns the matches, the points that can be seen among the image
    points, and those expected to be seen.
    """
    points, normals, labels3d = scene
    flat, gain, labels2d, corner, starts, items = image
    g = math.sqrt(len(starts) - 1)
    matched[:] = -1
    distance2[:] = reach * reach
    visible = expected = count = 0
    for j in range(len(points)):
        u, v, cosine = sight(pose, points, normals, j)
        if cosine < WIDEST_MATCHED:
            continue
        a, b = (u - corner[0]) * corner[2], (v - corner[1]) * corner[2]
        visible += a >= 0 and b >= 0 and a < g and b < g
        expected += len(normals) > 0 and cosine > WIDEST_EXPECTED
        i, d2 = nearest(u, v, labels3d[j], reach * reach, flat, gain, labels2d, corner, starts, items)
        if i >= 0 and d2 < distance2[i]:
            count += matched[i] < 0
            matched[i], distance2[i] = j, d2
    return count, visible, expected


@part
def evidence(
    count: int, visible: int, expected: int, distance2: Any, matched: Any, used: int, density: float
) -> tuple[float, float]:
    """Nats by which the matches exceed chance, less those of expected points that are missing; and the radius, of the
    ladder, at which they do: -log of C(m - used, k - used) p^(k - used), p the chance of one match.

    density: chance that one scene point lies within one radius of an image point that is anywhere. used: matches that
    the pose's freedom takes up.
    """
    best, radius, radius2 = -math.inf, 1.0, 1.0
    for _ in range(RADII):
        k = 0
        for i in range(len(matched)):
            k += matched[i] >= 0 and distance2[i] <= radius2
        chance = min(0.5, max(visible, 1) * density * radius2)
        value = -(k - used) * math.log(chance) - _log_choose(len(matched) - used, k - used)
        if value > best:
            best, radius = value, math.sqrt(radius2)
        radius2 *= 0.25
    return best - MISSED * max(expected - count, 0), radius


@part
def _log_choose(n: int, k: int) -> float:
    return math.lgamma(n + 1.0) - math.lgamma(k + 1.0) - math.lgamma(n - k + 1.0) if 0 <= k <= n else 0.0
