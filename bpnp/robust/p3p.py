"""Perspective-three-point for a whole batch at once: every pose that maps three scene points onto three viewing rays.

Inside, the batch is the last axis and components come first, so that each step is one pass over contiguous memory.
The three pairs of points are 01, 12, 20, so that the other end of each pair is one roll away. A symmetric 3 x 3
matrix is given by its six components xx, xy, xw, yy, yw, ww.
"""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

NEWTON_STEPS = 2  # on the depths
TOLERANCE = 1e-6  # of the squared sides, relative to the longest


def take(values: Tensor, index: Int[Tensor, "b k"]) -> Tensor:
    """values[b, index[b, i], ...] for every sample b."""
    trailing = values.shape[2:]
    return values.gather(1, index.view(*index.shape, *(1 for _ in trailing)).expand(*index.shape, *trailing))


class P3P(NamedTuple):
    """Up to four poses a sample, camera = R p + t; slots without a solution hold NaN and `valid` False."""

    rotation: Float[Tensor, "*b 4 3 3"]
    translation: Float[Tensor, "*b 4 3"]
    valid: Bool[Tensor, "*b 4"]


def p3p(bearings: Float[Tensor, "*b 3 3"], points3d: Float[Tensor, "*b 3 3"]) -> P3P:
    """Solve d_i f_i = R p_i + t, d_i > 0, for three matches (rows of the last two axes).

    With x = d_0/d_2 and y = d_1/d_2 the law of cosines in the triangles at the camera gives two conics in (x, y). One
    real root s of the cubic det(C1 + s C2) = 0 makes their pencil a pair of lines, and each line meets the conics in at
    most two points (Ding, Yang, Larsson, Olsson, Astrom: Revisiting the P3P Problem, CVPR 2023). Newton
    steps on |d_i f_i - d_j f_j| = |p_i - p_j| then make the depths exact.

    bearings: rays in the camera frame, of any length. points3d: scene units, any scale and offset. Computed in float64,
    returned in the type of `points3d`. The four slots have no order, and where two solutions meet both are given.
    Collinear or repeated points, rays that no pose explains, NaN and infinity give `valid` False. Work and shapes do
    not depend on the data, so nothing waits for the device.

    >>> points3d = torch.eye(3)
    >>> camera = points3d + torch.tensor([0.0, 0.0, 5.0])
    >>> solution = p3p(camera, points3d)
    >>> rotation_is_found = (solution.rotation - torch.eye(3)).abs().amax((-2, -1)) < 1e-5
    >>> bool((rotation_is_found & solution.valid).any())
    True
    """
    rays = bearings.double().movedim((-2, -1), (0, 1)).contiguous()
    points = points3d.double().movedim((-2, -1), (0, 1)).contiguous()
    # Cyclic order of the points that puts the longest side between the last two.
    apex = _sides2(points).argmax(0) + 2
    order = torch.stack([(apex + i) % 3 for i in range(3)]).unsqueeze(1).expand(points.shape)
    rays, points = rays.gather(0, order), points.gather(0, order)
    rays = rays * rays.square().sum(1, keepdim=True).rsqrt()
    lengths2, chords2 = _sides2(points), _sides2(rays)
    scale = lengths2[1].sqrt()
    lengths2 = lengths2 / lengths2[1]

    x, y = _ratios(1 - chords2 / 2, lengths2)
    last = ((1 - y).square() + y * chords2[1]).rsqrt()
    depths = torch.stack([x * last, y * last, last])
    chords2, lengths2 = chords2.unsqueeze(1), lengths2.unsqueeze(1)
    for _ in range(NEWTON_STEPS):
        depths = _newton_step(depths, chords2, lengths2)

    valid = (depths > 0).all(0) & (_residuals(depths, chords2, lengths2).abs().amax(0) < TOLERANCE)
    camera = (depths * scale).unsqueeze(1) * rays.unsqueeze(2)  # 3 points, 3 coordinates, 4 slots
    camera_axes, world_axes = _frame(camera), _frame(points.unsqueeze(2))
    rotation = (camera_axes.unsqueeze(2) * world_axes.unsqueeze(1)).sum(0)
    translation = (camera - (rotation * points[:, None, :, None]).sum(2)).mean(0)
    valid = valid & rotation.isfinite().all(0).all(0) & translation.isfinite().all(0)
    rotation, translation = (torch.where(valid, pose, torch.nan) for pose in (rotation, translation))
    dtype = points3d.dtype
    return P3P(
        rotation.movedim((0, 1, 2), (-2, -1, -3)).to(dtype),
        translation.movedim((0, 1), (-1, -2)).to(dtype),
        valid.movedim(0, -1),
    )


