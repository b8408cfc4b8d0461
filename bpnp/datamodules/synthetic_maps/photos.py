"""Photos of a scene: cameras near a viewpoint, what they see, and at which of these points they have a keypoint."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bpnp.datamodules.synthetic_maps.scene import Array, Scene, Viewpoint, hidden

MIN_DEPTH = 0.1  # metres; nothing nearer to the camera is seen
GRAZING = 0.35  # cosine between a normal and the direction to the camera, below which detections get rarer
ONE_PHOTO = 0.5  # probability of a keypoint at a visible point that no other photo has a keypoint of
NEAREST_LIMIT = 1.0  # of the distance to the target: how near the finest details can be told at least


class Camera(NamedTuple):
    """camera = rotation p + translation, metres; half (2,): half the image's width and height over the focal length."""

    rotation: Array
    translation: Array
    centre: Array
    half: Array


class Sight(NamedTuple):
    """Keypoints of a photo: the scene's points that they are, of (k,); projections image (k, 2); depth (k,), metres."""

    of: NDArray[np.int64]
    image: Array
    depth: Array


def image_shape(half: float, rng: np.random.Generator) -> Array:
    """Half of the image's width and height over the focal length: 4:3, 3:2 or 16:9, upright or not."""
    shape = half * np.array([1.0, rng.choice([3 / 4, 2 / 3, 9 / 16])])
    return shape if rng.random() < 0.75 else shape[::-1]


def camera_at(centre: Array, target: Array, half: Array, rng: np.random.Generator) -> Camera:
    """A camera that looks at a place (3,), held level to within a few degrees, rarely more."""
    ahead = (target - centre) / np.linalg.norm(target - centre)
    level = math.hypot(ahead[0], ahead[1])
    if level < 0.02:  # straight down: any direction of the image may point north
        turn = rng.uniform(0, 2 * np.pi)
        right = np.array([math.cos(turn), math.sin(turn), 0.0])
        right -= (right @ ahead) * ahead
        right /= np.linalg.norm(right)
    else:
        right = np.array([ahead[1], -ahead[0], 0.0]) / level
    roll = rng.standard_normal() * math.radians(3 if rng.random() < 0.9 else 20)
    down = np.cross(ahead, right)
    cos, sin = math.cos(roll), math.sin(roll)
    rotation = np.array([cos * right - sin * down, sin * right + cos * down, ahead])
    return Camera(rotation, -rotation @ centre, centre, half)


def nearby_camera(view: Viewpoint, half: Array, rng: np.random.Generator) -> Camera:
    """Another photo of the same part: around the target, somewhat nearer or farther, and not quite at the target."""
    from_target = view.centre - view.target
    distance = float(np.linalg.norm(from_target))
    angle = view.orbit * rng.standard_normal()
    cos, sin = math.cos(angle), math.sin(angle)
    x, y, z = from_target * math.exp(0.7 * view.shift * rng.standard_normal())
    centre = view.target + [cos * x - sin * y, sin * x + cos * y, z]
    centre = centre + 0.5 * view.shift * distance * rng.standard_normal(3) * [1.0, 1.0, 0.3]
    return camera_at(centre, view.target + view.heading * distance * rng.standard_normal(3), half, rng)


def look(scene: Scene, camera: Camera, reach: Array, rng: np.random.Generator, *, alone: bool) -> Sight:
    """The points at which a photo has a keypoint: in the image, in front of their surface and not hidden, by chance.

    reach (n,): metres from which a camera of unit `half` can tell the details at a point. alone: also such points as no
    other photo has a keypoint of.
    """
    x, y, depth = camera.rotation @ scene.points.T + camera.translation[:, None]
    inside = (np.abs(x) < camera.half[0] * depth) & (np.abs(y) < camera.half[1] * depth)
    near = np.flatnonzero(inside & (depth > MIN_DEPTH) & (depth < reach / camera.half.max()))
    towards, normals = camera.centre - scene.points[near], scene.normals[near]
    facing = np.einsum("ij,ij->i", towards, normals) / np.sqrt(np.einsum("ij,ij->i", towards, towards))
    facing[~normals.any(1)] = 1.0
    chance = scene.repeatability[near]
    chance = np.where(chance > 0, chance, ONE_PHOTO if alone else 0.0)
    found = GRAZING * rng.random(len(near)) < chance * np.minimum(facing, GRAZING)
    near = near[found]
    near = near[~hidden(scene, camera.centre, scene.points[near])]
    return Sight(near, np.stack([x[near], y[near]], -1) / depth[near, None], depth[near])


def details(scene: Scene, view: Viewpoint, half: float, rng: np.random.Generator) -> Array:
    """Metres (n,) from which a camera of unit `half` can still tell the details at each point.

    Sizes follow a power law, so that the number of points that can be told falls with the square of the distance.
    """
    distance = half * float(np.linalg.norm(view.centre - view.target))
    return NEAREST_LIMIT * distance / np.sqrt(rng.random(len(scene.points)))
