"""One-to-one matches of few points under a pose, their evidence, and a step of the pose on them: all compiled.

Poses are (4, 3): R, and t below it. A function takes the records it reads and no others: each field is an argument of
the compiled code, and costs time to compile.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from bpnp.loops.vectors import rotated, turn
from bpnp.search.enumeration.points import Array, Heading, ImageArrays, Places, PriorArrays, SceneArrays
from bpnp.search.enumeration.settings import RULES
from bpnp.search.kernels.dense import solve_normal_equations
from bpnp.search.propose.minimal_solvers import part


class EnumerationTables(NamedTuple):
    """What the compiled loops read. heading: where two matches fix a pose. fixing: matches that fix a pose, which its
    freedom takes up. density: chance that one scene point lies within one radius of an image point that is anywhere."""

    scene: SceneArrays
    image: ImageArrays
    prior: PriorArrays
    heading: Heading
    fixing: int
    density: float


class Matches(NamedTuple):
    """point: (m,) each image point's scene point or -1. distance2: (m,) squared, in radii."""

    point: Places
    distance2: Array


@part
def sight(pose: Any, scene: Any, j: int) -> tuple[float, float, float]:
    """Where point j is seen on the plane, and the cosine of its normal to the line of sight (1 without normals)."""
    points, normals = scene.points, scene.normals
    x, y, z = rotated(pose, points[j, 0], points[j, 1], points[j, 2])
    cx, cy, cz = x + pose[3, 0], y + pose[3, 1], z + pose[3, 2]
    length = math.sqrt(cx * cx + cy * cy + cz * cz)
    cosine = 1.0
    if len(normals):
        nx, ny, nz = rotated(pose, normals[j, 0], normals[j, 1], normals[j, 2])
        cosine = -(nx * cx + ny * cy + nz * cz) / length
    scale = 1 / (length + cz)
    return cx * scale, cy * scale, cosine


@part
def fits(label: int, other: int) -> bool:
    return label < 0 or other < 0 or label == other


@part
def cell_of(u: float, v: float, grid: Any) -> Any:
    """The cell of the grid with (u, v), -1 outside."""
    a, b = (u - grid.low_u) * grid.per_cell, (v - grid.low_v) * grid.per_cell
    return np.int64(a) * RULES.cells + np.int64(b) if a >= 0 and b >= 0 and a < RULES.cells and b < RULES.cells else -1


@part
def nearest(u: float, v: float, cell: int, label: int, reach2: float, grid: Any) -> tuple[int, float]:
    """The image point nearest to (u, v) whose label fits, -1 for none within the root of reach2, and squared radii."""
    flat, gain, place = grid.flat, grid.gain, -1
    if cell >= 0:
        for item in range(grid.starts[cell], grid.starts[cell + 1]):
            i = grid.items[item]
            if fits(label, grid.labels[i]):
                d2 = gain[i] * gain[i] * ((u - flat[i, 0]) ** 2 + (v - flat[i, 1]) ** 2)
                if d2 < reach2:
                    place, reach2 = i, d2
    return place, reach2


@part
def match(pose: Any, reach: float, scene: Any, grid: Any, matches: Any) -> tuple[int, int, int]:
    """Fill `matches` with each image point's nearest scene point among those that have it as their nearest, within
    `reach` radii. Returns how many there are, the points that can be seen among the image points, and those expected
    to be seen."""
    for i in range(len(matches.point)):
        matches.point[i], matches.distance2[i] = -1, reach * reach
    visible = expected = count = 0
    for j in range(len(scene.points)):
        u, v, cosine = sight(pose, scene, j)
        if cosine < RULES.matched_cosine:
            continue
        cell = cell_of(u, v, grid)
        visible += cell >= 0
        expected += len(scene.normals) > 0 and cosine > RULES.expected_cosine
        i, d2 = nearest(u, v, cell, scene.labels[j], reach * reach, grid)
        if i >= 0 and d2 < matches.distance2[i]:
            count += matches.point[i] < 0
            matches.point[i], matches.distance2[i] = j, d2
    return count, visible, expected


