"""What a prior says of a pose, as the compiled loops read it."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bpnp.search.few.arrays import ImageArrays, SceneArrays
from bpnp.search.point_sets import PointSets
from bpnp.search.starts import GravityPrior, PosePrior, Prior, turned_to

Array = NDArray[np.float64]
SIGMAS = 4.0  # of a prior, beyond which no pose is looked for
WEIGHT = 0.1  # radii that one standard deviation of a prior weighs as much as: noise is a tenth to a third of a radius


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
