"""Alignment of many poses on the CPU: each start runs through all its scales in one fused loop that stays in the cache.

docs/search.md states the mathematics. Arrays are float32 and coordinate-major, (3, m) bearings and (3, n) points, so
that loops over points vectorise. The starts are independent of each other: shares of them go to several threads.
"""

import math
from typing import Any

import numpy as np

from bpnp.compilation import compiler

F = np.float32
compiled = compiler(fastmath=True, boundscheck=False)
LARGEST_TURN = 0.5  # radians in one step
RELAXATION = 1.7  # of the steps on clusters: expectation-maximisation takes short ones
POWER = 256  # of the kernel: eight squarings


@compiled
def solve_normal_equations(hessian: Any, gradient: Any, step: Any) -> bool:
    """Solve the 6 x 6 system by Cholesky, in place; False if it is not positive definite."""
    for j in range(6):
        pivot = hessian[j, j]
        for k in range(j):
            pivot -= hessian[j, k] * hessian[j, k]
        if not pivot > 0:
            return False
        hessian[j, j] = math.sqrt(pivot)
        for i in range(j + 1, 6):
            value = hessian[i, j]
            for k in range(j):
                value -= hessian[i, k] * hessian[j, k]
            hessian[i, j] = value / hessian[j, j]
    for i in range(6):
        value = gradient[i]
        for k in range(i):
            value -= hessian[i, k] * step[k]
        step[i] = value / hessian[i, i]
    for i in range(5, -1, -1):
        value = step[i]
        for k in range(i + 1, 6):
            value -= hessian[k, i] * step[k]
        step[i] = value / hessian[i, i]
    return True


@compiled
def move(
    q: Any, p: Any, rotation: Any, translation: Any, relaxation: Any, hessian: Any, gradient: Any, step: Any
) -> bool:
    """One Gauss-Newton step on -sum_j q_j . g(R p_j + t), in place; False if the pose is not fixed by the points.

    With u = y/|y|: gradient in y -(q - (q.u)u)/|y|, Hessian |q| (I - u u^T)/|y|^2, chained by y -> y + w x Rp + s.
    """
    r00, r01, r02 = rotation[0, 0], rotation[0, 1], rotation[0, 2]
    r10, r11, r12 = rotation[1, 0], rotation[1, 1], rotation[1, 2]
    r20, r21, r22 = rotation[2, 0], rotation[2, 1], rotation[2, 2]
    t0, t1, t2 = translation[0], translation[1], translation[2]
    g0 = g1 = g2 = g3 = g4 = g5 = F(0)
    a00 = a01 = a02 = a11 = a12 = a22 = F(0)
    b00 = b01 = b02 = b10 = b11 = b12 = b20 = b21 = b22 = F(0)
    c00 = c01 = c02 = c11 = c12 = c22 = F(0)
    for j in range(p.shape[1]):
        x = r00 * p[0, j] + r01 * p[1, j] + r02 * p[2, j]
        y = r10 * p[0, j] + r11 * p[1, j] + r12 * p[2, j]
        z = r20 * p[0, j] + r21 * p[1, j] + r22 * p[2, j]
        ux, uy, uz = x + t0, y + t1, z + t2
        near2 = F(1) / (ux * ux + uy * uy + uz * uz + F(1e-12))
        near = math.sqrt(near2)
        ux *= near
        uy *= near
        uz *= near
        qx, qy, qz = q[0, j], q[1, j], q[2, j]
        along = qx * ux + qy * uy + qz * uz
        hx, hy, hz = (qx - along * ux) * near, (qy - along * uy) * near, (qz - along * uz) * near
        g0 += y * hz - z * hy
        g1 += z * hx - x * hz
        g2 += x * hy - y * hx
        g3 += hx
        g4 += hy
        g5 += hz
        w = math.sqrt(qx * qx + qy * qy + qz * qz) * near2
        m00, m01, m02 = w * (F(1) - ux * ux), -w * ux * uy, -w * ux * uz
        m11, m12, m22 = w * (F(1) - uy * uy), -w * uy * uz, w * (F(1) - uz * uz)
        c00 += m00
        c01 += m01
        c02 += m02
        c11 += m11
        c12 += m12
        c22 += m22
        e00, e10, e20 = y * m02 - z * m01, z * m00 - x * m02, x * m01 - y * m00
        e01, e11, e21 = y * m12 - z * m11, z * m01 - x * m12, x * m11 - y * m01
        e02, e12, e22 = y * m22 - z * m12, z * m02 - x * m22, x * m12 - y * m02
        b00 += e00
        b01 += e01
        b02 += e02
        b10 += e10
        b11 += e11
        b12 += e12
        b20 += e20
        b21 += e21
        b22 += e22
        a00 += y * e02 - z * e01
        a01 += z * e00 - x * e02
        a02 += x * e01 - y * e00
        a11 += z * e10 - x * e12
        a12 += x * e11 - y * e10
        a22 += x * e21 - y * e20
    hessian[0, 0], hessian[1, 0], hessian[2, 0] = a00, a01, a02
    hessian[1, 1], hessian[2, 1], hessian[2, 2] = a11, a12, a22
    hessian[3, 0], hessian[4, 0], hessian[5, 0] = b00, b01, b02
    hessian[3, 1], hessian[4, 1], hessian[5, 1] = b10, b11, b12
    hessian[3, 2], hessian[4, 2], hessian[5, 2] = b20, b21, b22
    hessian[3, 3], hessian[4, 3], hessian[5, 3] = c00, c01, c02
    hessian[4, 4], hessian[5, 4], hessian[5, 5] = c11, c12, c22
    gradient[0], gradient[1], gradient[2], gradient[3], gradient[4], gradient[5] = g0, g1, g2, g3, g4, g5
    floor = F(1e-6) * (a00 + a11 + a22 + c00 + c11 + c22) + F(1e-20)
    for k in range(6):
        hessian[k, k] = hessian[k, k] * F(1.001) + floor
    if not solve_normal_equations(hessian, gradient, step):
        return False
    for k in range(6):
        step[k] *= relaxation
    turn(rotation, step)
    translation[0] += step[3]
    translation[1] += step[4]
    translation[2] += step[5]
    return True