@part
def evidence(count: int, visible: int, expected: int, matches: Any, fixing: int, density: float) -> tuple[float, float]:
    """Nats by which the matches exceed chance, less those of expected points that are missing; and the radius, of the
    ladder, at which they do: -log of C(m - f, k - f) p^(k - f), p the chance of one match, f those that fix a pose."""
    best, radius, radius2 = -math.inf, 1.0, 1.0
    for _ in range(RULES.ladder):
        k = 0
        for i in range(len(matches.point)):
            k += matches.point[i] >= 0 and matches.distance2[i] <= radius2
        chance = min(0.5, (visible if visible > 1 else 1) * density * radius2)
        value = -(k - fixing) * math.log(chance) - _log_choose(len(matches.point) - fixing, k - fixing)
        if value > best:
            best, radius = value, math.sqrt(radius2)
        radius2 *= 0.25
    return best - RULES.missed * (expected - count if expected > count else 0), radius


@part
def _log_choose(n: int, k: int) -> float:
    return math.lgamma(n + 1.0) - math.lgamma(k + 1.0) - math.lgamma(n - k + 1.0) if 0 <= k <= n else 0.0


@part
def step(pose: Any, matched: Any, problem: Any, system: Any) -> bool:
    """One Gauss-Newton step, in place, on sum_i w_i^2 |f_i - g(R p + t)|^2 over the matches (m,) and what is known of
    directions; False if it has none. g(y) = y/|y|, w_i one over a radius. The step is y -> y + w x Rp + s."""
    rays, per_radian, points = problem.image.rays, problem.image.per_radian, problem.scene.points
    in_scene, in_camera, weight = problem.prior.in_scene, problem.prior.in_camera, problem.prior.weight
    for a in range(7):
        for b in range(6):
            system[a, b] = 0.0
    row = system[7]
    for i in range(len(matched) + len(in_scene)):
        k = i - len(matched)  # of the prior, whose directions have no translation: the step s moves none of them
        ux = uy = uz = shift = 0.0
        if k >= 0:
            x, y, z = rotated(pose, in_scene[k, 0], in_scene[k, 1], in_scene[k, 2])
            turned = w = weight
            rx, ry, rz = in_camera[k, 0] - x, in_camera[k, 1] - y, in_camera[k, 2] - z
        elif matched[i] >= 0:
            j = matched[i]
            x, y, z = rotated(pose, points[j, 0], points[j, 1], points[j, 2])
            ux, uy, uz = x + pose[3, 0], y + pose[3, 1], z + pose[3, 2]
            inverse = 1 / math.sqrt(ux * ux + uy * uy + uz * uz)
            ux, uy, uz = ux * inverse, uy * inverse, uz * inverse
            along = rays[i, 0] * ux + rays[i, 1] * uy + rays[i, 2] * uz
            turned = shift = per_radian * inverse
            w = per_radian / (along if along > 0.1 else 0.1)
            rx, ry, rz = rays[i, 0] - along * ux, rays[i, 1] - along * uy, rays[i, 2] - along * uz
        else:
            continue
        for axis in range(3):  # of the camera, its part across the direction u
            part_of_u = ux if axis == 0 else uy if axis == 1 else uz
            ex, ey, ez = (axis == 0) - part_of_u * ux, (axis == 1) - part_of_u * uy, (axis == 2) - part_of_u * uz
            residual = w * (rx if axis == 0 else ry if axis == 1 else rz)
            row[0], row[1], row[2] = turned * (y * ez - z * ey), turned * (z * ex - x * ez), turned * (x * ey - y * ex)
            row[3], row[4], row[5] = shift * ex, shift * ey, shift * ez
            for a in range(6):
                system[6, a] += row[a] * residual
                for b in range(a + 1):
                    system[a, b] += row[a] * row[b]
    for k in range(6):
        system[k, k] *= 1 + 1e-9
    if not solve_normal_equations(system):
        return False
    total = 0.0
    for k in range(6):
        total += row[k]
    if not math.isfinite(total):
        return False
    turn(pose, row)
    for k in range(3):
        pose[3, k] += row[3 + k]
    return True
