"""Random scenes like sparse SfM maps of buildings: points on facades, columns, trees and the ground, in metres, z up.

Points lie where keypoints would: on the corners of windows in rows, on ledges, in clusters, few of them elsewhere.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

MAIN_WEIGHT = 3.0  # points on an area of the first building, of those on as much of another
MAPPED_SURFACE, MAPPED_TREE, MAPPED_GROUND = 0.5, 0.3, 0.4  # share of the points that the map has
WINDOW_POINTS, LEDGES, PATCHES = 10, 4, 6  # of each wall


class Walls(NamedTuple):
    """Upright rectangles on the ground: from start (k, 2) by width (k,) along (k, 2); normal (k, 2) is the outside."""

    start: Array
    along: Array
    normal: Array
    width: Array
    height: Array
    main: int  # the first walls are those of the building that is looked at


class Scene(NamedTuple):
    """points (n, 3), normals (n, 3) or 0 for points seen from every side, mapped (n,): the map has the point."""

    points: Array
    normals: Array
    mapped: NDArray[np.bool_]
    walls: Walls


def draw_scene(count: int, rng: np.random.Generator) -> Scene:
    """A scene of `count` points: walls with columns, trees and ground about them."""
    walls = draw_walls(rng)
    shares = rng.uniform([0.0, 0.02, 0.02], [0.25, 0.2, 0.15]) * [rng.random() < 0.6, 1.0, 1.0]
    columns, trees, ground = (int(share * count) for share in shares)
    parts = [
        wall_points(walls, count - columns - trees - ground, rng),
        column_points(walls, columns, rng),
        tree_points(walls, trees, rng),
        ground_points(walls, ground, rng),
    ]
    mapped = np.repeat([MAPPED_SURFACE, MAPPED_TREE, MAPPED_GROUND], [count - trees - ground, trees, ground])
    return Scene(
        points=np.concatenate([points for points, _ in parts]),
        normals=np.concatenate([normals for _, normals in parts]),
        mapped=rng.random(count) < mapped,
        walls=walls,
    )


def draw_walls(rng: np.random.Generator) -> Walls:
    """One to three walls in a line, each a corner with the last, mostly at right angles outwards; up to four boxes."""
    main, boxes = int(rng.integers(1, 4)), int(rng.integers(0, 5))
    chance = rng.random((3, main))
    turn = np.where(chance[0] < 0.65, 1, -1) * np.where(chance[1] < 0.2, 0.6 + 1.4 * chance[2], np.pi / 2)
    heading = np.cumsum(turn) - turn[0]
    width = rng.uniform(8, 30, main)
    height = rng.uniform(6, 25) * rng.uniform(0.7, 1.1, main)
    along = _directions(heading)
    start = np.cumsum(width[:, None] * along, 0) - width[:, None] * along

    place, yaw = rng.uniform(0, 2 * np.pi, (2, boxes))
    centre = rng.uniform(20, 60, (boxes, 1)) * _directions(place) + start[0] + width[0] / 2 * along[0]
    half = rng.uniform(3, 10, (boxes, 2))
    side = (yaw[:, None] + np.pi / 2 * np.arange(4)).ravel()  # headings of the four walls, counter-clockwise
    box_along = _directions(side)
    ahead, right = half[:, [0, 1, 0, 1]].ravel(), half[:, [1, 0, 1, 0]].ravel()
    box_start = np.repeat(centre, 4, 0) + right[:, None] * right_of(box_along) - ahead[:, None] * box_along

    along = np.concatenate([along, box_along])
    return Walls(
        start=np.concatenate([start, box_start]),
        along=along,
        normal=right_of(along),
        width=np.concatenate([width, 2 * ahead]),
        height=np.concatenate([height, np.repeat(rng.uniform(4, 20, boxes), 4)]),
        main=main,
    )


def right_of(along: Array) -> Array:
    """Directions (k, 2) turned by a right angle, clockwise."""
    return along[:, ::-1] * [1.0, -1.0]


def _directions(angle: Array) -> Array:
    """Unit vectors (k, 2) of angles (k,)."""
    directions = np.empty((len(angle), 2))
    np.cos(angle, out=directions[:, 0])
    np.sin(angle, out=directions[:, 1])
    return directions


def wall_points(walls: Walls, count: int, rng: np.random.Generator) -> tuple[Array, Array]:
    """Points on walls and their normals; each kind of them prefers walls of its own."""
    kinds = (_windows, _ledges, _patches, _plain)
    counts = rng.multinomial(count, rng.dirichlet([3.0, 1.0, 2.0, 0.7]))
    area = walls.width * walls.height * np.where(np.arange(len(walls.width)) < walls.main, MAIN_WEIGHT, 1.0)
    weight = np.cumsum(area * np.exp(0.7 * rng.standard_normal((len(kinds), len(area)))), 1)
    on = [np.searchsorted(w, w[-1] * rng.random(n)) for w, n in zip(weight, counts, strict=True)]
    local = np.concatenate([kind(walls, chosen, rng) for kind, chosen in zip(kinds, on, strict=True)], 1)
    wall = np.concatenate(on)
    flat = walls.start[wall] + local[0, :, None] * walls.along[wall] + local[2, :, None] * walls.normal[wall]
    return _upright(flat, np.abs(local[1])), _upright(walls.normal[wall], np.zeros(count))


def _windows(walls: Walls, on: NDArray[np.int64], rng: np.random.Generator) -> Array:
    """(3, n): along the wall, up, and out of it; corners of the windows of a grid and points in them, all alike."""
    k = len(walls.width)
    columns = np.ceil(walls.width / rng.uniform(2, 5, k))
    rows = np.ceil(walls.height / rng.uniform(2.5, 4.5, k))
    pattern = rng.uniform(-0.4, 0.4, (2, k, WINDOW_POINTS))
    pattern[:, :, :4] = rng.uniform(0.15, 0.4, (2, k, 1)) * np.array([[[-1, 1, -1, 1]], [[-1, -1, 1, 1]]])
    recess = -rng.uniform(0, 0.5, (k, 1)) * (rng.random((k, WINDOW_POINTS)) < 0.6)
    uneven = rng.uniform(0.6, 1.8, (2, k))  # windows at one end have more points
    which = rng.integers(0, WINDOW_POINTS, len(on))
    cells = np.array([columns, rows])
    place = 0.02 * rng.standard_normal((3, len(on)))
    cell = np.floor(rng.random((2, len(on))) ** uneven[:, on] * cells[:, on]) + 0.5
    place[:2] += (cell + pattern[:, on, which]) * (np.array([walls.width, walls.height]) / cells)[:, on]
    place[2] += recess[on, which]
    return place


def _ledges(walls: Walls, on: NDArray[np.int64], rng: np.random.Generator) -> Array:
    k = len(walls.width)
    level = rng.random((k, LEDGES)) * walls.height[:, None]
    out = rng.uniform(0, 0.6, (k, LEDGES))
    which = rng.integers(0, LEDGES, len(on))
    place = 0.04 * rng.standard_normal((3, len(on)))
    place[0] = rng.random(len(on)) * walls.width[on]
    place[1] += level[on, which]
    place[2] += out[on, which]
    return place


def _patches(walls: Walls, on: NDArray[np.int64], rng: np.random.Generator) -> Array:
    """Clusters such as doors, signs and statues, in relief."""
    k = len(walls.width)
    centre = rng.random((2, k, PATCHES)) * np.array([walls.width, walls.height])[:, :, None]
    spread = rng.uniform(0.2, 1.5, (3, k, PATCHES)) * np.array([1.0, 1.0, 0.2])[:, None, None]
    which = (PATCHES * rng.random(len(on)) ** 2).astype(np.int64)
    place = spread[:, on, which] * rng.standard_normal((3, len(on)))
    place[:2] += centre[:, on, which]
    return place


def _plain(walls: Walls, on: NDArray[np.int64], rng: np.random.Generator) -> Array:
    return rng.random((3, len(on))) * np.array([walls.width, walls.height, np.full(len(walls.width), 0.05)])[:, on]


def column_points(walls: Walls, count: int, rng: np.random.Generator) -> tuple[Array, Array]:
    """Points on a row of columns before the first wall, or on a tower beside it; many on the rings around them."""
    columns = int(rng.integers(1, 9))
    tower = columns == 1
    radius = rng.uniform(2, 5) if tower else rng.uniform(0.3, 0.8)
    height = walls.height[0] * (rng.uniform(1, 1.8) if tower else rng.uniform(0.4, 0.9))
    foot = walls.start[0] + walls.normal[0] * rng.uniform(1, 4) - walls.along[0] * (2 * radius if tower else 0)
    place = (rng.integers(0, columns, count) + 0.5) / columns * (0 if tower else walls.width[0])
    angle, up = rng.uniform(0, 2 * np.pi, count), rng.random(count)
    rings = rng.random(5)[rng.integers(0, 5, count)]
    up = np.where(rng.random(count) < 0.6, rings + 0.01 * rng.standard_normal(count), up)
    outward = _directions(angle)
    points = foot + place[:, None] * walls.along[0] + radius * outward
    return _upright(points, height * np.abs(up)), _upright(outward, np.zeros(count))


def tree_points(walls: Walls, count: int, rng: np.random.Generator) -> tuple[Array, Array]:
    """Fuzzy blobs before the first building and beside it."""
    trees = int(rng.integers(1, 6))
    low, high = walls.start[: walls.main].min(0) - [15, 25], walls.start[: walls.main].max(0) + [35, 15]
    centre = rng.uniform([*low, 1.0], [*high, 7.0], (trees, 3))
    spread = rng.uniform(0.4, 2, (trees, 3))
    which = rng.integers(0, trees, count)
    points = centre[which] + spread[which] * rng.standard_normal((count, 3))
    np.abs(points[:, 2], out=points[:, 2])
    return points, np.zeros((count, 3))


def ground_points(walls: Walls, count: int, rng: np.random.Generator) -> tuple[Array, Array]:
    """The ground before the first wall, in patches."""
    patches = 8
    reach = rng.uniform([0, 1], [walls.width[0], 30], (patches, 2))
    which = rng.integers(0, patches, count)
    place = reach[which] + rng.uniform(0.3, 4, patches)[which, None] * rng.standard_normal((count, 2))
    points = walls.start[0] + place[:, :1] * walls.along[0] + np.abs(place[:, 1:]) * walls.normal[0]
    return _upright(points, 0.03 * rng.standard_normal(count)), _upright(np.zeros((count, 2)), np.ones(count))


def _upright(flat: Array, up: Array) -> Array:
    """(n, 3) of (n, 2) and the heights (n,)."""
    points = np.empty((len(flat), 3))
    points[:, :2], points[:, 2] = flat, up
    return points
