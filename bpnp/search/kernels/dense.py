"""Annealing of many poses on clusters, with a kernel for each pair of a bearing and a point; one pose fits the cache.

docs/search.md states the mathematics. Arrays are float32 and coordinate-major, so that loops over points vectorise.
Directions are held as offsets d = f - e, e = (0, 0, 1) the view's mean bearing (`SearchFrame`). The small numbers of a
narrow view keep their digits, where float32 rounds f . u - 1 to a multiple of 6e-8.

Shapes, for m bearings and n points:
    f: (3, m) offsets of the bearings.
    p: (3, n) points.
    rotation, translation: (3, 3) and (3,).
    q: (4, n) sums over the bearings of W_ij (f_i - u_j) and, in the last row, of W_ij. W is the soft assignment, and
        u_j = g(R p_j + t).
    system: (8, 6) Hessian (lower half), gradient, and step in (w, s).

The caller provides all buffers: without an allocation the loops compile in half the time.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from bpnp.arrays import Array32
from bpnp.search.kernels.sides import WeightedBearings, WeightedPoints, visible_weights
from bpnp.search.kernels.vectors import F, compiled, cross, direction, part, rotated, sum_of, turn

# Alternating expectation and maximisation takes short steps.
RELAXATION = 1.7  # factor on a Gauss-Newton step on clusters [factor; not tuned]
# Fraction by which each diagonal entry of the Hessian grows, so that a direction that the points do not fix is left
# unchanged.
STEP_DAMPING = 1e-3  # [fraction; not tuned]
# Smallest base of the kernel on clusters: a kernel of 1e-18, whose square is not denormal. Denormal numbers are 2.5
# times as slow.
LEAST_BASE = 0.85  # [1; numerics]

POWER = 256  # power of the kernel: eight squarings [1; derived]


@part
def normal_equations(q: Any, p: Any, rotation: Any, translation: Any, system: Any) -> None:
    """Fill the Gauss-Newton Hessian and gradient of sum_j q_j . u_j in (w, s), where y = R p + t moves by w x Rp + s.

    For one point the gradient in y is (q - (q.u) u) / |y|, the Hessian |q| (I - u u^T) / |y|^2, q the sum W_ij f_i.
    Both are written in W_ij (f_i - u_j) and in u_x, u_y, which are small numbers in a narrow view.
    """
    g0 = g1 = g2 = g3 = g4 = g5 = F(0)
    a00 = a01 = a02 = a11 = a12 = a22 = F(0)
    b00 = b01 = b02 = b10 = b11 = b12 = b20 = b21 = b22 = F(0)
    c00 = c01 = c02 = c11 = c12 = c22 = F(0)
    for j in range(p.shape[1]):
        x, y, z = rotated(rotation, p[0, j], p[1, j], p[2, j])
        ux, uy, dz, inverse = direction(x + translation[0], y + translation[1], z + translation[2])
        uz = dz + F(1)
        qx, qy, qz, total = q[0, j], q[1, j], q[2, j], q[3, j]
        along = qx * ux + qy * uy + qz * uz
        hx, hy, hz = (qx - along * ux) * inverse, (qy - along * uy) * inverse, (qz - along * uz) * inverse
        t0, t1, t2 = cross(x, y, z, hx, hy, hz)
        g0, g1, g2, g3, g4, g5 = g0 + t0, g1 + t1, g2 + t2, g3 + hx, g4 + hy, g5 + hz
        squared = qx * qx + qy * qy + qz * qz + total * (F(2) * along + total)
        w = math.sqrt(squared if squared > F(0) else F(0)) * inverse * inverse
        m00, m01, m02 = w * (uy * uy + uz * uz), -w * ux * uy, -w * ux * uz
        m11, m12, m22 = w * (ux * ux + uz * uz), -w * uy * uz, w * (ux * ux + uy * uy)
        c00, c01, c02, c11, c12, c22 = c00 + m00, c01 + m01, c02 + m02, c11 + m11, c12 + m12, c22 + m22
        e00, e10, e20 = cross(x, y, z, m00, m01, m02)
        e01, e11, e21 = cross(x, y, z, m01, m11, m12)
        e02, e12, e22 = cross(x, y, z, m02, m12, m22)
        b00, b01, b02 = b00 + e00, b01 + e01, b02 + e02
        b10, b11, b12 = b10 + e10, b11 + e11, b12 + e12
        b20, b21, b22 = b20 + e20, b21 + e21, b22 + e22
        k00, k01, k02 = cross(x, y, z, e00, e01, e02)
        _, k11, k12 = cross(x, y, z, e10, e11, e12)
        _, _, k22 = cross(x, y, z, e20, e21, e22)
        a00, a01, a02, a11, a12, a22 = a00 + k00, a01 + k01, a02 + k02, a11 + k11, a12 + k12, a22 + k22
    system[0, 0], system[1, 0], system[2, 0] = a00, a01, a02
    system[1, 1], system[2, 1], system[2, 2] = a11, a12, a22
    system[3, 0], system[4, 0], system[5, 0] = b00, b01, b02
    system[3, 1], system[4, 1], system[5, 1] = b10, b11, b12
    system[3, 2], system[4, 2], system[5, 2] = b20, b21, b22
    system[3, 3], system[4, 3], system[5, 3] = c00, c01, c02
    system[4, 4], system[5, 4], system[5, 5] = c11, c12, c22
    system[6, 0], system[6, 1], system[6, 2], system[6, 3], system[6, 4], system[6, 5] = g0, g1, g2, g3, g4, g5


@part
def solve_normal_equations(system: Any) -> bool:
    """Solve Hessian step = gradient by Cholesky, in place; return False if not positive definite or not finite."""
    for j in range(6):
        pivot = system[j, j]
        for k in range(j):
            pivot -= system[j, k] * system[j, k]
        if not (pivot > 0 and math.isfinite(pivot)):
            return False
        system[j, j] = math.sqrt(pivot)
        for i in range(j + 1, 7):  # row 6, the gradient, becomes the solution of the lower triangle
            value = system[i, j]
            for k in range(j):
                value -= system[i, k] * system[j, k]
            system[i, j] = value / system[j, j]
    for i in range(5, -1, -1):
        value = system[6, i]
        for k in range(i + 1, 6):
            value -= system[k, i] * system[7, k]
        system[7, i] = value / system[i, i]
    return True


@part
def move(q: Any, p: Any, rotation: Any, translation: Any, length: Any, system: Any) -> bool:
    """Take `length` times a damped Gauss-Newton step of the pose, in place; False if the points do not fix it."""
    normal_equations(q, p, rotation, translation, system)
    for k in range(6):
        system[k, k] *= F(1 + STEP_DAMPING)
    if not solve_normal_equations(system):
        return False
    step = system[7]
    for k in range(6):
        step[k] *= length
    turn(rotation, step)
    for k in range(3):
        translation[k] += step[3 + k]
    return True


@part
def see(p: Any, rotation: Any, translation: Any, u: Any) -> None:
    """Fill u (3, n) with the offsets of the directions in which a pose sees points (3, n)."""
    for j in range(p.shape[1]):
        x, y, z = rotated(rotation, p[0, j], p[1, j], p[2, j])
        x, y, z, _ = direction(x + translation[0], y + translation[1], z + translation[2])
        u[0, j], u[1, j], u[2, j] = x, y, z


class DenseScratch(NamedTuple):
    """Buffers of `descend`, for m bearings and n points."""

    kernel: Array32  # (n, m)
    base: Array32  # (m,)
    row: Array32  # (m,)
    u: Array32  # (3, n)
    column: Array32  # (n,)
    weight: Array32  # (n,) of the points under the pose at hand
    q: Array32  # (4, n)
    system: Array32  # (8, 6)


def dense_scratch(m: int, n: int) -> DenseScratch:
    """Allocate the buffers of `descend` for m bearings and n points."""
    return DenseScratch(*(np.empty(shape, F) for shape in ((n, m), m, m, (3, n), n, n, (4, n), (8, 6))))


@part
def assign(
    bearings: WeightedBearings,
    points: WeightedPoints,
    rotation: Any,
    translation: Any,
    scale: Any,
    outlier: Any,
    scratch: DenseScratch,
) -> Any:
    """Fill q with the soft assignment in product form; return the mean log-likelihood of the bearings.

    The kernel is (1 + z/256)^256, z = -|f - u|^2 / 2 s^2, s the scale in radians. It is within 3 % of exp(z) where that
    exceeds 0.02, and needs no function call. Bearings and points are in the order of the labels; the weights of the
    points under this pose are in the scratch. `outlier` is o of `SearchFrame.outlier_density`.
    """
    f, a, p, blocks = bearings.f, bearings.a, points.p, points.blocks
    kernel, base, row, u, column, weight, q, _ = scratch
    m, n = f.shape[1], p.shape[1]
    total_a, total_b = sum_of(a), sum_of(weight) + F(1e-20)
    sharp = F(1) / (scale * scale * F(POWER))
    for i in range(m):
        row[i] = outlier * total_b * bearings.odds[i]
        base[i] = F(1) - F(0.5) * sharp * (f[0, i] * f[0, i] + f[1, i] * f[1, i] + f[2, i] * f[2, i])
    see(p, rotation, translation, u)
    for j in range(n):
        column[j] = outlier * total_a * points.odds[j]
        q[0, j], q[1, j], q[2, j], q[3, j] = F(0), F(0), F(0), F(0)
    for k in range(len(blocks)):
        first, last = blocks[k, 0], blocks[k, 1]
        for j in range(blocks[k, 2], blocks[k, 3]):
            x, y, z = u[0, j], u[1, j], u[2, j]
            shift = F(-0.5) * sharp * (x * x + y * y + z * z)
            x, y, z = sharp * x, sharp * y, sharp * z
            total, b, line = F(0), weight[j], kernel[j]
            for i in range(first, last):
                v = max(base[i] + shift + f[0, i] * x + f[1, i] * y + f[2, i] * z, F(LEAST_BASE))
                v = v * v
                v = v * v
                v = v * v
                v = v * v
                v = v * v
                v = v * v
                v = v * v
                v = v * v
                line[i] = v
                total += a[i] * v
                row[i] += b * v
            column[j] += total
    likelihood = F(0)
    for i in range(m):
        likelihood += a[i] * math.log(row[i] / (total_b * scale * scale))
        row[i] = a[i] / row[i]
    for k in range(len(blocks)):
        first, last = blocks[k, 0], blocks[k, 1]
        for j in range(blocks[k, 2], blocks[k, 3]):
            b, line = weight[j] / column[j], kernel[j]
            q0, q1, q2, q3 = F(0), F(0), F(0), F(0)
            for i in range(first, last):
                v = line[i] * line[i] * row[i]
                q0 += v * f[0, i]
                q1 += v * f[1, i]
                q2 += v * f[2, i]
                q3 += v
            q[0, j] += (q0 - q3 * u[0, j]) * b
            q[1, j] += (q1 - q3 * u[1, j]) * b
            q[2, j] += (q2 - q3 * u[2, j]) * b
            q[3, j] += q3 * b
    return likelihood / total_a


@compiled
def descend(
    bearings: WeightedBearings,
    points: WeightedPoints,
    rotation: Any,
    translation: Any,
    scales: Any,
    outlier: Any,
    score: Any,
    scratch: DenseScratch,
) -> None:
    """Anneal poses (S, 3, 3), (S, 3) in place through decreasing scales (k,), radians.

    Bearings and points are in the order of the labels; `outlier` is o / s^2 of the scene. The score (S,) is the mean
    log-likelihood at the last scale, -inf for a pose that is not finite, or that the points do not fix.
    """
    for k in range(len(rotation)):
        for step in range(len(scales)):
            scale = scales[step]
            visible_weights(points, rotation[k], translation[k], scratch.weight)
            score[k] = assign(bearings, points, rotation[k], translation[k], scale, outlier * scale * scale, scratch)
            fixed = move(scratch.q, points.p, rotation[k], translation[k], F(RELAXATION), scratch.system)
            if not (fixed and math.isfinite(score[k])):
                score[k] = -np.inf
                break
