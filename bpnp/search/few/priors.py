"""What a prior says of a pose, and where it lets two pairs fix one: the solvers, and every hypothesis of a block."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bpnp.search.few.arrays import ImageArrays, SceneArrays
from bpnp.search.few.enumeration import faces, fits, witnessed
from bpnp.search.few.kept import allowed, consider, copy
from bpnp.search.few.matching import compiled, part, turned
from bpnp.search.point_sets import PointSets
from bpnp.search.starts import GravityPrior, PosePrior, Prior, turned_to

Array = NDArray[np.float64]
SIGMAS = 4.0  # of a prior, beyond which no pose is looked for
WEIGHT = 0.1  # radii that one standard deviation of a prior weighs as much as: noise is a tenth to a third of a radius

LEVEL = 1e-6  # sine of both rays' height, below which a known vertical says nothing about their depths
UPRIGHT = 1e-3  # horizontal part of the way between two points, below which it says nothing about the heading


@dataclass(frozen=True, eq=False)
class Knowledge:
    """A prior in the frames of the arrays.

    directions: (k, 8) rows a, b, weight and largest squared distance of R a from b. place: (4,) the translation and the
    largest squared distance from it. turned: (11,) the known rotation by rows, the largest turn from it, radians, and
    the noise of the rays. upright: rays, points and the rotations from and to frames whose z axis is the vertical; its
    rays are empty where it is not known. pairs: how many pairs fix a pose. log_share: log of the share of all poses
    that the prior allows.
    """

    directions: Array
    place: Array
    turned: Array
    upright: tuple[Array, Array, Array, Array]
    pairs: int
    log_share: float


def predicted_pose(prior: Prior | None) -> tuple[Array, Array] | None:
    """Rotation and translation, if the prior tells both."""
    if not isinstance(prior, PosePrior) or prior.translation is None or not math.isfinite(prior.translation_sigma):
        return None
    return np.asarray(prior.rotation, np.float64), np.asarray(prior.translation, np.float64)


def knowledge_of(sets: PointSets, scene: SceneArrays, image: ImageArrays) -> Knowledge:
    """The prior, around the centre of the scene and in its unit, and in the frame of the image's rays."""
    prior = sets.prior
    directions, place, turned = np.empty((0, 8)), np.array([0, 0, 0, math.inf]), np.zeros(11)
    upright = np.empty((0, 3)), np.empty((0, 3)), np.eye(3), np.eye(3)
    if isinstance(prior, GravityPrior):
        camera, up = (np.asarray(v, np.float64) / np.linalg.norm(v) for v in (prior.up_camera, prior.up_scene))
        camera = image.turn @ camera
        sigma = math.radians(prior.sigma_deg)
        directions = _rows(up[None], camera[None], sigma)
        from_camera, from_scene = turned_to(camera), turned_to(up)
        rays, points = image.rays[:, :3] @ from_camera.T, scene.arrays[0] @ from_scene.T
        upright = np.ascontiguousarray(rays), np.ascontiguousarray(points), from_camera.T.copy(), from_scene
        return Knowledge(directions, place, turned, upright, 2, 0.0)
    if not isinstance(prior, PosePrior):
        return Knowledge(directions, place, turned, upright, 3, 0.0)
    known, sigma = np.asarray(prior.rotation, np.float64), math.radians(prior.rotation_sigma_deg)
    rotation = image.turn @ known
    directions = _rows(np.eye(3), rotation.T, math.sqrt(2) * sigma)
    turned = np.concatenate([rotation.ravel(), [min(SIGMAS * sigma, 1.0), float((1 / image.rays[:, 3]).mean()) / 3]])
    if (predicted := predicted_pose(prior)) is not None:
        middle = image.turn @ (known @ scene.centre + predicted[1])
        place = np.append(middle, (SIGMAS * prior.translation_sigma) ** 2) / [*[scene.size] * 3, scene.size**2]
    allowed = min(SIGMAS * sigma, math.pi)
    log_share = math.log((allowed - math.sin(allowed)) / math.pi)
    return Knowledge(
        directions, place, turned, upright, sets.pairs_that_fix, log_share
    )  # fmt: skip


def _rows(scene: Array, camera: Array, sigma: float) -> Array:
    """Directions (k, 3) of the scene that are seen as those of the camera, with `sigma` radians."""
    weight = np.full((len(scene), 1), WEIGHT / sigma)
    furthest = np.full((len(scene), 1), (2 * math.sin(min(SIGMAS * sigma, math.pi) / 2)) ** 2)
    return np.ascontiguousarray(np.concatenate([scene, camera, weight, furthest], 1))


