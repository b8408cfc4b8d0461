"""Minimal solvers, compiled: three matches (P3P), or two with a prior direction (P2P).

The three sides of a triangle are 01, 12, 20, the longest one between 1 and 2. A division by zero is infinite, as in C;
every root is tested before it is used. Poses are (4, 3): R, and t below it.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bpnp.arrays import Array
from bpnp.runtime import compiler, in_threads
from bpnp.search.kernels.vectors import cross, rotated

FLAT_TRIANGLE = 1e-12  # squared height over squared longest side at which a triangle is a line [ratio; numerics]
SIDE_TOLERANCE = 1e-6  # largest error of the squared sides, in units of the longest [ratio; numerics]
ROUNDING = 1e-12  # relative size of a discriminant that counts as zero [ratio; numerics]
LEVEL_SINE = 1e-6  # sine of both rays' height below which a vertical does not determine their depths [1; numerics]
UPRIGHT_FRACTION = 1e-3  # horizontal part of the vector of two points that determines the heading [fraction; numerics]

compiled = compiler()
part = compiler(part=True, forceinline=True)  # called by compiled functions alone


class Triangles(NamedTuple):
    """Triangles of scene points, for P3P."""

    triples: NDArray[np.int64]  # (t, 3) indices of the points, in cyclic order so that the longest side is 12
    sides: Array  # (t, 3) |p_0 - p_1|^2 / s^2, |p_2 - p_0|^2 / s^2 and s = |p_1 - p_2|
    frames: Array  # (t, 3, 3), rows along the longest side, across it, and the normal
    centroids: Array  # (t, 3) centroids
    # (t,), 1 where a camera can see the points in the order of the triangle's normal, 2 in the other order, 3 either, 0
    # where the points lie on a line or are not finite.
    orientation: NDArray[np.int64]


def triangles_of(points: Array, triples: NDArray[np.int64]) -> Triangles:
    """Build the triangles of triples (t, 3) of points (n, 3), seen in either order."""
    p = points[triples]
    opposite = ((np.roll(p, -1, 1) - np.roll(p, -2, 1)) ** 2).sum(-1)
    turn = (opposite.argmax(1)[:, None] + np.arange(3)) % 3
    triples, p = np.take_along_axis(triples, turn, 1), np.take_along_axis(p, turn[..., None], 1)
    length2 = np.maximum(opposite.max(1), 1e-300)
    along = (p[:, 1] - p[:, 2]) / np.sqrt(length2)[:, None]
    normal = np.cross(along, p[:, 0] - p[:, 2])
    height2 = (normal**2).sum(-1)
    normal /= np.sqrt(np.maximum(height2, 1e-300))[:, None]
    a, b = (((p[:, 0] - p[:, k]) ** 2).sum(-1) / length2 for k in (1, 2))
    sides, frames = np.stack([a, b, np.sqrt(length2)], -1), np.stack([along, np.cross(normal, along), normal], 1)
    return Triangles(triples, sides, frames, p.mean(1), np.where(height2 > FLAT_TRIANGLE * length2, 3, 0))


def p3p_poses(rays: Array, points: Array) -> Array:
    """Solve d_i f_i = R p_i + t, d_i > 0, for triples of rays f and points p, (t, 3, 3) each, in float64.

    With x = d_0/d_2 and y = d_1/d_2 the law of cosines in the triangles at the camera gives two conics in (x, y). One
    real root s of the cubic det(C1 + s C2) = 0 makes their pencil a pair of lines, and each line meets the conics in at
    most two points (Ding, Yang, Larsson, Olsson, Astrom: Revisiting the P3P Problem, CVPR 2023). Newton steps on |d_i
    f_i - d_j f_j| = |p_i - p_j| then make the depths exact.

    Rays may have any length, points any scale and offset. Up to four poses (t, 4, 4, 3) of each triple are in no order,
    R and t below it; a double solution appears twice. NaN where there is none: for points on a line, within a millionth
    of the longest side, for rays that no pose explains, for NaN and infinity.
    """
    poses = np.full((len(points), 4, 4, 3), np.nan)

    def solve(first: int, last: int) -> None:
        corners = points[first:last].reshape(-1, 3)
        with np.errstate(all="ignore"):  # what is not finite has no pose
            unit = rays[first:last].reshape(-1, 3)
            unit = unit / np.linalg.norm(unit, axis=-1, keepdims=True)
            triangles = triangles_of(corners, np.arange(len(corners)).reshape(-1, 3))
        _solve_each(unit, triangles, poses[first:last], np.empty((4, 4, 3)))

    in_threads(solve, len(poses))
    return poses


@compiled
def _solve_each(rays: Any, triangles: Triangles, poses: Any, scratch: Any) -> None:
    """Fill `poses` (t, 4, 4, 3), NaN before, with the solutions of each triangle; scratch (4, 4, 3) is overwritten."""
    for t in range(len(poses)):
        i, j, k = triangles.triples[t, 0], triangles.triples[t, 1], triangles.triples[t, 2]
        if triangles.orientation[t]:
            for s in range(solve_p3p(rays, (i, j, k), chords_between(rays, i, j, k), triangles, t, scratch)):
                for r in range(4):
                    for c in range(3):
                        poses[t, s, r, c] = scratch[s, r, c]


@part
def solve_p3p(rays: Any, seen: Any, chords: Any, triangles: Triangles, t: int, poses: Any) -> int:
    """Fill `poses` (4, 4, 3) with those under which triangle t is seen along unit rays; return their number.

    The rays are those of the three indices `seen`, with the `chords_between` them.
    """
    i, j, k = seen
    sides, frame, centroid = triangles.sides[t], triangles.frames[t], triangles.centroids[t]
    count = 0
    for s in range(p3p_depths(chords, sides[0], sides[1], poses)):
        pose = poses[count]  # one of those whose depths were read
        d0, d1, d2 = sides[2] * poses[s, 3, 0], sides[2] * poses[s, 3, 1], sides[2] * poses[s, 3, 2]
        x0, y0, z0 = d0 * rays[i, 0], d0 * rays[i, 1], d0 * rays[i, 2]
        x1, y1, z1 = d1 * rays[j, 0], d1 * rays[j, 1], d1 * rays[j, 2]
        x2, y2, z2 = d2 * rays[k, 0], d2 * rays[k, 1], d2 * rays[k, 2]
        # Axes fixed to the triangle: a along its longest side, b across it, n its normal.
        ax, ay, az = x1 - x2, y1 - y2, z1 - z2
        nx, ny, nz = cross(ax, ay, az, x0 - x2, y0 - y2, z0 - z2)
        length2, area2 = ax * ax + ay * ay + az * az, nx * nx + ny * ny + nz * nz
        if not area2 > FLAT_TRIANGLE * length2 * length2:
            continue
        scale, across = 1 / math.sqrt(length2), 1 / math.sqrt(area2)
        ax, ay, az, nx, ny, nz = ax * scale, ay * scale, az * scale, nx * across, ny * across, nz * across
        bx, by, bz = cross(nx, ny, nz, ax, ay, az)
        for c in range(3):
            along, aside, above = frame[0, c], frame[1, c], frame[2, c]
            pose[0, c] = ax * along + bx * aside + nx * above
            pose[1, c] = ay * along + by * aside + ny * above
            pose[2, c] = az * along + bz * aside + nz * above
        x, y, z = rotated(pose, centroid[0], centroid[1], centroid[2])
        pose[3, 0], pose[3, 1], pose[3, 2] = (x0 + x1 + x2) / 3 - x, (y0 + y1 + y2) / 3 - y, (z0 + z1 + z2) / 3 - z
        count += 1
    return count


@part
def chords_between(rays: Any, i: int, j: int, k: int) -> tuple[float, float, float]:
    """Return |f_i - f_j|^2 of three unit rays, between the first and second, second and third, third and first."""
    return _distance2(rays[i], rays[j]), _distance2(rays[j], rays[k]), _distance2(rays[k], rays[i])


@part
def _distance2(f: Any, g: Any) -> float:
    """Return |f - g|^2."""
    x, y, z = f[0] - g[0], f[1] - g[1], f[2] - g[2]
    return x * x + y * y + z * z


@part
def p3p_depths(chords: Any, a: float, b: float, poses: Any) -> int:
    """Solve |d_i f_i - d_j f_j| = |p_i - p_j| for the depths d_i > 0 of three rays; return the number of solutions.

    a is |p_0 - p_1|^2 and b |p_2 - p_0|^2, over |p_1 - p_2|^2. The 0 to 4 depths are written to poses[:, 3], in units
    of |p_1 - p_2|. `chords` are the `chords_between` the rays; `p3p_poses` defines the conics and lines.
    """
    m01, m12, m20 = 1 - 0.5 * chords[0], 1 - 0.5 * chords[1], 1 - 0.5 * chords[2]
    # Symmetric matrices by their components xx, xy, xw, yy, yw, ww.
    conics = (1.0, -m01, 0.0, 1 - a, a * m12, -a), (1.0, 0.0, -m20, -b, b * m12, 1 - b)
    _, xy1, _, yy1, yw1, ww1 = conics[0]
    _, _, xw2, yy2, yw2, ww2 = conics[1]
    # Adjugates of both.
    axx, axy, axw = yy1 * ww1 - yw1 * yw1, -xy1 * ww1, xy1 * yw1
    ayy, ayw, aww = ww1, -yw1, yy1 - xy1 * xy1
    bxx, bxy, bxw = yy2 * ww2 - yw2 * yw2, xw2 * yw2, -xw2 * yy2
    byy, byw, bww = ww2 - xw2 * xw2, -yw2, yy2
    constant = axx + axy * xy1
    linear = axx + ayy * yy2 + aww * ww2 + 2 * (axw * xw2 + ayw * yw2)
    quadratic = bxx + byy * yy1 + bww * ww1 + 2 * (bxy * xy1 + byw * yw1)
    leading = bxx + bxw * xw2
    # The larger determinant leads, so that no root runs to infinity.
    if abs(constant) > abs(leading):
        first, second = cubic_root(constant, linear, quadratic, leading), 1.0
    elif leading != 0:
        first, second = 1.0, cubic_root(leading, quadratic, linear, constant)
    else:  # the first conic is a pair of lines, as for an equilateral triangle seen along its axis
        first, second = 1.0, 0.0
    xx, xy, xw = first + second, first * xy1, second * xw2
    yy, yw, ww = first * yy1 + second * yy2, first * yw1 + second * yw2, first * ww1 + second * ww2
    # The point p where the lines meet, from the adjugate, and D + [p]x, which has rank one.
    pxx, pyy, pww = yw * yw - yy * ww, xw * xw - xx * ww, xy * xy - xx * yy
    pxy, pxw, pyw = xy * ww - xw * yw, xw * yy - xy * yw, xx * yw - xy * xw
    if pxx >= pyy and pxx >= pww:
        px, py, pw, size = pxx, pxy, pxw, pxx
    elif pyy >= pww:
        px, py, pw, size = pxy, pyy, pyw, pyy
    else:
        px, py, pw, size = pxw, pyw, pww, pww
    if not size > 0:
        return 0
    size = 1 / math.sqrt(size)
    px, py, pw = px * size, py * size, pw * size
    # Of D + [p]x, a row and a column through its largest entry are the two lines.
    top, middle, bottom = (xx, xy - pw, xw + py), (xy + pw, yy, yw - px), (xw - py, yw + px, ww)
    row = top if _size(top) >= _size(middle) and _size(top) >= _size(bottom) else bottom
    row = middle if _size(middle) > _size(top) and _size(middle) >= _size(bottom) else row
    left, centre, right = abs(row[0]), abs(row[1]), abs(row[2])
    first_column = left >= centre and left >= right
    column = (top[0], middle[0], bottom[0]) if first_column else (top[2], middle[2], bottom[2])
    column = (top[1], middle[1], bottom[1]) if not first_column and centre >= right else column
    count: Any = np.int64(0)  # as a literal, `_meet` would be compiled for it
    for line in (row, column):
        count = _meet(line, conics, chords, a, b, poses, count)
    return count


@part
def _size(values: Any) -> float:
    """Return the largest absolute value of three."""
    return max(abs(values[0]), abs(values[1]), abs(values[2]))


@part
def cubic_root(c0: float, c1: float, c2: float, c3: float) -> float:
    """Return the best determined real root of c_0 s^3 + c_1 s^2 + c_2 s + c_3: the one farthest from the other two.

    Cardano for t^3 - 3 p t - 2 q with s = t - c_1/3c_0, by the cosine where all roots are real; then Newton steps.
    """
    b, c, d = c1 / c0, c2 / c0, c3 / c0
    p = b * b / 9 - c / 3
    q = b * c / 6 - d / 2 - b * b * b / 27
    size = abs(q)
    discriminant = q * q - p * p * p
    if discriminant > 0:
        outer = (size + math.sqrt(discriminant)) ** (1 / 3)
        root = outer + p / outer
    else:
        radius = math.sqrt(max(p, 0.0))
        cube = radius * radius * radius
        root = 2 * radius * math.cos(math.acos(min(size / cube, 1.0)) / 3) if cube > 0 else 0.0
    root = math.copysign(root, q) - b / 3
    for _ in range(2):
        slope = (3 * root + 2 * b) * root + c
        if slope != 0:
            root -= (((root + b) * root + c) * root + d) / slope
    return root


@part
def _meet(line: Any, conics: Any, chords: Any, a: float, b: float, poses: Any, count: int) -> int:
    """Append the depths of the points (x, y) where the line meets both conics."""
    la, lb, lc = line
    steep = abs(la) > abs(lb)
    pivot = la if steep else lb
    if pivot == 0:
        return count
    # The coordinate with the smaller coefficient is free: (x, y) = (slope u + offset, u) or (u, slope u + offset).
    slope, offset = -(lb if steep else la) / pivot, -lc / pivot
    # Both restrictions of the conics to the line have the same roots; the smaller one is less accurate.
    q, h, k = _restricted(conics[0], steep, slope, offset)
    other = _restricted(conics[1], steep, slope, offset)
    if _size(other) > _size((q, h, k)):
        q, h, k = other
    discriminant = h * h - q * k
    if not discriminant > -ROUNDING * (h * h + abs(q * k)):
        return count
    larger = -(h + math.copysign(math.sqrt(max(discriminant, 0.0)), h))
    for root in range(2):
        if (larger if root else q) == 0:
            continue
        u = k / larger if root else larger / q
        v = slope * u + offset
        x, y = (v, u) if steep else (u, v)
        if not (x > 0 and y > 0 and x < math.inf and y < math.inf):
            continue
        d2 = 1 / math.sqrt((1 - y) * (1 - y) + y * chords[1])
        if polish_depths(x * d2, y * d2, d2, chords, a, b, poses[count, 3]):
            count += 1
    return count


@part
def _restricted(conic: Any, steep: bool, slope: float, offset: float) -> tuple[float, float, float]:
    """Return a conic on a line, as coefficients q, h, k of q u^2 + 2 h u + k."""
    xx, xy, xw, yy, yw, ww = conic
    if not steep:
        xx, xw, yy, yw = yy, yw, xx, xw
    inner = xx * slope + xy
    return (inner + xy) * slope + yy, inner * offset + xw * slope + yw, (xx * offset + 2 * xw) * offset + ww


@part
def polish_depths(d0: float, d1: float, d2: float, chords: Any, a: float, b: float, depths: Any) -> bool:
    """Refine depths by Newton steps on the three equations, written to `depths` (3,).

    Return True if the equations hold there and all d_i > 0.
    """
    (chord01, chord12, chord20), worst = chords, math.inf
    for step in range(4):
        e0 = (d0 - d1) * (d0 - d1) + d0 * d1 * chord01 - a
        e1 = (d1 - d2) * (d1 - d2) + d1 * d2 * chord12 - 1
        e2 = (d2 - d0) * (d2 - d0) + d2 * d0 * chord20 - b
        error = max(abs(e0), abs(e1), abs(e2))
        if not error < worst:
            break
        depths[0], depths[1], depths[2], worst = d0, d1, d2, error
        if error < 1e-13 or step == 3:
            break
        # Row i of the Jacobian holds a_i at depth i and b_i at the next one; Cramer's rule, cyclic in i.
        a0, a1, a2 = 2 * (d0 - d1) + d1 * chord01, 2 * (d1 - d2) + d2 * chord12, 2 * (d2 - d0) + d0 * chord20
        b0, b1, b2 = 2 * (d1 - d0) + d0 * chord01, 2 * (d2 - d1) + d1 * chord12, 2 * (d0 - d2) + d2 * chord20
        scale = 1 / (a0 * a1 * a2 + b0 * b1 * b2)
        d0 -= scale * (a2 * (e0 * a1 - b0 * e1) + b0 * b1 * e2)
        d1 -= scale * (a0 * (e1 * a2 - b1 * e2) + b1 * b2 * e0)
        d2 -= scale * (a1 * (e2 * a0 - b2 * e0) + b2 * b0 * e1)
    return bool(worst < SIDE_TOLERANCE and depths[0] > 0 and depths[1] > 0 and depths[2] > 0)


@part
def solve_p2p(i: int, j: int, a: int, b: int, heading: Any, rays: Any, points: Any, poses: Any) -> int:
    """Fill `poses` (4, 4, 3) with those under which points a and b are seen along rays i and j, with a prior direction.

    f, g: the unit rays, p, q: the points, in the frames of `heading`, a `Heading`, whose z axis is the direction. With
    d g - c f = R (q - p), its z component is linear in the depths c and d, and the length of its horizontal part
    quadratic (Kukelova, Bujnak, Pajdla: Closed-form solutions to minimal absolute pose problems with known vertical
    direction, ACCV 2010). Return the number of poses, up to two.
    """
    f, g, p, q = heading.rays[i], heading.rays[j], heading.points[a], heading.points[b]
    if max(abs(f[2]), abs(g[2])) < LEVEL_SINE:
        return 0
    rise, along0, along1 = q[2] - p[2], q[0] - p[0], q[1] - p[1]
    length2 = along0 * along0 + along1 * along1
    if length2 < UPRIGHT_FRACTION * UPRIGHT_FRACTION * (length2 + rise * rise):
        return 0
    # R (q - p) lies in the plane of the rays; the prior rotation must bring it there within its largest error.
    n0, n1, n2 = cross(f[0], f[1], f[2], g[0], g[1], g[2])
    volume = n0 * along0 + n1 * along1 + n2 * rise
    if volume * volume > heading.sine2 * (n0 * n0 + n1 * n1 + n2 * n2) * (length2 + rise * rise):
        return 0
    # The depth x of the ray with the smaller z is free; the other depth is shift + slope x.
    swap = abs(f[2]) > abs(g[2])
    slope = g[2] / f[2] if swap else f[2] / g[2]
    shift = -rise / f[2] if swap else rise / g[2]
    if swap:  # d = x, c = shift + slope x
        u0, u1, v0, v1 = -shift * f[0], -shift * f[1], g[0] - slope * f[0], g[1] - slope * f[1]
    else:  # c = x, d = shift + slope x
        u0, u1, v0, v1 = shift * g[0], shift * g[1], slope * g[0] - f[0], slope * g[1] - f[1]
    square, half, constant = v0 * v0 + v1 * v1, u0 * v0 + u1 * v1, u0 * u0 + u1 * u1 - length2
    discriminant = half * half - square * constant
    if not (discriminant >= 0 and square > 0):
        return 0
    count = 0
    larger = -(half + math.copysign(math.sqrt(discriminant), half))
    for root in range(2):
        x = constant / larger if root else larger / square
        other = shift + slope * x
        c, d = (other, x) if swap else (x, other)
        if not (0 < c < math.inf and 0 < d < math.inf):
            continue
        way0, way1 = d * g[0] - c * f[0], d * g[1] - c * f[1]
        cosine, sine = (along0 * way0 + along1 * way1) / length2, (along0 * way1 - along1 * way0) / length2
        size = 1 / math.sqrt(cosine * cosine + sine * sine)
        cosine, sine, terms, pose = cosine * size, sine * size, heading.terms, poses[count]
        for r in range(3):
            for s in range(3):
                pose[r, s] = terms[0, r, s] + cosine * terms[1, r, s] + sine * terms[2, r, s]
        turned = rotated(pose, points[a, 0], points[a, 1], points[a, 2])
        for r in range(3):
            pose[3, r] = c * rays[i, r] - turned[r]
        count += 1
    return count
