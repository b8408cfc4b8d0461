"""Perspective-three-point for one triple at a time, compiled: the solver of `bpnp.robust.p3p` without a batch.

The three pairs of points are 01, 12, 20. The caller puts the longest side of the scene's triangle between 1 and 2.
A division by zero is infinite, as in C; every root is tested before it is used.
"""

import math
from typing import Any

import numpy as np

from bpnp.search.few.matching import part

TOLERANCE = 1e-6  # of the squared sides, in units of the longest
ROUNDING = 1e-12  # of a discriminant: what is smaller than this counts as zero


@part
def p3p_depths(chord01: float, chord12: float, chord20: float, a: float, b: float, depths: Any) -> int:
    """The depths d_i > 0 of three rays with |d_i f_i - d_j f_j| = |p_i - p_j|; how many solutions there are (0 to 4).

    chord: |f_i - f_j|^2 of the unit rays. a, b: |p_0 - p_1|^2 and |p_2 - p_0|^2 over |p_1 - p_2|^2.
    depths: (4, 3), written; in units of |p_1 - p_2|. With x = d_0/d_2 and y = d_1/d_2 the law of cosines gives two
    conics; a root of det(C1 + s C2) = 0 makes their pencil a pair of lines, and each line meets the conics in at most
    two points (Ding, Yang, Larsson, Olsson, Astrom: Revisiting the P3P Problem, CVPR 2023).
    """
    m01, m12, m20 = 1 - 0.5 * chord01, 1 - 0.5 * chord12, 1 - 0.5 * chord20
    # Symmetric matrices by their components xx, xy, xw, yy, yw, ww; xx = 1 in both, xw = 0 in the first, xy = 0 in
    # the second.
    xy1, yy1, yw1, ww1 = -m01, 1 - a, a * m12, -a
    xw2, yy2, yw2, ww2 = -m20, -b, b * m12, 1 - b
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
    else:
        return 0
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
    d01, d02, d10, d12, d20, d21 = xy - pw, xw + py, xy + pw, yw - px, xw - py, yw + px
    # A row and a column through its largest entry are the two lines.
    top0 = max(abs(xx), abs(d01), abs(d02))
    top1 = max(abs(d10), abs(yy), abs(d12))
    top2 = max(abs(d20), abs(d21), abs(ww))
    if top0 >= top1 and top0 >= top2:
        r0, r1, r2 = xx, d01, d02
    elif top1 >= top2:
        r0, r1, r2 = d10, yy, d12
    else:
        r0, r1, r2 = d20, d21, ww
    if abs(r0) >= abs(r1) and abs(r0) >= abs(r2):
        c0, c1, c2 = xx, d10, d20
    elif abs(r1) >= abs(r2):
        c0, c1, c2 = d01, yy, d21
    else:
        c0, c1, c2 = d02, d12, ww
    count = np.int64(0)  # as a literal, `_meet` would be compiled for it
    for line in range(2):
        l0, l1, l2 = (c0, c1, c2) if line else (r0, r1, r2)
        count = _meet(l0, l1, l2, m01, m12, m20, a, b, chord01, chord12, chord20, depths, count)
    return int(count)


@part
def cubic_root(c0: float, c1: float, c2: float, c3: float) -> float:
    """The real root of c_0 s^3 + c_1 s^2 + c_2 s + c_3 that lies farthest from the other two, so the best determined.

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
def _meet(
    la: float, lb: float, lc: float, m01: float, m12: float, m20: float, a: float, b: float,
    chord01: float, chord12: float, chord20: float, depths: Any, count: int,
) -> int:  # fmt: skip
    """Append the depths of the points (x, y) where the line meets both conics."""
    steep = abs(la) > abs(lb)
    pivot = la if steep else lb
    if pivot == 0:
        return count
    # The coordinate with the smaller coefficient is free: (x, y) = (slope u + offset, u) or (u, slope u + offset).
    slope, offset = -(lb if steep else la) / pivot, -lc / pivot
    # Both restrictions of the conics to the line have the same roots; the smaller one is less accurate.
    if steep:
        q1, h1, k1 = _restrict(slope, offset, 1.0, -m01, 0.0, 1 - a, a * m12, -a)
        q2, h2, k2 = _restrict(slope, offset, 1.0, 0.0, -m20, -b, b * m12, 1 - b)
    else:
        q1, h1, k1 = _restrict(slope, offset, 1 - a, -m01, a * m12, 1.0, 0.0, -a)
        q2, h2, k2 = _restrict(slope, offset, -b, 0.0, b * m12, 1.0, -m20, 1 - b)
    if max(abs(q2), abs(h2), abs(k2)) > max(abs(q1), abs(h1), abs(k1)):
        q1, h1, k1 = q2, h2, k2
    discriminant = h1 * h1 - q1 * k1
    if not discriminant > -ROUNDING * (h1 * h1 + abs(q1 * k1)):
        return count
    larger = -(h1 + math.copysign(math.sqrt(max(discriminant, 0.0)), h1))
    for root in range(2):
        if (larger if root else q1) == 0:
            continue
        u = k1 / larger if root else larger / q1
        other = slope * u + offset
        x, y = (other, u) if steep else (u, other)
        if not (x > 0 and y > 0 and x < math.inf and y < math.inf):
            continue
        d2 = 1 / math.sqrt((1 - y) * (1 - y) + y * chord12)
        if polished(x * d2, y * d2, d2, chord01, chord12, chord20, a, b, depths[count]):
            count += 1
    return count


@part
def _restrict(
    slope: float, offset: float, bound2: float, mixed: float, bound: float, free2: float, free: float, constant: float
) -> tuple[float, float, float]:
    """A conic on a line, as coefficients q, h, k of q u^2 + 2 h u + k."""
    inner = bound2 * slope + mixed
    return (
        (inner + mixed) * slope + free2,
        inner * offset + bound * slope + free,
        (bound2 * offset + 2 * bound) * offset + constant,
    )


@part
def polished(
    d0: float, d1: float, d2: float, chord01: float, chord12: float, chord20: float, a: float, b: float, depths: Any
) -> bool:
    """Newton steps on the three equations, written to `depths` (3,); whether they hold there and all d_i > 0."""
    worst = math.inf
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
    return bool(worst < TOLERANCE and depths[0] > 0 and depths[1] > 0 and depths[2] > 0)