@part
def p2p_upright(f: Any, g: Any, p: Any, q: Any, poses: Any) -> int:
    """Poses (2, 12) of two pairs with the vertical along z in both frames: R turns about z; how many there are.

    f, g: (3,) unit rays. p, q: (3,) points. With d g - c f = R (q - p), its z component is linear in the depths c and
    d, and the length of its horizontal part quadratic (Kukelova, Bujnak, Pajdla: Closed-form solutions to minimal
    absolute pose problems with known vertical direction, ACCV 2010).
    """
    if max(abs(f[2]), abs(g[2])) < LEVEL:
        return 0
    rise, along0, along1 = q[2] - p[2], q[0] - p[0], q[1] - p[1]
    length2 = along0 * along0 + along1 * along1
    if length2 < UPRIGHT * UPRIGHT * (length2 + rise * rise):
        return 0
    # The depth x of the ray with the smaller z is free; the other depth is shift + slope x.
    swap = abs(f[2]) > abs(g[2])
    slope = g[2] / f[2] if swap else f[2] / g[2]
    shift = -rise / f[2] if swap else rise / g[2]
    if swap:  # d = x, c = shift + slope x
        u0, u1, v0, v1 = -shift * f[0], -shift * f[1], g[0] - slope * f[0], g[1] - slope * f[1]
    else:  # c = x, d = shift + slope x
        u0, u1, v0, v1 = shift * g[0], shift * g[1], slope * g[0] - f[0], slope * g[1] - f[1]
    a, h, k = v0 * v0 + v1 * v1, u0 * v0 + u1 * v1, u0 * u0 + u1 * u1 - length2
    discriminant = h * h - a * k
    if not (discriminant >= 0 and a > 0):
        return 0
    count = 0
    larger = -(h + math.copysign(math.sqrt(discriminant), h))
    for root in range(2):
        x = k / larger if root else larger / a
        other = shift + slope * x
        c, d = (other, x) if swap else (x, other)
        if not (0 < c < math.inf and 0 < d < math.inf):
            continue
        way0, way1 = d * g[0] - c * f[0], d * g[1] - c * f[1]
        cosine, sine = (along0 * way0 + along1 * way1) / length2, (along0 * way1 - along1 * way0) / length2
        size = 1 / math.sqrt(cosine * cosine + sine * sine)
        cosine, sine = cosine * size, sine * size
        pose = poses[count]
        pose[:9] = 0.0
        pose[0], pose[1], pose[3], pose[4], pose[8] = cosine, -sine, sine, cosine, 1.0
        pose[9] = c * f[0] - (cosine * p[0] - sine * p[1])
        pose[10] = c * f[1] - (sine * p[0] + cosine * p[1])
        pose[11] = c * f[2] - p[2]
        count += 1
    return count