@compiled
def turn(rotation: Any, vector: Any) -> None:
    """R <- exp([w]x) R in place, the angle at most LARGEST_TURN; through a unit quaternion."""
    x, y, z = vector[0], vector[1], vector[2]
    angle: Any = math.sqrt(x * x + y * y + z * z)
    shrink = min(F(1), F(LARGEST_TURN) / (angle + F(1e-20)))
    angle *= shrink
    half = F(0.5) * angle
    factor = shrink * (F(0.5) if angle < F(1e-4) else math.sin(half) / angle)
    w = math.cos(half)
    x *= factor
    y *= factor
    z *= factor
    d00, d01, d02 = 1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)
    d10, d11, d12 = 2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)
    d20, d21, d22 = 2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)
    for c in range(3):
        r0, r1, r2 = rotation[0, c], rotation[1, c], rotation[2, c]
        rotation[0, c] = d00 * r0 + d01 * r1 + d02 * r2
        rotation[1, c] = d10 * r0 + d11 * r1 + d12 * r2
        rotation[2, c] = d20 * r0 + d21 * r1 + d22 * r2


@compiled
def assign(f: Any, a: Any, p: Any, b: Any, rotation: Any, translation: Any, scale: Any, outlier: Any, kernel: Any,
           row: Any, q: Any) -> Any:  # fmt: skip
    """Fill q_j with the soft assignment in product form; return the mean log-likelihood of the bearings.

    The kernel is (1 + z/256)^256, z = (f.u - 1)/s^2: within 3 % of exp(z) where it exceeds 0.02, and without a call.
    """
    m, n = f.shape[1], p.shape[1]
    total_a, total_b = F(a.sum()), F(b.sum())
    sharp = F(1) / (scale * scale * F(POWER))
    for i in range(m):
        row[i] = outlier * total_b
    for j in range(n):
        x = rotation[0, 0] * p[0, j] + rotation[0, 1] * p[1, j] + rotation[0, 2] * p[2, j] + translation[0]
        y = rotation[1, 0] * p[0, j] + rotation[1, 1] * p[1, j] + rotation[1, 2] * p[2, j] + translation[1]
        z = rotation[2, 0] * p[0, j] + rotation[2, 1] * p[1, j] + rotation[2, 2] * p[2, j] + translation[2]
        near = sharp / math.sqrt(x * x + y * y + z * z + F(1e-12))
        x *= near
        y *= near
        z *= near
        column, weight, line = F(0), b[j], kernel[j]
        for i in range(m):
            v = max(F(1) - sharp + f[0, i] * x + f[1, i] * y + f[2, i] * z, F(0))
            v = v * v
            v = v * v
            v = v * v
            v = v * v
            v = v * v
            v = v * v
            v = v * v
            v = v * v
            line[i] = v
            column += a[i] * v
            row[i] += weight * v
        q[0, j] = column
    likelihood = F(0)
    for i in range(m):
        likelihood += a[i] * math.log(row[i] / (total_b * scale * scale))
        row[i] = a[i] / row[i]
    for j in range(n):
        weight, line = b[j] / (q[0, j] + outlier * total_a), kernel[j]
        q0, q1, q2 = F(0), F(0), F(0)
        for i in range(m):
            v = line[i] * line[i] * row[i]
            q0 += v * f[0, i]
            q1 += v * f[1, i]
            q2 += v * f[2, i]
        q[0, j], q[1, j], q[2, j] = q0 * weight, q1 * weight, q2 * weight
    return likelihood / total_a


@compiled
def descend(f: Any, a: Any, p: Any, b: Any, rotation: Any, translation: Any, scales: Any, outlier: Any,
            score: Any) -> None:  # fmt: skip
    """Anneal every start (S, 3, 3), (S, 3) in place; score (S,) is the likelihood at the last scale, -inf if lost.

    outlier: o / s^2 of `Scene.outlier_density`.
    """
    m, n = f.shape[1], p.shape[1]
    for k in range(len(rotation)):
        kernel, row, q = np.empty((n, m), F), np.empty(m, F), np.empty((3, n), F)
        hessian, gradient, step = np.empty((6, 6), F), np.empty(6, F), np.empty(6, F)
        for scale in scales:
            score[k] = assign(
                f, a, p, b, rotation[k], translation[k], scale, outlier * scale * scale, kernel, row, q
            )  # fmt: skip
            if not move(q, p, rotation[k], translation[k], F(RELAXATION), hessian, gradient, step):
                score[k] = -np.inf
                break
