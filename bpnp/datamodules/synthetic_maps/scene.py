"""What every kind of scene is made of: feature points on surfaces, and the walls and blobs that hide them."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
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


Kind = Callable[[int, float, np.random.Generator], tuple[Scene, Viewpoint]]
NO_BLOBS = Blobs(np.zeros((0, 3)), np.zeros((0, 3, 3)))
NO_WALLS = Walls(*(np.zeros((0, 2)) for _ in range(3)), *(np.zeros(0) for _ in range(5)))


def assembled(
    surfaces: Sequence[Surface], rng: np.random.Generator, *, walls: Walls = NO_WALLS, blobs: Blobs = NO_BLOBS
) -> Scene:
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


def hidden(scene: Scene, centre: Array, points: Array) -> NDArray[np.bool_]:
    """Whether a wall or a blob is between the camera's centre (3,) and each of the points (n, 3)."""
    return hidden_by_walls(scene.walls, centre, points) | hidden_by_blobs(scene.blobs, centre, points)


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
