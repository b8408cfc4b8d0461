"""One-to-one matches of few points under a pose, their evidence, and a step of the pose on them: all compiled.

Directions are compared on a plane: stereographic coordinates (x, y) / (|p| + z) about the mean bearing, which is the z
axis here. A difference s there is an angle of s (1 + cos theta), theta from that axis, so that `gain` (m,) turns
differences near image point i into units of its radius. Poses are (12,): R by rows, then t. Normals without a row mean
that every point can be seen.
"""

import math
from typing import Any

from bpnp.loops.compilation import compiler
from bpnp.search.kernels.dense import solve_normal_equations

compiled = compiler(_nrt=False)
part = compiler(_nrt=False, no_cpython_wrapper=True)  # called by compiled functions alone
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


@part
def refine(pose: Any, rays: Any, points: Any, matched: Any, prior: Any, system: Any) -> bool:
    """One Gauss-Newton step, in place, on sum_i w_i^2 |f_i - g(R p + t)|^2 over the matches; False if it has none.

    g(y) = y/|y|. rays: (m, 4), f_i and w_i, one over its radius. prior: (k, 8) rows a, b, w: R a = b with the weight
    w; k may be 0. The step is y -> y + w x Rp + s.
    """
    for a in range(7):
        for b in range(6):
            system[a, b] = 0.0
    row = system[7]
    for i in range(len(matched) + len(prior)):
        k = i - len(matched)  # of the prior, whose directions have no translation: the step s moves none of them
        ux = uy = uz = shift = 0.0
        if k >= 0:
            x, y, z = turned(pose, prior[k, 0], prior[k, 1], prior[k, 2])
            turn = w = prior[k, 6]
            rx, ry, rz = prior[k, 3] - x, prior[k, 4] - y, prior[k, 5] - z
        elif matched[i] >= 0:
            j = matched[i]
            x, y, z = turned(pose, points[j, 0], points[j, 1], points[j, 2])
            ux, uy, uz = x + pose[9], y + pose[10], z + pose[11]
            inverse = 1 / math.sqrt(ux * ux + uy * uy + uz * uz)
            ux, uy, uz = ux * inverse, uy * inverse, uz * inverse
            along = rays[i, 0] * ux + rays[i, 1] * uy + rays[i, 2] * uz
            turn = shift = rays[i, 3] * inverse
            w = rays[i, 3] / (along if along > 0.1 else 0.1)
            rx, ry, rz = rays[i, 0] - along * ux, rays[i, 1] - along * uy, rays[i, 2] - along * uz
        else:
            continue
        for axis in range(3):  # of the camera, its part across the direction u
            own = ux if axis == 0 else uy if axis == 1 else uz
            ex, ey, ez = (axis == 0) - own * ux, (axis == 1) - own * uy, (axis == 2) - own * uz
            residual = w * (rx if axis == 0 else ry if axis == 1 else rz)
            row[0], row[1], row[2] = turn * (y * ez - z * ey), turn * (z * ex - x * ez), turn * (x * ey - y * ex)
            row[3], row[4], row[5] = shift * ex, shift * ey, shift * ez
            for a in range(6):
                system[6, a] += row[a] * residual
                for b in range(a + 1):
                    system[a, b] += row[a] * row[b]
    for k in range(6):
        system[k, k] *= 1 + 1e-9
    if not solve_normal_equations(system):
        return False
    return _turn(pose, row)


@part
def _turn(pose: Any, step: Any) -> bool:
    """R <- exp([w]x) R, t <- t + s with step (w, s), the turn no larger than half a radian."""
    wx, wy, wz = step[0], step[1], step[2]
    angle2 = wx * wx + wy * wy + wz * wz
    if not angle2 < math.inf:
        return False
    if angle2 > 0.25:
        shrink = 0.5 / math.sqrt(angle2)
        wx, wy, wz, angle2 = wx * shrink, wy * shrink, wz * shrink, 0.25
    angle = math.sqrt(angle2)
    s = math.sin(angle) / angle if angle > 1e-8 else 1.0
    c = 2 * (math.sin(0.5 * angle) / angle) ** 2 if angle > 1e-8 else 0.5
    for k in range(3):
        x, y, z = pose[k], pose[3 + k], pose[6 + k]
        ax, ay, az = wy * z - wz * y, wz * x - wx * z, wx * y - wy * x
        pose[k] = x + s * ax + c * (wy * az - wz * ay)
        pose[3 + k] = y + s * ay + c * (wz * ax - wx * az)
        pose[6 + k] = z + s * az + c * (wx * ay - wy * ax)
        pose[9 + k] += step[3 + k]
    return True
