"""Scenes and photos of them: feature points, the walls and blobs that hide them, and the keypoints of a photo."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bpnp.arrays import Array

MIN_DEPTH = 0.1  # least depth of a visible point, metres
GRAZING = 0.35  # cosine between a normal and the direction to the camera, below which detections get rarer
ONE_PHOTO = 0.5  # probability of a keypoint at a visible point that no other photo has a keypoint of
REACHED = 0.985  # fraction of the segment to a point; a blob entered later is the point's own surface


class Walls(NamedTuple):
    """Upright rectangles on the ground."""

    start: Array  # lower corners (k, 2), metres
    along: Array  # unit directions (k, 2)
    normal: Array  # outward normals (k, 2)
    width: Array  # (k,), metres
    height: Array  # (k,), metres
    weight: Array  # relative density of points (k,)
    cell: Array  # size of the repeated pattern (k,), metres
    relief: Array  # depth of the relief (k,), metres; a wall does not hide points nearer to its plane


class Blobs(NamedTuple):
    """Ellipsoids; p is on the surface where ||to_sphere (p - centre)|| = 1."""

    centre: Array  # (k, 3), metres
    to_sphere: Array  # maps to the unit sphere (k, 3, 3)


class DrawnScene(NamedTuple):
    """Feature points of a scene, metres, third axis upwards."""

    points: Array  # (n, 3)
    normals: Array  # (n, 3), 0 for points visible from every side
    # Probability (n,) that a photo in which the point is visible has a keypoint there; 0 for points that only one photo
    # has a keypoint of.
    repeatability: Array
    walls: Walls
    blobs: Blobs


class Viewpoint(NamedTuple):
    """Position of a photo of a scene, and how other photos of the same part differ from it."""

    centre: Array  # camera centre (3,), metres
    target: Array  # point that the camera looks at (3,), metres
    orbit: float  # standard deviation of the angle by which other photos go around the target, radians
    shift: float  # standard deviation of their distance from there, as a fraction of the distance to the target
    heading: float  # standard deviation of their viewing direction, radians
    # Smallest and largest baseline between the photos that saw a point, as a fraction of the distance to the target.
    parallax: tuple[float, float]


class Surface(NamedTuple):
    """Points of a surface."""

    points: Array  # (n, 3)
    normals: Array  # (n, 3)
    repeatable: float  # fraction of the points that are detected in other photos too


NO_BLOBS = Blobs(np.zeros((0, 3)), np.zeros((0, 3, 3)))


def assemble(
    surfaces: Sequence[Surface], walls: Walls, rng: np.random.Generator, blobs: Blobs = NO_BLOBS
) -> DrawnScene:
    """Combine surfaces to a scene; the repeatability of repeatable points is drawn from Beta(3, 2).

    Their fraction varies in waves over the scene, up to four of them, so that some parts are hardly ever in a map.
    """
    fractions = np.repeat([part.repeatable for part in surfaces], [len(part.points) for part in surfaces])
    points = np.concatenate([part.points for part in surfaces])
    wave = rng.standard_normal(3) * rng.uniform(1, 12) / np.median(np.abs(points - np.median(points, 0)))
    fractions = np.minimum(1, fractions * (1 + np.cos(points @ wave + rng.uniform(0, 2 * np.pi))))
    return DrawnScene(
        points=points,
        normals=np.concatenate([part.normals for part in surfaces]),
        repeatability=rng.beta(3.0, 2.0, len(fractions)) * (rng.random(len(fractions)) < fractions),
        walls=walls,
        blobs=blobs,
    )


def join_walls(parts: Sequence[Walls]) -> Walls:
    """Concatenate groups of walls."""
    return Walls(*(np.concatenate(field) for field in zip(*parts, strict=True)))


def directions(angle: Array) -> Array:
    """Return the unit vectors (..., 2) of angles (...), radians."""
    return np.stack([np.cos(angle), np.sin(angle)], -1)


def right_of(along: Array) -> Array:
    """Rotate directions (k, 2) by a right angle, clockwise."""
    return along[:, ::-1] * [1.0, -1.0]


def hidden_by_walls(walls: Walls, centre: Array, points: Array) -> NDArray[np.bool_]:
    """Return True where the segment from the centre to a point crosses a wall."""
    offset = np.einsum("ij,ij->i", walls.start, walls.normal)
    from_centre, from_point = centre[:2] @ walls.normal.T - offset, points[:, :2] @ walls.normal.T - offset
    crosses = (from_centre * from_point < 0) & (np.abs(from_point) > walls.relief)
    fraction = from_centre / np.where(crosses, from_centre - from_point, 1.0)  # of the segment, at the wall's plane
    first = np.einsum("ij,ij->i", walls.start, walls.along)
    along = centre[:2] @ walls.along.T - first + fraction * ((points[:, :2] - centre[:2]) @ walls.along.T)
    up = centre[2] + fraction * (points[:, 2:] - centre[2])
    return np.asarray((crosses & (along > 0) & (along < walls.width) & (up < walls.height)).any(1))


def hidden_by_blobs(blobs: Blobs, centre: Array, points: Array) -> NDArray[np.bool_]:
    """Return True where the segment from the centre to a point enters an ellipsoid before it reaches the point."""
    start = np.einsum("kij,kj->ki", blobs.to_sphere, centre - blobs.centre)
    way = ((points - centre) @ blobs.to_sphere.reshape(-1, 3).T).reshape(len(points), len(blobs.centre), 3)
    square, half = (way**2).sum(-1), (way * start).sum(-1)
    inside = half**2 - square * ((start**2).sum(-1) - 1)
    enters = (-half - np.sqrt(np.maximum(inside, 0))) / square
    return np.asarray(((inside > 0) & (enters > 0) & (enters < REACHED)).any(1))


class DrawnCamera(NamedTuple):
    """Pinhole camera; camera = rotation p + translation, metres."""

    rotation: Array  # R (3, 3)
    translation: Array  # t (3,)
    centre: Array  # camera centre (3,)
    half: Array  # half of the image's width and height over the focal length (2,)


class VisiblePoints(NamedTuple):
    """Keypoints of a photo."""

    of: NDArray[np.int64]  # index of the scene point of each keypoint (k,)
    image: Array  # projections (k, 2)
    depth: Array  # (k,), metres


def image_shape(half: float, rng: np.random.Generator) -> Array:
    """Draw half of the image's width and height over the focal length: 4:3, 3:2 or 16:9, upright or not.

    `half` is half of the longer side over the focal length.
    """
    shape = half * np.array([1.0, rng.choice([3 / 4, 2 / 3, 9 / 16])])
    return shape if rng.random() < 0.75 else shape[::-1]


def camera_at(centre: Array, target: Array, half: Array, rng: np.random.Generator) -> DrawnCamera:
    """Return a camera that looks at a target (3,), held level to within a few degrees, rarely more."""
    ahead = (target - centre) / np.linalg.norm(target - centre)
    level = math.hypot(ahead[0], ahead[1])
    right = np.array([ahead[1], -ahead[0], 0.0]) / level
    roll = rng.standard_normal() * math.radians(3 if rng.random() < 0.9 else 20)
    down = np.cross(ahead, right)
    cos, sin = math.cos(roll), math.sin(roll)
    rotation = np.array([cos * right - sin * down, sin * right + cos * down, ahead])
    return DrawnCamera(rotation, -rotation @ centre, centre, half)


def nearby_camera(view: Viewpoint, half: Array, rng: np.random.Generator) -> DrawnCamera:
    """Draw another photo of the same part: from around the target, and not quite directed at it."""
    from_target = view.centre - view.target
    distance = float(np.linalg.norm(from_target))
    angle = view.orbit * rng.standard_normal()
    cos, sin = math.cos(angle), math.sin(angle)
    x, y, z = from_target * math.exp(0.7 * view.shift * rng.standard_normal())
    centre = view.target + [cos * x - sin * y, sin * x + cos * y, z]
    centre = centre + 0.5 * view.shift * distance * rng.standard_normal(3) * [1.0, 1.0, 0.3]
    return camera_at(centre, view.target + view.heading * distance * rng.standard_normal(3), half, rng)


def find_visible(
    scene: DrawnScene, camera: DrawnCamera, reach: Array, rng: np.random.Generator, *, alone: bool
) -> VisiblePoints:
    """Draw the keypoints of a photo, among points in the image, in front of their surface and not hidden.

    A camera of unit `half` resolves the details at a point from at most its `reach` (n,), metres. With `alone`, points
    that no other photo has a keypoint of are included.
    """
    x, y, depth = camera.rotation @ scene.points.T + camera.translation[:, None]
    inside = (np.abs(x) < camera.half[0] * depth) & (np.abs(y) < camera.half[1] * depth)
    near = np.flatnonzero(inside & (depth > MIN_DEPTH) & (depth < reach / camera.half.max()))
    towards, normals = camera.centre - scene.points[near], scene.normals[near]
    facing = np.einsum("ij,ij->i", towards, normals) / np.sqrt(np.einsum("ij,ij->i", towards, towards))
    facing[~normals.any(1)] = 1.0
    chance = scene.repeatability[near]
    chance = np.where(chance > 0, chance, ONE_PHOTO if alone else 0.0)
    detected = GRAZING * rng.random(len(near)) < chance * np.minimum(facing, GRAZING)
    near = near[detected]
    way = camera.centre, scene.points[near]
    near = near[~(hidden_by_walls(scene.walls, *way) | hidden_by_blobs(scene.blobs, *way))]
    return VisiblePoints(near, np.stack([x[near], y[near]], -1) / depth[near, None], depth[near])


def details(scene: DrawnScene, view: Viewpoint, half: float, rng: np.random.Generator) -> Array:
    """Draw the largest distance (n,) from which a camera of unit `half` resolves the details at each point, metres.

    Sizes follow a power law, so that the number of resolved points falls with the square of the distance; all are
    resolved from the distance to the target.
    """
    distance = half * float(np.linalg.norm(view.centre - view.target))
    return distance / np.sqrt(rng.random(len(scene.points)))
