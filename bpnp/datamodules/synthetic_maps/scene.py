"""Scenes and photos of them: feature points, the walls and blobs that hide them, and where a photo has a keypoint."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
MIN_DEPTH = 0.1  # metres; nothing nearer to the camera is seen
GRAZING = 0.35  # cosine between a normal and the direction to the camera, below which detections get rarer
ONE_PHOTO = 0.5  # probability of a keypoint at a visible point that no other photo has a keypoint of
REACHED = 0.985  # share of the way to a point; a blob that the ray enters later is the surface of the point itself


class Walls(NamedTuple):
    """Upright rectangles on the ground: from start (k, 2) by width (k,) along (k, 2); normal (k, 2) is the outside.

    weight (k,): points on an area of a wall, relative. cell (k,): size of what is repeated on it, metres.
    relief (k,): a wall hides nothing that is nearer to its plane, metres.
    """

    start: Array
    along: Array
    normal: Array
    width: Array
    height: Array
    weight: Array
    cell: Array
    relief: Array


class Blobs(NamedTuple):
    """Ellipsoids centre (k, 3), to_sphere (k, 3, 3): p is on the surface where ||to_sphere (p - centre)|| = 1."""

    centre: Array
    to_sphere: Array


class Scene(NamedTuple):
    """Feature points, metres, third axis upwards.

    points (n, 3); normals (n, 3), or 0 for points seen from every side; repeatability (n,): probability that a photo in
    which the point is visible has a keypoint there, 0 for points that one photo alone has a keypoint of.
    """

    points: Array
    normals: Array
    repeatability: Array
    walls: Walls
    blobs: Blobs


class Viewpoint(NamedTuple):
    """Where a photo of a scene is taken, and how other photos of the same part differ from it.

    centre, target (3,): the camera and what it looks at, metres. orbit: standard deviation of the angle by which the
    others go around the target, radians. shift: of their distance from there, of the distance to the target. heading:
    of the direction that they look in, radians. parallax: lowest and highest baseline between the photos that
    saw a point, as a share of the distance to the target.
    """

    centre: Array
    target: Array
    orbit: float
    shift: float
    heading: float
    parallax: tuple[float, float]


class Surface(NamedTuple):
    """Points (n, 3) with normals (n, 3) and the share of them that is found again in other photos."""

    points: Array
    normals: Array
    found_again: float


NO_BLOBS = Blobs(np.zeros((0, 3)), np.zeros((0, 3, 3)))


def assembled(surfaces: Sequence[Surface], walls: Walls, rng: np.random.Generator, blobs: Blobs = NO_BLOBS) -> Scene:
    """A scene of several surfaces; the repeatability of points that are found again is drawn from Beta(3, 2).

    Their share varies in waves over the scene, up to four of them: some parts are hardly ever in a map.
    """
    shares = np.repeat([part.found_again for part in surfaces], [len(part.points) for part in surfaces])
    points = np.concatenate([part.points for part in surfaces])
    wave = rng.standard_normal(3) * rng.uniform(1, 12) / np.median(np.abs(points - np.median(points, 0)))
    shares = np.minimum(1, shares * (1 + np.cos(points @ wave + rng.uniform(0, 2 * np.pi))))
    return Scene(
        points=points,
        normals=np.concatenate([part.normals for part in surfaces]),
        repeatability=rng.beta(3.0, 2.0, len(shares)) * (rng.random(len(shares)) < shares),
        walls=walls,
        blobs=blobs,
    )


def joined(parts: Sequence[Walls]) -> Walls:
    """All walls of several groups."""
    return Walls(*(np.concatenate(field) for field in zip(*parts, strict=True)))


def directions(angle: Array) -> Array:
    """Unit vectors (..., 2) of angles (...)."""
    return np.stack([np.cos(angle), np.sin(angle)], -1)


def right_of(along: Array) -> Array:
    """Directions (k, 2) turned by a right angle, clockwise."""
    return along[:, ::-1] * [1.0, -1.0]


def hidden_by_walls(walls: Walls, centre: Array, points: Array) -> NDArray[np.bool_]:
    """Whether the segment from the centre to each point crosses a wall."""
    offset = np.einsum("ij,ij->i", walls.start, walls.normal)
    ours, theirs = centre[:2] @ walls.normal.T - offset, points[:, :2] @ walls.normal.T - offset
    apart = (ours * theirs < 0) & (np.abs(theirs) > walls.relief)
    share = ours / np.where(apart, ours - theirs, 1.0)  # of the way to the point, where it crosses the wall's plane
    first = np.einsum("ij,ij->i", walls.start, walls.along)
    place = centre[:2] @ walls.along.T - first + share * ((points[:, :2] - centre[:2]) @ walls.along.T)
    up = centre[2] + share * (points[:, 2:] - centre[2])
    return np.asarray((apart & (place > 0) & (place < walls.width) & (up < walls.height)).any(1))


def hidden_by_blobs(blobs: Blobs, centre: Array, points: Array) -> NDArray[np.bool_]:
    """Whether the segment from the centre to each point enters an ellipsoid before it reaches the point."""
    start = np.einsum("kij,kj->ki", blobs.to_sphere, centre - blobs.centre)
    way = ((points - centre) @ blobs.to_sphere.reshape(-1, 3).T).reshape(len(points), len(blobs.centre), 3)
    square, half = (way**2).sum(-1), (way * start).sum(-1)
    inside = half**2 - square * ((start**2).sum(-1) - 1)
    enters = (-half - np.sqrt(np.maximum(inside, 0))) / square
    return np.asarray(((inside > 0) & (enters > 0) & (enters < REACHED)).any(1))


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
    detected = GRAZING * rng.random(len(near)) < chance * np.minimum(facing, GRAZING)
    near = near[detected]
    way = camera.centre, scene.points[near]
    near = near[~(hidden_by_walls(scene.walls, *way) | hidden_by_blobs(scene.blobs, *way))]
    return Sight(near, np.stack([x[near], y[near]], -1) / depth[near, None], depth[near])


def details(scene: Scene, view: Viewpoint, half: float, rng: np.random.Generator) -> Array:
    """Metres (n,) from which a camera of unit `half` can still tell the details at each point.

    Sizes follow a power law, so that the number of points that can be told falls with the square of the distance; all
    can be told from the distance to the target.
    """
    distance = half * float(np.linalg.norm(view.centre - view.target))
    return distance / np.sqrt(rng.random(len(scene.points)))