def poses_of_triples(rays: Float[Tensor, "b h 3 3"], points3d: Float[Tensor, "b h 3 3"]) -> Float[Tensor, "b s 3 4"]:
    """Poses [R | t] of all triples of a sample in s = 2 h + 2 slots, those without a pose NaN and last.

    A triple has fewer than two solutions on average. Solutions beyond the s-th are dropped.
    """
    solution = p3p(rays, points3d)
    poses = torch.cat([solution.rotation, solution.translation.unsqueeze(-1)], -1).flatten(1, 2)
    filled = solution.valid.flatten(1).byte().argsort(dim=1, descending=True, stable=True)
    return take(poses, filled[:, : 2 * points3d.shape[1] + 2])


def _sides2(points: Tensor) -> Tensor:
    """|p_0 - p_1|^2, |p_1 - p_2|^2, |p_2 - p_0|^2."""
    return (points - points.roll(-1, 0)).square().sum(1)


def _frame(points: Tensor) -> Tensor:
    """Orthonormal axes fixed to a triangle: the longest side, its perpendicular, the normal. NaN if flat."""
    along, across = points[1] - points[2], points[0] - points[2]
    along = along * along.square().sum(0).rsqrt()
    normal = torch.linalg.cross(along, across, dim=0)
    height2 = normal.square().sum(0)
    normal = normal * torch.where(height2 > 1e-24 * across.square().sum(0), height2, torch.nan).rsqrt()
    return torch.stack([along, torch.linalg.cross(normal, along, dim=0), normal])


def _ratios(cosines: Tensor, lengths2: Tensor) -> tuple[Tensor, Tensor]:
    """All (x, y) = (d_0/d_2, d_1/d_2), four slots each; NaN where a line misses the conics."""
    m01, m12, m02 = cosines
    a, one, b = lengths2
    zero = torch.zeros_like(a)
    conic1 = torch.stack([one, -m01, zero, 1 - a, a * m12, -a])
    conic2 = torch.stack([one, zero, -m02, -b, b * m12, 1 - b])
    adjugate1, adjugate2 = _adjugate(conic1), _adjugate(conic2)
    constant, leading = _trace(adjugate1, conic1) / 3, _trace(adjugate2, conic2) / 3
    cubic = torch.stack([leading, _trace(adjugate2, conic1), _trace(adjugate1, conic2), constant])
    # The larger determinant leads, so that no root runs to infinity.
    swap = constant.abs() > leading.abs()
    root = _real_root(torch.where(swap, cubic.flip(0), cubic))
    pair = torch.where(swap, root, 1) * conic1 + torch.where(swap, 1, root) * conic2
    return _meet(_split(pair), conic1, conic2)


def _adjugate(symmetric: Tensor) -> Tensor:
    xx, xy, xw, yy, yw, ww = symmetric
    return torch.stack(
        [
            yy * ww - yw * yw,
            xw * yw - xy * ww,
            xy * yw - xw * yy,
            xx * ww - xw * xw,
            xy * xw - xx * yw,
            xx * yy - xy * xy,
        ]
    )


def _trace(a: Tensor, b: Tensor) -> Tensor:
    """tr(A B) of symmetric matrices."""
    xx, xy, xw, yy, yw, ww = a * b
    return xx + yy + ww + 2 * (xy + xw + yw)


def _real_root(cubic: Tensor) -> Tensor:
    """The real root of c_0 s^3 + c_1 s^2 + c_2 s + c_3 that lies farthest from the other two, so the best determined.

    Cardano for t^3 - 3 p t - 2 q with s = t - c_1/3c_0, by the cosine where all roots are real; then Newton steps.
    """
    b, c, d = cubic[1:] / cubic[0]
    p = b * b / 9 - c / 3
    q = b * c / 6 - d / 2 - b * b * b / 27
    size = q.abs()
    discriminant = q * q - p * p * p
    outer = (size + discriminant.clamp(min=0).sqrt()).pow(1 / 3)
    single = outer + torch.where(outer > 0, p / outer, 0)
    radius = p.clamp(min=0).sqrt()
    triple = 2 * radius * torch.cos(torch.acos((size / (radius * radius * radius)).clamp(max=1)) / 3)
    root = torch.where(discriminant > 0, single, triple).copysign(q) - b / 3
    for _ in range(2):
        step = (((root + b) * root + c) * root + d) / ((3 * root + 2 * b) * root + c)
        root = torch.where(step.isfinite(), root - step, root)
    return root


