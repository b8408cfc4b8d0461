"""Poses of two pairs where the vertical or the rotation is known, and every hypothesis of a block of them. Compiled."""

import math
from typing import Any

from bpnp.search.few.enumeration import faces, fits, witnessed
from bpnp.search.few.kept import allowed, consider, copy
from bpnp.search.few.matching import compiled, part, turned

LEVEL = 1e-6  # sine of both rays' height, below which a known vertical says nothing about their depths
UPRIGHT = 1e-3  # horizontal part of the way between two points, below which it says nothing about the heading


@part
def p2p_upright(f: Any, g: Any, p: Any, q: Any, poses: Any) -> int:
    """Poses (2, 12) of two pairs with the vertical along z in both frames: R turns about z; how many there are.

    f, g: (3,) unit rays. p, q: (3,) points. With d g - c f = R (q - p), its z component is linear in the depths c and
    d, and the length of its horizontal part quadratic (Kukelova, Bujnak, Pajdla: Closed-form solutions to minimal
    absolute pose problems with known vertical direction, ACCV 2010).
    """
    if max(abs(f[2]), abs(g[2])) < LEVEL:
        return 0
    rise, along0, along1 = q[2] - p[2], q[0] - p[0], q[1] - p[1]
    length2 = along0 * along0 + along1 * along1
    if length2 < UPRIGHT * UPRIGHT * (length2 + rise * rise):
        return 0
    # The depth x of the ray with the smaller z is free; the other depth is shift + slope x.
    swap = abs(f[2]) > abs(g[2])
    slope = g[2] / f[2] if swap else f[2] / g[2]
    shift = -rise / f[2] if swap else rise / g[2]
    if swap:  # d = x, c = shift + slope x
        u0, u1, v0, v1 = -shift * f[0], -shift * f[1], g[0] - slope * f[0], g[1] - slope * f[1]
    else:  # c = x, d = shift + slope x
        u0, u1, v0, v1 = shift * g[0], shift * g[1], slope * g[0] - f[0], slope * g[1] - f[1]
    a, h, k = v0 * v0 + v1 * v1, u0 * v0 + u1 * v1, u0 * u0 + u1 * u1 - length2
    discriminant = h * h - a * k
    if not (discriminant >= 0 and a > 0):
        return 0
    count = 0
    larger = -(h + math.copysign(math.sqrt(discriminant), h))
    for root in range(2):
        x = k / larger if root else larger / a
        other = shift + slope * x
        c, d = (other, x) if swap else (x, other)
        if not (0 < c < math.inf and 0 < d < math.inf):
            continue
        way0, way1 = d * g[0] - c * f[0], d * g[1] - c * f[1]
        cosine, sine = (along0 * way0 + along1 * way1) / length2, (along0 * way1 - along1 * way0) / length2
        size = 1 / math.sqrt(cosine * cosine + sine * sine)
        cosine, sine = cosine * size, sine * size
        pose = poses[count]
        pose[:9] = 0.0
        pose[0], pose[1], pose[3], pose[4], pose[8] = cosine, -sine, sine, cosine, 1.0
        pose[9] = c * f[0] - (cosine * p[0] - sine * p[1])
        pose[10] = c * f[1] - (sine * p[0] + cosine * p[1])
        pose[11] = c * f[2] - p[2]
        count += 1
    return count


