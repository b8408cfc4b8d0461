"""What a prior says of a pose, and where it lets two matches fix one: the minimal solver."""

import math
from typing import Any

import numpy as np

from bpnp.search.enumeration.matching import PosePriorArrays
from bpnp.search.enumeration.p3p import part
from bpnp.search.enumeration.points import Array, ImageSide, SceneSide
from bpnp.search.enumeration.settings import EnumerationSettings
from bpnp.search.kernels.vectors import cross, rotated
from bpnp.search.point_sets import PointSets
from bpnp.search.starts import GravityPrior, PosePrior, Prior, turned_to

LEVEL = 1e-6  # sine of both rays' height, below which a known vertical says nothing about their depths
UPRIGHT = 1e-3  # horizontal part of the way between two points, below which it says nothing about the heading


def predicted_pose(prior: Prior | None) -> tuple[Array, Array] | None:
    """Rotation and translation, if the prior tells both."""
    if not isinstance(prior, PosePrior) or prior.translation is None or not math.isfinite(prior.translation_sigma):
        return None
    return np.asarray(prior.rotation, np.float64), np.asarray(prior.translation, np.float64)


def prior_arrays(
    sets: PointSets, scene: SceneSide, image: ImageSide, settings: EnumerationSettings
) -> tuple[PosePriorArrays, float]:
    """The prior in the frames of both sides, and the log of the share of all poses that it allows.

    Where two matches fix a pose, a direction is taken as known: the vertical, or that of the view, about which the
    image shows a turn best.
    """
    prior, place, log_share = sets.prior, np.array([0, 0, 0, math.inf]), 0.0
    none, sine2 = np.empty((0, 3)), 1.0
    if prior is None:
        return PosePriorArrays(np.empty((0, 8)), place, none, none, np.zeros((3, 3, 3)), sine2), log_share
    if isinstance(prior, GravityPrior):
        camera, up = (np.asarray(v, np.float64) / np.linalg.norm(v) for v in (prior.up_camera, prior.up_scene))
        directions = _rows(up[None], (image.turn @ camera)[None], math.radians(prior.sigma_deg), settings)
        from_camera, from_scene = turned_to(image.turn @ camera), turned_to(up)
    else:
        known, sigma = np.asarray(prior.rotation, np.float64), math.radians(prior.rotation_sigma_deg)
        rotation = image.turn @ known
        from_camera, from_scene = np.eye(3), rotation
        directions = _rows(np.eye(3), rotation.T, math.sqrt(2) * sigma, settings)
        if (predicted := predicted_pose(prior)) is not None:
            middle = image.turn @ (known @ scene.centre + predicted[1]) / scene.size
            place = np.append(middle, (settings.sigmas * prior.translation_sigma / scene.size) ** 2)
        most = min(settings.sigmas * sigma, math.pi)
        log_share, sine2 = math.log((most - math.sin(most)) / math.pi), math.sin(min(most, math.pi / 2)) ** 2
    about = np.array([np.diag([0.0, 0, 1]), np.diag([1.0, 1, 0]), [[0, -1, 0], [1, 0, 0], [0, 0, 0]]])
    rays = np.ascontiguousarray(image.arrays.rays[:, :3] @ from_camera.T)
    points = np.ascontiguousarray(scene.arrays.points @ from_scene.T)
    return PosePriorArrays(directions, place, rays, points, from_camera.T @ about @ from_scene, sine2), log_share


def _rows(scene: Array, camera: Array, sigma: float, settings: EnumerationSettings) -> Array:
    """Directions (k, 3) of the scene that are seen as those of the camera, with `sigma` radians."""
    weight = np.full((len(scene), 1), settings.prior_weight / sigma)
    farthest = np.full((len(scene), 1), (2 * math.sin(min(settings.sigmas * sigma, math.pi) / 2)) ** 2)
    return np.ascontiguousarray(np.concatenate([scene, camera, weight, farthest], 1))


@part
def p2p(i: int, j: int, a: int, b: int, problem: Any, poses: Any) -> int:
    """Fill `poses` with those under which points a and b are seen along the rays i and j, a direction being known; how
    many there are, up to two.

    f, g: the rays, p, q: the points, in frames whose z axis is the direction. With d g - c f = R (q - p), its z
    component is linear in the depths c and d, and the length of its horizontal part quadratic (Kukelova, Bujnak,
    Pajdla: Closed-form solutions to minimal absolute pose problems with known vertical direction, ACCV 2010).
    """
    prior, points, rays = problem.prior, problem.scene.points, problem.image.rays
    f, g, p, q = prior.rays[i], prior.rays[j], prior.points[a], prior.points[b]
    if max(abs(f[2]), abs(g[2])) < LEVEL:
        return 0
    rise, along0, along1 = q[2] - p[2], q[0] - p[0], q[1] - p[1]
    length2 = along0 * along0 + along1 * along1
    if length2 < UPRIGHT * UPRIGHT * (length2 + rise * rise):
        return 0
    # The way R (q - p) lies in the plane of the rays: a turn of the known rotation has to bring it there.
    n0, n1, n2 = cross(f[0], f[1], f[2], g[0], g[1], g[2])
    volume = n0 * along0 + n1 * along1 + n2 * rise
    if volume * volume > prior.sine2 * (n0 * n0 + n1 * n1 + n2 * n2) * (length2 + rise * rise):
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
        cosine, sine, turns, pose = cosine * size, sine * size, prior.turns, poses[count]
        for r in range(3):
            for s in range(3):
                pose[r, s] = turns[0, r, s] + cosine * turns[1, r, s] + sine * turns[2, r, s]
        turned = rotated(pose, points[a, 0], points[a, 1], points[a, 2])
        for r in range(3):
            pose[3, r] = c * rays[i, r] - turned[r]
        count += 1
    return count
