"""Priors of a pose, `PosePrior` and `GravityPrior`; and initial poses, drawn from a prior or over all rotations."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from bpnp.arrays import Array32

# RMS angular radius above which bearings fill about 220 degrees or more, so that the camera is among the points.
ALL_AROUND_SPREAD = 0.95  # [radians; derived]
# Step of the spiral of positions at which searches aim, with radii of `AIM_STEP` times the square root of the number;
# it leaves no gaps.
AIM_STEP = 0.16  # [RMS angular radii; not tuned]


class StartSampling(NamedTuple):
    """Sampling of initial poses around the weak-perspective pose."""

    # 0 puts the centroid of the 3D points on the mean bearing. 1 puts a random 3D point there, for cameras that see a
    # part of the scene. Values between interpolate.
    off_centre: float
    log_depth: float  # the depth is multiplied by exp(u), u uniform in [-log_depth, log_depth], nats


class PosePrior(NamedTuple):
    """Rough pose, camera = R p + t, with one standard deviation of its errors.

    The errors are those of the rotation about the centroid o of the scene points, and of the position R o + t of this
    centroid in the camera's frame. They are independent, and do not depend on the origin of the scene. If instead the
    position of the camera is known to s, as from a tracker in a map, a wrong rotation also moves a centroid at the
    distance d: give math.hypot(s, math.radians(rotation_sigma_deg) * d) as `translation_sigma`.

    Attributes:
        rotation: (3, 3).
        translation: (3,) in scene units; None if only the rotation is given.
        rotation_sigma_deg: Standard deviation about each axis, degrees.
        translation_sigma: Standard deviation of the centroid's position along each axis, scene units; infinite by
            default.

    >>> import numpy as np
    >>> from bpnp import PosePrior
    >>> PosePrior(np.eye(3), np.array([0, 0, 6]), rotation_sigma_deg=5.0, translation_sigma=0.5).rotation_sigma_deg
    5.0
    """

    rotation: ArrayLike
    translation: ArrayLike | None
    rotation_sigma_deg: float
    translation_sigma: float = math.inf


class GravityPrior(NamedTuple):
    """Direction of the vertical, with its standard deviation.

    Attributes:
        up_camera: (3,) direction in camera coordinates, of any length.
        up_scene: (3,) direction in scene coordinates, of any length.
        sigma_deg: Standard deviation of the angle between them, degrees; 2 by default.

    >>> import numpy as np
    >>> from bpnp import GravityPrior
    >>> GravityPrior(up_camera=np.array([0, -1, 0]), up_scene=np.array([0, 0, 1])).sigma_deg
    2.0
    """

    up_camera: ArrayLike
    up_scene: ArrayLike
    sigma_deg: float = 2.0

    def directions(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the unit vectors (3,) of the vertical in the camera and in the scene."""
        camera, scene = (np.asarray(v, np.float64) / np.linalg.norm(v) for v in (self.up_camera, self.up_scene))
        return camera, scene


Prior = PosePrior | GravityPrior


def super_fibonacci(count: int) -> NDArray[np.float64]:
    """Return rotations (count, 3, 3) spread evenly over SO(3).

    Source: super-Fibonacci spirals (Alexa, CVPR 2022, Algorithm 1).
    """
    s = np.arange(count) + 0.5
    inner, outer = np.sqrt(s / count), np.sqrt(1 - s / count)
    alpha, beta = 2 * math.pi * s / math.sqrt(2), 2 * math.pi * s / 1.533751168755204288118041
    quaternions = [inner * np.sin(alpha), inner * np.cos(alpha), outer * np.sin(beta), outer * np.cos(beta)]
    return Rotation.from_quat(np.stack(quaternions, -1)).as_matrix()


