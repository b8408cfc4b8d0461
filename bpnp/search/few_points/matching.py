"""One-to-one matches of few points under a pose, their evidence, and a step of the pose on them: all compiled.

Poses are (4, 3): R, and t below it. Functions take only the records that they read: each field is an argument of the
compiled code and costs time to compile.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from bpnp.arrays import Array, Indices
from bpnp.search.few_points.points import IMAGE_CELLS, Grid, Heading, ImageArrays, PriorArrays, SceneArrays
from bpnp.search.kernels.dense import solve_normal_equations
from bpnp.search.kernels.vectors import rotated, turn
from bpnp.search.propose.minimal_solvers import part

MATCHED_COSINE = math.cos(math.radians(87.0))  # least cosine, normal to line of sight, of a match [1; calibration]
EXPECTED_COSINE = math.cos(math.radians(72.0))  # least such cosine of a point expected to be seen [1; calibration]
TESTED_RADII = 5  # number of radii 1, 1/2, 1/4 ... at which matches are counted [radii; calibration]
MISSED_NATS = 1.5  # nats subtracted for each expected but missing point; one in five is missed [nats; calibration]


class EnumerationTables(NamedTuple):
    """Inputs of the compiled loops."""

    scene: SceneArrays
    image: ImageArrays
    prior: PriorArrays  # prior directions and translation
    heading: Heading  # input of P2P, where two matches fix a pose
    fixing: int  # number of matches that fix a pose; they are no evidence for it
    density: float  # probability that a scene point, seen anywhere, is within one radius of a given image point


class Matches(NamedTuple):
    """One-to-one matches of the image points."""

    point: Indices  # (m,) scene point of each image point, or -1
    distance2: Array  # (m,) squared residuals, in match radii


@part
def sight(pose: Array, scene: SceneArrays, j: int) -> tuple[float, float, float]:
    """Return both stereographic coordinates of point j, and the cosine between its normal and the line of sight.

    The cosine is 1 without normals.
    """
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
    """Return whether two labels are compatible; -1 fits any."""
    return label < 0 or other < 0 or label == other


@part
def cell_of(u: float, v: float, grid: Grid) -> Any:
    """Return the cell of the grid that contains (u, v), or -1 outside."""
    a, b = (u - grid.low_u) * grid.per_cell, (v - grid.low_v) * grid.per_cell
    return np.int64(a) * IMAGE_CELLS + np.int64(b) if a >= 0 and b >= 0 and a < IMAGE_CELLS and b < IMAGE_CELLS else -1


@part
def nearest(u: float, v: float, cell: int, label: int, reach2: float, grid: Grid) -> tuple[int, float]:
    """Return the nearest image point with a fitting label, and its squared distance in radii.

    The index is -1 if there is none within the square root of `reach2`.
    """
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
def match(pose: Array, reach: float, scene: SceneArrays, grid: Grid, matches: Matches) -> tuple[int, int, int]:
    """Match image and scene points one-to-one within `reach` match radii under a pose (4, 3).

    A scene point proposes its nearest image point, and an image point accepts the nearest proposal. Return the numbers
    of matches, of scene points that fall in the grid, and of scene points expected to be seen.
    """
    for i in range(len(matches.point)):
        matches.point[i], matches.distance2[i] = -1, reach * reach
    visible = expected = count = 0
    for j in range(len(scene.points)):
        u, v, cosine = sight(pose, scene, j)
        if cosine < MATCHED_COSINE:
            continue
        cell = cell_of(u, v, grid)
        visible += cell >= 0
        expected += len(scene.normals) > 0 and cosine > EXPECTED_COSINE
        i, d2 = nearest(u, v, cell, scene.labels[j], reach * reach, grid)
        if i >= 0 and d2 < matches.distance2[i]:
            count += matches.point[i] < 0
            matches.point[i], matches.distance2[i] = j, d2
    return count, visible, expected


@part
def evidence(
    count: int, visible: int, expected: int, matches: Matches, fixing: int, density: float
) -> tuple[float, float]:
    """Return the largest evidence, nats, of matches at the radii 1, 1/2, 1/4 ... match radii, and its radius.

    The evidence is -log of C(m - f, k - f) p^(k - f), with p the probability of a chance match
    (`EnumerationTables.density`), m the number of visible scene points, k that of matches, f = `fixing`. Each expected
    but missing point reduces it.
    """
    best, radius, radius2 = -math.inf, 1.0, 1.0
    for _ in range(TESTED_RADII):
        k = 0
        for i in range(len(matches.point)):
            k += matches.point[i] >= 0 and matches.distance2[i] <= radius2
        chance = min(0.5, (visible if visible > 1 else 1) * density * radius2)
        value = -(k - fixing) * math.log(chance) - _log_choose(len(matches.point) - fixing, k - fixing)
        if value > best:
            best, radius = value, math.sqrt(radius2)
        radius2 *= 0.25
    return best - MISSED_NATS * (expected - count if expected > count else 0), radius


@part
def _log_choose(n: int, k: int) -> float:
    """Return log C(n, k), or 0 where it is not defined."""
    return math.lgamma(n + 1.0) - math.lgamma(k + 1.0) - math.lgamma(n - k + 1.0) if 0 <= k <= n else 0.0


@part
def step(pose: Array, matched: Indices, problem: EnumerationTables, system: Array) -> bool:
    """Take one Gauss-Newton step of a pose (4, 3), in place, on its matches and the prior directions.

    The cost is sum_i w_i^2 |f_i - g(R p + t)|^2 with g(y) = y/|y| and w_i one over a radius. The step (w, s) moves y =
    R p + t by w x Rp + s. Return False if the equations (8, 6) have no solution.
    """
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
