"""Where a search starts: poses spread over all rotations, or around what is known of the camera."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from bpnp.search.settings import Recipe

Array = NDArray[np.float32]
ALL_AROUND = 0.95  # spread of bearings above which they fill some 220 degrees or more
AIM_STEP = 0.16  # spreads of the bearings; a spiral of places with radii of so much times sqrt(k) leaves no gaps


class PosePrior(NamedTuple):
    """A rough pose, camera = R p + t, and one standard deviation of its errors.

    rotation: (3, 3). translation: (3,) in scene units, or None where only the rotation is known.
    rotation_sigma_deg: degrees about each axis. translation_sigma: scene units along each axis.

    >>> PosePrior(np.eye(3), np.array([0, 0, 6]), rotation_sigma_deg=5.0, translation_sigma=0.5).rotation_sigma_deg
    5.0
    """

    rotation: ArrayLike
    translation: ArrayLike | None
    rotation_sigma_deg: float
    translation_sigma: float = math.inf


class GravityPrior(NamedTuple):
    """The direction up, (3,) in camera and in scene coordinates, of any length; sigma_deg: its standard deviation.

    >>> GravityPrior(up_camera=np.array([0, -1, 0]), up_scene=np.array([0, 0, 1])).sigma_deg
    2.0
    """

    up_camera: ArrayLike
    up_scene: ArrayLike
    sigma_deg: float = 2.0


Prior = PosePrior | GravityPrior


def super_fibonacci(count: int) -> NDArray[np.float64]:
    """Rotations (count, 3, 3) spread evenly over SO(3): super-Fibonacci spirals (Alexa, CVPR 2022, Algorithm 1)."""
    s = np.arange(count) + 0.5
    inner, outer = np.sqrt(s / count), np.sqrt(1 - s / count)
    alpha, beta = 2 * math.pi * s / math.sqrt(2), 2 * math.pi * s / 1.533751168755204288118041
    quaternions = [inner * np.sin(alpha), inner * np.cos(alpha), outer * np.sin(beta), outer * np.cos(beta)]
    return Rotation.from_quat(np.stack(quaternions, -1)).as_matrix()


def draw_rotations(count: int, prior: Prior | None, rng: np.random.Generator) -> NDArray[np.float64]:
    """An even set over SO(3), turned at random, or rotations drawn from the prior (the first one its mean)."""
    if prior is None:
        return super_fibonacci(count) @ Rotation.from_quat(rng.standard_normal(4)).as_matrix()
    if isinstance(prior, PosePrior):
        tilt = Rotation.from_rotvec(math.radians(prior.rotation_sigma_deg) * rng.standard_normal((count, 3)))
        mean = np.asarray(prior.rotation, dtype=np.float64)
    else:
        up, scene = (np.asarray(v, dtype=np.float64) / np.linalg.norm(np.asarray(v)) for v in prior[:2])
        angles = 2 * math.pi * (np.arange(count) + rng.random()) / count
        about = Rotation.from_rotvec(rng.permutation(angles)[:, None] * up)
        tilt = Rotation.from_rotvec(math.radians(prior.sigma_deg) * rng.standard_normal((count, 3))) * about
        mean = Rotation.align_vectors(up[None], scene[None])[0].as_matrix()
    rotations = tilt.as_matrix() @ mean
    rotations[0] = mean
    return rotations


def draw_poses(
    spread: float,
    points3d: Array,
    count: int,
    recipe: Recipe,
    prior: Prior | None,
    rng: np.random.Generator,
    aim: NDArray[np.float64] | None = None,
) -> tuple[Array, Array]:
    """Rotations (count, 3, 3) and translations (count, 3) to start from, for a camera that looks along (0, 0, 1).

    The weak-perspective translation puts a point of the scene on this axis, at the distance at which the points' extent
    across it is seen under the angle `spread`, that of the bearings; or, with `aim` (2,), within `AIM_STEP` of this
    place beside it, in spreads.
    """
    rotation = draw_rotations(count, prior, rng)
    middle = points3d.mean(0)
    covariance = np.cov(points3d.T, bias=True)
    along = np.einsum("si,ij,sj->s", rotation[:, 2], covariance, rotation[:, 2])  # variance along the view
    extent = np.sqrt(np.maximum(np.trace(covariance) - along, 0))
    depth = extent / spread * np.exp(recipe.log_depth * rng.uniform(-1, 1, count))
    if spread > ALL_AROUND:  # the camera is among the points
        depth *= rng.random(count)
    seen = middle + recipe.off_centre * rng.random((count, 1)) * (
        points3d[rng.integers(len(points3d), size=count)] - middle
    )
    towards = np.tile((0.0, 0.0, 1.0), (count, 1))
    if aim is not None:
        angle, away = 2 * math.pi * rng.random(count), AIM_STEP * np.sqrt(rng.random(count))
        towards[:, :2] = spread * (aim + (away * np.stack([np.cos(angle), np.sin(angle)])).T)
        towards /= np.linalg.norm(towards, axis=-1, keepdims=True)
    translation = depth[:, None] * towards - np.einsum("sij,sj->si", rotation, seen)
    return rotation.astype(np.float32), translation.astype(np.float32)


def aim_of(number: int) -> NDArray[np.float64]:
    """Where in the view, (2,) in spreads from its middle, a search aims: every other one at the middle, the others on a
    spiral that covers the view evenly, begun anew after 4, 16, 64, 64 ... places.

    >>> aim_of(0), aim_of(1)
    (array([0., 0.]), array([0.16, 0.  ]))
    """
    place, places = number // 2, 4
    while place >= places:
        place, places = place - places, min(4 * places, 64)
    place, angle = (place + 1) * (number % 2), place * math.pi * (3 - math.sqrt(5))
    return AIM_STEP * math.sqrt(place) * np.array([math.cos(angle), math.sin(angle)])


def turned_to(axis: NDArray[np.float64]) -> NDArray[np.float64]:
    """A rotation (3, 3) that turns `axis` to (0, 0, 1); none if there is no axis, for bearings all around."""
    length = float(np.linalg.norm(axis))
    if length < 1e-6:
        return np.eye(3)
    forward = axis / length
    right = np.linalg.svd(forward[None])[2][1]
    return np.stack([right, np.cross(forward, right), forward])