def draw_rotations(count: int, prior: Prior | None, rng: np.random.Generator) -> NDArray[np.float64]:
    """Draw rotations (count, 3, 3) from a prior, its mean first, or spread them evenly over SO(3)."""
    if prior is None:
        return super_fibonacci(count) @ Rotation.from_quat(rng.standard_normal(4)).as_matrix()
    if isinstance(prior, PosePrior):
        tilt = Rotation.from_rotvec(math.radians(prior.rotation_sigma_deg) * rng.standard_normal((count, 3)))
        mean = np.asarray(prior.rotation, dtype=np.float64)
    else:
        up, scene = prior.directions()
        angles = 2 * math.pi * (np.arange(count) + rng.random()) / count
        about = Rotation.from_rotvec(rng.permutation(angles)[:, None] * up)
        tilt = Rotation.from_rotvec(math.radians(prior.sigma_deg) * rng.standard_normal((count, 3))) * about
        mean = Rotation.align_vectors(up[None], scene[None])[0].as_matrix()
    rotations = tilt.as_matrix() @ mean
    rotations[0] = mean
    return rotations


def draw_poses(
    spread: float,
    points3d: Array32,
    count: int,
    recipe: StartSampling,
    prior: Prior | None,
    rng: np.random.Generator,
    aim: NDArray[np.float64] | None = None,
) -> tuple[Array32, Array32]:
    """Draw initial poses, float32, for a camera that looks along (0, 0, 1), with rotations of a prior or all of them.

    The weak-perspective translation puts a scene point on this axis, or within `AIM_STEP` of an `aim` (2,) in the view;
    both are in units of `spread`, the RMS angular radius of the bearings. At its depth, the extent of the points across
    the axis is seen under this angle.
    """
    rotation = draw_rotations(count, prior, rng)
    centroid = points3d.mean(0)
    covariance = np.cov(points3d.T, bias=True)
    along = np.einsum("si,ij,sj->s", rotation[:, 2], covariance, rotation[:, 2])  # variance along the view
    extent = np.sqrt(np.maximum(np.trace(covariance) - along, 0))
    depth = extent / spread * np.exp(recipe.log_depth * rng.uniform(-1, 1, count))
    if spread > ALL_AROUND_SPREAD:  # the camera is among the points
        depth *= rng.random(count)
    seen = centroid + recipe.off_centre * rng.random((count, 1)) * (
        points3d[rng.integers(len(points3d), size=count)] - centroid
    )
    towards = np.tile((0.0, 0.0, 1.0), (count, 1))
    if aim is not None:
        angle, away = 2 * math.pi * rng.random(count), AIM_STEP * np.sqrt(rng.random(count))
        towards[:, :2] = spread * (aim + (away * np.stack([np.cos(angle), np.sin(angle)])).T)
        towards /= np.linalg.norm(towards, axis=-1, keepdims=True)
    translation = depth[:, None] * towards - np.einsum("sij,sj->si", rotation, seen)
    return rotation.astype(np.float32), translation.astype(np.float32)


def aim_of(number: int) -> NDArray[np.float64]:
    """Return the position (2,) in the view at which a search aims, in RMS angular radii from its centre.

    Searches are numbered from 0. Even ones aim at the centre. Odd ones follow a spiral that covers the view evenly and
    restarts after 4, 16, 64, 64, ... positions.

    >>> aim_of(0), aim_of(1)
    (array([0., 0.]), array([0.16, 0.  ]))
    """
    place, places = number // 2, 4
    while place >= places:
        place, places = place - places, min(4 * places, 64)
    place, angle = (place + 1) * (number % 2), place * math.pi * (3 - math.sqrt(5))
    return AIM_STEP * math.sqrt(place) * np.array([math.cos(angle), math.sin(angle)])


def turned_to(axis: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a rotation (3, 3) that maps `axis` to (0, 0, 1); the identity if `axis` is almost 0."""
    length = float(np.linalg.norm(axis))
    if length < 1e-6:
        return np.eye(3)
    forward = axis / length
    right = np.linalg.svd(forward[None])[2][1]
    return np.stack([right, np.cross(forward, right), forward])