def _split(pair: Tensor) -> Tensor:
    """The two lines (2, 3, ...) of a degenerate conic D: D + [p]x has rank one, p where they meet. NaN if not real."""
    minors = -_adjugate(pair)
    xx, xy, xw, yy, yw, ww = minors
    largest = torch.stack([xx, yy, ww]).argmax(0, keepdim=True)
    columns = torch.stack([xx, xy, xw, xy, yy, yw, xw, yw, ww]).unflatten(0, (3, 3))
    column = columns.gather(0, largest.expand(columns.shape[1:]).unsqueeze(0)).squeeze(0)
    x, y, w = column / column.gather(0, largest).clamp(min=0).sqrt()
    xx, xy, xw, yy, yw, ww = pair
    product = torch.stack([xx, xy - w, xw + y, xy + w, yy, yw - x, xw - y, yw + x, ww])
    peak = product.abs().argmax(0, keepdim=True)
    product = product.unflatten(0, (3, 3))
    row = product.gather(0, (peak // 3).expand(product.shape[1:]).unsqueeze(0)).squeeze(0)
    col = product.gather(1, (peak % 3).expand(product.shape[1:])[:, None]).squeeze(1)
    return torch.stack([row, col])


def _meet(lines: Tensor, conic1: Tensor, conic2: Tensor) -> tuple[Tensor, Tensor]:
    """(x, y) of the points where the lines a x + b y + c = 0 (2, 3, ...) meet the conics, four slots (4, ...)."""
    a, b, c = lines.unbind(1)
    size = (a * a + b * b).sqrt()
    a, b, c = a / size, b / size, c / size
    # The points of a line are (-a c, -b c) + u (b, -a).
    along, foot = torch.stack([b, -a, torch.zeros_like(c)]), torch.stack([-a * c, -b * c, torch.ones_like(c)])
    first, second = (
        torch.stack([_form(conic, along, along), _form(conic, along, foot), _form(conic, foot, foot)])
        for conic in (conic1, conic2)
    )
    # Both conics have the same points on the line; the one of smaller coefficients is less accurate.
    u = _quadratic_roots(torch.where(first.abs().amax(0) > second.abs().amax(0), first, second))
    return (u * along[0] + foot[0]).flatten(0, 1), (u * along[1] + foot[1]).flatten(0, 1)


def _form(conic: Tensor, p: Tensor, q: Tensor) -> Tensor:
    """p^T C q."""
    xx, xy, xw, yy, yw, ww = conic
    mixed = xy * (p[0] * q[1] + p[1] * q[0]) + xw * (p[0] * q[2] + p[2] * q[0]) + yw * (p[1] * q[2] + p[2] * q[1])
    return xx * p[0] * q[0] + yy * p[1] * q[1] + ww * p[2] * q[2] + mixed


def _quadratic_roots(coefficients: Tensor) -> Tensor:
    """Both roots of a u^2 + 2 b u + c; a discriminant that rounding made slightly negative counts as zero."""
    a, b, c = coefficients
    discriminant = b * b - a * c
    slack = 1e-12 * (b * b + (a * c).abs())
    larger = -(b + torch.where(discriminant > -slack, discriminant.clamp(min=0), torch.nan).sqrt().copysign(b))
    return torch.stack([larger / a, c / larger])


def _residuals(depths: Tensor, chords2: Tensor, lengths2: Tensor) -> Tensor:
    """|d_i f_i - d_j f_j|^2 - |p_i - p_j|^2 for each pair, by the chord |f_i - f_j|: exact for rays close together."""
    other = depths.roll(-1, 0)
    return (depths - other).square() + depths * other * chords2 - lengths2


def _newton_step(depths: Tensor, chords2: Tensor, lengths2: Tensor) -> Tensor:
    """One Newton step on the three equations, taken where it lowers the largest residual."""
    residual, other = _residuals(depths, chords2, lengths2), depths.roll(-1, 0)
    # Row i of the Jacobian holds a_i at depth i and b_i at the next one; Cramer's rule, cyclic in i.
    a, b = 2 * (depths - other) + other * chords2, 2 * (other - depths) + depths * chords2
    a2, residual1 = a.roll(-2, 0), residual.roll(-1, 0)
    step = a2 * (residual * a.roll(-1, 0) - b * residual1) + b * b.roll(-1, 0) * residual.roll(-2, 0)
    moved = depths - step / (a.prod(0) + b.prod(0))
    better = _residuals(moved, chords2, lengths2).abs().amax(0) < residual.abs().amax(0)
    return torch.where(better, moved, depths)
