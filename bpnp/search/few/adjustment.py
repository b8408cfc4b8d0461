"""One Gauss-Newton step of a pose on its matches, and on directions that are known of it: compiled."""

import math
from typing import Any

from bpnp.search.few.matching import part, turned
from bpnp.search.kernels.dense import solve_normal_equations


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