@part
def p2p_turned(f: Any, g: Any, p: Any, q: Any, known: Any, most: float, noise: float, pose: Any) -> bool:
    """The pose (12,) of two pairs whose rotation is the least turn away from the known one (9,), by rows.

    f, g: (3,) unit rays. p, q: (3,) points. R (q - p) has to lie in the plane of the rays; the turn that brings it
    there is at most `most` radians, plus what `noise` radians of the rays may turn their plane. False if there is none.
    """
    n0, n1, n2 = f[1] * g[2] - f[2] * g[1], f[2] * g[0] - f[0] * g[2], f[0] * g[1] - f[1] * g[0]
    sine = math.sqrt(n0 * n0 + n1 * n1 + n2 * n2)
    if not sine > 2 * noise:
        return False
    n0, n1, n2 = n0 / sine, n1 / sine, n2 / sine
    w0, w1, w2 = turned(known, q[0] - p[0], q[1] - p[1], q[2] - p[2])
    length = math.sqrt(w0 * w0 + w1 * w1 + w2 * w2)
    off = (n0 * w0 + n1 * w1 + n2 * w2) / length
    if not abs(off) < math.sin(min(most + 2 * noise / sine, 1.5)):
        return False
    # Its projection v into the plane, of the same length; the turn from w to v is about their cross product.
    v0, v1, v2 = w0 - off * length * n0, w1 - off * length * n1, w2 - off * length * n2
    cosine = math.sqrt(1 - off * off)
    v0, v1, v2 = v0 / cosine, v1 / cosine, v2 / cosine
    # d g - c f = v: the cross products of v with the rays, along the normal, over that of the rays.
    c = (n0 * (v1 * g[2] - v2 * g[1]) + n1 * (v2 * g[0] - v0 * g[2]) + n2 * (v0 * g[1] - v1 * g[0])) / -sine
    d = (n0 * (v1 * f[2] - v2 * f[1]) + n1 * (v2 * f[0] - v0 * f[2]) + n2 * (v0 * f[1] - v1 * f[0])) / -sine
    if not (0 < c < math.inf and 0 < d < math.inf):
        return False
    axis0, axis1, axis2 = (w1 * v2 - w2 * v1), (w2 * v0 - w0 * v2), (w0 * v1 - w1 * v0)
    axis0, axis1, axis2 = axis0 / (length * length), axis1 / (length * length), axis2 / (length * length)
    bend = 1 / (1 + cosine)
    for k in range(3):
        r0, r1, r2 = known[k], known[3 + k], known[6 + k]
        a0, a1, a2 = axis1 * r2 - axis2 * r1, axis2 * r0 - axis0 * r2, axis0 * r1 - axis1 * r0
        pose[k] = r0 + a0 + bend * (axis1 * a2 - axis2 * a1)
        pose[3 + k] = r1 + a1 + bend * (axis2 * a0 - axis0 * a2)
        pose[6 + k] = r2 + a2 + bend * (axis0 * a1 - axis1 * a0)
    x, y, z = turned(pose, p[0], p[1], p[2])
    pose[9], pose[10], pose[11] = c * f[0] - x, c * f[1] - y, c * f[2] - z
    return True


@compiled
def sweep_pairs(
    first: int, last: int, old_image: int, old_scene: int, new_scene: int, stop: float, budget: int, rays: Any,
    pairs2d: Any, pairs3d: Any, upright: Any, known: Any, witnesses: Any, need: int, reach: float, scene: Any,
    image: Any, used: int, density: float, prior: Any, found: Any, work: Any,
) -> tuple[int, int]:  # fmt: skip
    """As `enumeration.sweep`, but image pairs (s, 2), in both orders, against scene pairs (t, 2).

    upright: the rays, the points, and two rotations of frames whose z axis is the vertical, if it is known (its rays
    are empty otherwise). known: (11,), the rotation by rows, the largest turn from it and the rays' noise, radians.
    """
    tall_rays, tall_points, from_tall, to_tall = upright
    labels2d, labels3d, points, pose = image[2], scene[2], scene[0], work[2]
    poses = work[6]
    solved, place, best = 0, first, found[5]
    while place < last and solved < budget and found[1][best[0]] < stop:
        for turn in range(2):
            i, j = pairs2d[place, turn], pairs2d[place, 1 - turn]
            for t in range(old_scene if place < old_image else 0, new_scene):
                a, b = pairs3d[t, 0], pairs3d[t, 1]
                if not (fits(labels2d[i], labels3d[a]) and fits(labels2d[j], labels3d[b])):
                    continue
                solved += 1
                if len(tall_rays):
                    count = p2p_upright(tall_rays[i], tall_rays[j], tall_points[a], tall_points[b], poses)
                else:
                    count = int(
                        p2p_turned(rays[i], rays[j], points[a], points[b], known, known[9], known[10], poses[0])
                    )
                for s in range(count):
                    if len(tall_rays):
                        _changed(poses[s], from_tall, to_tall, pose)
                    else:
                        copy(poses[s], pose)
                    if not (faces(pose, scene, rays, a, i, b, j) and allowed(pose, prior, work[7])):
                        continue
                    if witnessed(pose, a, b, b, i, j, j, witnesses, need, reach, scene, image):
                        consider(pose, reach, rays, scene, image, used, density, prior, found, work)
        place += 1
    return place, solved


@part
def _changed(tall: Any, from_tall: Any, to_tall: Any, pose: Any) -> None:
    """The pose A R B, A t of a pose (R, t) between frames that stand upright."""
    for r in range(3):
        for c in range(3):
            total = 0.0
            for k in range(3):
                for x in range(3):
                    total += from_tall[r, k] * tall[3 * k + x] * to_tall[x, c]
            pose[3 * r + c] = total
        pose[9 + r] = from_tall[r, 0] * tall[9] + from_tall[r, 1] * tall[10] + from_tall[r, 2] * tall[11]
