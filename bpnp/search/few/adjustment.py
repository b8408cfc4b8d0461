"""One Gauss-Newton step of a pose on its matches, and on directions that are known of it: compiled."""

import math
from typing import Any

from bpnp.compilation import compiler
from bpnp.search.few.matching import turned
from bpnp.search.kernels.dense import solve_normal_equations

compiled = compiler(error_model="numpy", boundscheck=False)


@compiled
def refine(pose: Any, rays: Any, points: Any, matched: Any, prior: Any, hessian: Any, gradient: Any, step: Any) -> bool:
    """One Gauss-Newton step, in place, on sum_i w_i^2 |f_i - g(R p + t)|^2 over the matches; False if it has none.

    g(y) = y/|y|. rays: (m, 4), f_i and w_i, one over its radius. prior: (k, 8) rows a, b, w: R a = b with the weight
    w; k may be 0. The step is y -> y + w x Rp + s.
    """
    hessian[:] = 0
    gradient[:] = 0
    for i in range(len(matched)):
        j = matched[i]
        if j < 0:
            continue
        x, y, z = turned(pose, points[j, 0], points[j, 1], points[j, 2])
        ux, uy, uz = x + pose[9], y + pose[10], z + pose[11]
        inverse = 1 / math.sqrt(ux * ux + uy * uy + uz * uz)
        ux, uy, uz = ux * inverse, uy * inverse, uz * inverse
        w = rays[i, 3]
        along = rays[i, 0] * ux + rays[i, 1] * uy + rays[i, 2] * uz
        # Two tangents of the sphere at u.
        if abs(uz) < 0.9:
            ex, ey, ez = -uy, ux, 0.0
        else:
            ex, ey, ez = uz, 0.0, -ux
        scale = 1 / math.sqrt(ex * ex + ey * ey + ez * ez)
        ex, ey, ez = ex * scale, ey * scale, ez * scale
        for side in range(2):
            if side:
                ex, ey, ez = uy * ez - uz * ey, uz * ex - ux * ez, ux * ey - uy * ex
            residual = w * (ex * rays[i, 0] + ey * rays[i, 1] + ez * rays[i, 2]) / max(along, 0.1)
            h = w * inverse
            step[0], step[1], step[2] = h * (y * ez - z * ey), h * (z * ex - x * ez), h * (x * ey - y * ex)
            step[3], step[4], step[5] = h * ex, h * ey, h * ez
            _add(hessian, gradient, step, residual)
    for k in range(len(prior)):
        x, y, z = turned(pose, prior[k, 0], prior[k, 1], prior[k, 2])
        w = prior[k, 6]
        step[3] = step[4] = step[5] = 0.0
        step[0], step[1], step[2] = 0.0, w * z, -w * y
        _add(hessian, gradient, step, w * (prior[k, 3] - x))
        step[0], step[1], step[2] = -w * z, 0.0, w * x
        _add(hessian, gradient, step, w * (prior[k, 4] - y))
        step[0], step[1], step[2] = w * y, -w * x, 0.0
        _add(hessian, gradient, step, w * (prior[k, 5] - z))
    for k in range(6):
        hessian[k, k] *= 1 + 1e-9
    if not solve_normal_equations(hessian, gradient, step):
        return False
    return _turn(pose, step)


@compiled
def _add(hessian: Any, gradient: Any, row: Any, residual: float) -> None:
    for a in range(6):
        gradient[a] += row[a] * residual
        for b in range(a + 1):
            hessian[a, b] += row[a] * row[b]


@compiled
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