@part
def p2p_turned(f: Any, g: Any, p: Any, q: Any, known: Any, most: float, noise: float, pose: Any) -> bool:
    """The pose (12,) of two pairs whose rotation is the least turn away from the known one (9,), by rows.

    f, g: (3,) unit rays. p, q: (3,) points. R (q - p) has to lie in the plane of the rays; the turn that brings it
    there is at most `most` radians, plus what `noise` radians of the rays may turn their plane. False if there is none.
    """
    n0, n1, n2 = f[1] * g[2] - f[2] * g[1], f[2] * g[0] - f[0] * g[2], f[0] * g[1] - f[1] * g[0]
    sine = math.sqrt(n0 * n0 + n1 * n1 + n2 * n2)
    if not sine > 2 * noise:
        return False
    n0, n1, n2 = n0 / sine, n1 / sine, n2 / sine
    w0, w1, w2 = turned(known, q[0] - p[0], q[1] - p[1], q[2] - p[2])
    length = math.sqrt(w0 * w0 + w1 * w1 + w2 * w2)
    off = (n0 * w0 + n1 * w1 + n2 * w2) / length
    if not abs(off) < math.sin(min(most + 2 * noise / sine, 1.5)):
        return False
    # Its projection v into the plane, of the same length; the turn from w to v is about their cross product.
    v0, v1, v2 = w0 - off * length * n0, w1 - off * length * n1, w2 - off * length * n2
    cosine = math.sqrt(1 - off * off)
    v0, v1, v2 = v0 / cosine, v1 / cosine, v2 / cosine
    # d g - c f = v: the cross products of v with the rays, along the normal, over that of the rays.
    c = (n0 * (v1 * g[2] - v2 * g[1]) + n1 * (v2 * g[0] - v0 * g[2]) + n2 * (v0 * g[1] - v1 * g[0])) / -sine
    d = (n0 * (v1 * f[2] - v2 * f[1]) + n1 * (v2 * f[0] - v0 * f[2]) + n2 * (v0 * f[1] - v1 * f[0])) / -sine
    if not (0 < c < math.inf and 0 < d < math.inf):
        return False
    axis0, axis1, axis2 = (w1 * v2 - w2 * v1), (w2 * v0 - w0 * v2), (w0 * v1 - w1 * v0)
    axis0, axis1, axis2 = axis0 / (length * length), axis1 / (length * length), axis2 / (length * length)
    bend = 1 / (1 + cosine)
    for k in range(3):
        r0, r1, r2 = known[k], known[3 + k], known[6 + k]
        a0, a1, a2 = axis1 * r2 - axis2 * r1, axis2 * r0 - axis0 * r2, axis0 * r1 - axis1 * r0
        pose[k] = r0 + a0 + bend * (axis1 * a2 - axis2 * a1)
        pose[3 + k] = r1 + a1 + bend * (axis2 * a0 - axis0 * a2)
        pose[6 + k] = r2 + a2 + bend * (axis0 * a1 - axis1 * a0)
    x, y, z = turned(pose, p[0], p[1], p[2])
    pose[9], pose[10], pose[11] = c * f[0] - x, c * f[1] - y, c * f[2] - z
    return True


@compiled
def sweep_pairs(
    first: int, last: int, old_image: int, old_scene: int, new_scene: int, stop: float, budget: int, rays: Any,
    pairs2d: Any, pairs3d: Any, upright: Any, known: Any, witnesses: Any, need: int, reach: float, scene: Any,
    image: Any, used: int, density: float, prior: Any, found: Any, work: Any,
) -> tuple[int, int]:  # fmt: skip
    """As `enumeration.sweep`, but image pairs (s, 2), in both orders, against scene pairs (t, 2).

    upright: the rays, the points, and two rotations of frames whose z axis is the vertical, if it is known (its rays
    are empty otherwise). known: (11,), the rotation by rows, the largest turn from it and the rays' noise, radians.
    """
    tall_rays, tall_points, from_tall, to_tall = upright
    labels2d, labels3d, points, pose = image[2], scene[2], scene[0], work[2]
    poses = work[6]
    solved, place, best = 0, first, found[5]
    while place < last and solved < budget and found[1][best[0]] < stop:
        for turn in range(2):
            i, j = pairs2d[place, turn], pairs2d[place, 1 - turn]
            for t in range(old_scene if place < old_image else 0, new_scene):
                a, b = pairs3d[t, 0], pairs3d[t, 1]
                if not (fits(labels2d[i], labels3d[a]) and fits(labels2d[j], labels3d[b])):
                    continue
                solved += 1
                if len(tall_rays):
                    count = p2p_upright(tall_rays[i], tall_rays[j], tall_points[a], tall_points[b], poses)
                else:
                    count = int(
                        p2p_turned(rays[i], rays[j], points[a], points[b], known, known[9], known[10], poses[0])
                    )
                for s in range(count):
                    if len(tall_rays):
                        _changed(poses[s], from_tall, to_tall, pose)
                    else:
                        copy(poses[s], pose)
                    if not (faces(pose, scene, rays, a, i, b, j) and allowed(pose, prior, work[7])):
                        continue
                    if witnessed(pose, a, b, b, i, j, j, witnesses, need, reach, scene, image):
                        consider(pose, reach, rays, scene, image, used, density, prior, found, work)
        place += 1
    return place, solved


@part
def _changed(tall: Any, from_tall: Any, to_tall: Any, pose: Any) -> None:
    """The pose A R B, A t of a pose (R, t) between frames that stand upright."""
    for r in range(3):
        for c in range(3):
            total = 0.0
            for k in range(3):
                for x in range(3):
                    total += from_tall[r, k] * tall[3 * k + x] * to_tall[x, c]
            pose[3 * r + c] = total
        pose[9 + r] = from_tall[r, 0] * tall[9] + from_tall[r, 1] * tall[10] + from_tall[r, 2] * tall[11]
