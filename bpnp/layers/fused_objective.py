"""Derivatives of the PnP objective on a CPU in one loop over the points; `bpnp.layers.objective` states them."""

import math
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from bpnp.layers.fused import compiled, run


def fused_derivatives(
    q: Float[Tensor, "b n 3"],
    points3d: Float[Tensor, "b n 3"],
    rotation: Float[Tensor, "b 3 3"],
    translation: Float[Tensor, "b 3"],
    near: float,
) -> tuple[Float[Tensor, " b"], Float[Tensor, "b 6"], Float[Tensor, "b 6 6"]]:
    """Value, gradient and Hessian of -sum_j q_j . g(R p_j + t); distances below `near` count as this."""
    b = len(q)
    value, gradient, hessian = q.new_empty(b), q.new_empty(b, 6), q.new_empty(b, 6, 6)
    run(_derive, q, points3d, rotation, translation, torch.full_like(value, near), value, gradient, hessian)
    return value, gradient, hessian


@compiled
def _derive(
    start: int, stop: int, weights: Any, points: Any, rotations: Any, translations: Any, near: Any, values: Any,
    gradients: Any, hessians: Any,
) -> None:  # fmt: skip
    for s in range(start, stop):
        weight, point, r, t = weights[s], points[s], rotations[s], translations[s]
        value = g0 = g1 = g2 = g3 = g4 = g5 = near.dtype.type(0)
        a00 = a01 = a02 = a11 = a12 = a22 = near.dtype.type(0)
        b00 = b01 = b02 = b10 = b11 = b12 = b20 = b21 = b22 = near.dtype.type(0)
        c00 = c01 = c02 = c11 = c12 = c22 = near.dtype.type(0)
        d00 = d01 = d02 = d10 = d11 = d12 = d20 = d21 = d22 = near.dtype.type(0)
        for j in range(len(point)):
            px, py, pz = point[j, 0], point[j, 1], point[j, 2]
            x = r[0, 0] * px + r[0, 1] * py + r[0, 2] * pz
            y = r[1, 0] * px + r[1, 1] * py + r[1, 2] * pz
            z = r[2, 0] * px + r[2, 1] * py + r[2, 2] * pz
            ux, uy, uz = x + t[0], y + t[1], z + t[2]
            distance = math.sqrt(ux * ux + uy * uy + uz * uz)
            if distance < near[s]:
                distance = near[s]
            inverse = 1 / distance
            ux, uy, uz = ux * inverse, uy * inverse, uz * inverse
            qx, qy, qz = weight[j, 0], weight[j, 1], weight[j, 2]
            along = qx * ux + qy * uy + qz * uz
            hx, hy, hz = (along * ux - qx) * inverse, (along * uy - qy) * inverse, (along * uz - qz) * inverse
            value -= along
            g0 += y * hz - z * hy
            g1 += z * hx - x * hz
            g2 += x * hy - y * hx
            g3 += hx
            g4 += hy
            g5 += hz
            # G, with w = q - 1.5 (q.u) u.
            square = inverse * inverse
            wx, wy, wz = qx - 1.5 * along * ux, qy - 1.5 * along * uy, qz - 1.5 * along * uz
            m00, m11 = (along + 2 * ux * wx) * square, (along + 2 * uy * wy) * square
            m22, m01 = (along + 2 * uz * wz) * square, (ux * wy + wx * uy) * square
            m02, m12 = (ux * wz + wx * uz) * square, (uy * wz + wy * uz) * square
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
            d00 += x * hx
            d01 += x * hy
            d02 += x * hz
            d10 += y * hx
            d11 += y * hy
            d12 += y * hz
            d20 += z * hx
            d21 += z * hy
            d22 += z * hz
        values[s] = value
        slope, h = gradients[s], hessians[s]
        slope[0], slope[1], slope[2], slope[3], slope[4], slope[5] = g0, g1, g2, g3, g4, g5
        # A rotation bends the path.
        trace = d00 + d11 + d22
        h[0, 0], h[1, 1], h[2, 2] = a00 + d00 - trace, a11 + d11 - trace, a22 + d22 - trace
        h[0, 1], h[0, 2], h[1, 2] = a01 + 0.5 * (d01 + d10), a02 + 0.5 * (d02 + d20), a12 + 0.5 * (d12 + d21)
        h[0, 3], h[0, 4], h[0, 5] = b00, b01, b02
        h[1, 3], h[1, 4], h[1, 5] = b10, b11, b12
        h[2, 3], h[2, 4], h[2, 5] = b20, b21, b22
        h[3, 3], h[4, 4], h[5, 5] = c00, c11, c22
        h[3, 4], h[3, 5], h[4, 5] = c01, c02, c12
        for i in range(6):
            for k in range(i):
                h[i, k] = h[k, i]
