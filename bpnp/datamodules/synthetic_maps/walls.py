"""Points on walls where keypoints would be: corners of windows in rows, ledges, clusters, few of them elsewhere."""

import numpy as np
from numpy.typing import NDArray

from bpnp.datamodules.synthetic_maps.scene import Array, Surface, Viewpoint, Walls, directions, right_of

WINDOW_POINTS, LEDGES, PATCHES = 14, 5, 8  # of each wall
OTHER_SIDES = 0.2  # points on an area of a wall that the camera cannot see, of those on as much of another
RELIEF = 0.8  # metres, of a facade: windows are recessed, balconies stand out
FACADE_CELL = 3.2  # metres between two windows


def box_walls(
    centre: Array, half: Array, yaw: Array, height: Array, *, cell: float = FACADE_CELL, relief: float = RELIEF,
    weight: float = 1.0, inwards: bool = False,
) -> Walls:  # fmt: skip
    """Four walls of each of b boxes: centre (b, 2), half widths (b, 2), yaw (b,), height (b,); metres, radians.

    inwards: rooms, whose walls are seen from within.
    """
    side = (yaw[:, None] + np.pi / 2 * np.arange(4)).ravel()  # headings of the walls, counter-clockwise
    along = directions(side)
    ahead, right = half[:, [0, 1, 0, 1]].ravel(), half[:, [1, 0, 1, 0]].ravel()
    outwards = right_of(along)
    k = len(side)
    return Walls(
        start=np.repeat(centre, 4, 0) + right[:, None] * outwards - ahead[:, None] * along,
        along=along,
        normal=-outwards if inwards else outwards,
        width=2 * ahead,
        height=np.repeat(height, 4),
        weight=np.full(k, weight),
        cell=np.full(k, cell),
        relief=np.full(k, relief),
    )


def wall_points(walls: Walls, count: int, rng: np.random.Generator, *, found_again: float = 0.5) -> Surface:
    """Points on walls; each kind of them prefers walls of its own. In some scenes all walls bear the same pattern."""
    kinds = (_windows, _ledges, _patches, _plain)
    counts = rng.multinomial(count, rng.dirichlet([3.0, 1.0, 2.0, 3.0]))
    area = walls.width * walls.height * walls.weight
    weight = np.cumsum(area * np.exp(0.7 * rng.standard_normal((len(kinds), len(area)))), 1)
    on = [np.searchsorted(w, w[-1] * rng.random(n)) for w, n in zip(weight, counts, strict=True)]
    local = np.concatenate([kind(walls, chosen, rng) for kind, chosen in zip(kinds, on, strict=True)], 1)
    wall = np.concatenate(on)
    flat = walls.start[wall] + local[0, :, None] * walls.along[wall] + local[2, :, None] * walls.normal[wall]
    return Surface(upright(flat, np.abs(local[1])), upright(walls.normal[wall], np.zeros(count)), found_again)


def before(walls: Walls, view: Viewpoint) -> Walls:
    """The walls with fewer points on those that a camera at the viewpoint sees from behind or not at all."""
    middle = walls.start + walls.width[:, None] / 2 * walls.along
    towards = view.centre[:2] - middle
    ahead = (towards * (view.centre - view.target)[:2]).sum(-1) > 0
    seen = ahead & ((towards * walls.normal).sum(-1) > 0)
    return walls._replace(weight=walls.weight * np.where(seen, 1.0, OTHER_SIDES))


def upright(flat: Array, up: Array) -> Array:
    """(n, 3) of (n, 2) and the heights (n,)."""
    points = np.empty((len(flat), 3))
    points[:, :2], points[:, 2] = flat, up
    return points


def _windows(walls: Walls, on: NDArray[np.int64], rng: np.random.Generator) -> Array:
    """(3, n): along the wall, up, and out of it; corners of the windows of a grid and points in them, all alike."""
    k = len(walls.width)
    columns = np.ceil(walls.width / (walls.cell * rng.uniform(0.6, 1.6, k)))
    rows = np.ceil(walls.height / (walls.cell * rng.uniform(0.8, 1.4, k)))
    pattern = rng.uniform(-0.4, 0.4, (2, k, WINDOW_POINTS))
    pattern[:, :, :4] = rng.uniform(0.15, 0.4, (2, k, 1)) * np.array([[[-1, 1, -1, 1]], [[-1, -1, 1, 1]]])
    recess = -rng.uniform(0, 0.15, (k, 1)) * walls.cell[:, None] * (rng.random((k, WINDOW_POINTS)) < 0.6)
    if rng.random() < 0.3:
        pattern, recess = np.repeat(pattern[:, :1], k, 1), np.repeat(recess[:1], k, 0)
    uneven = rng.uniform(0.6, 1.8, (2, k))  # windows at one end have more points
    which = rng.integers(0, WINDOW_POINTS, len(on))
    cells = np.array([columns, rows])
    place = 0.012 * walls.cell[on] * rng.standard_normal((3, len(on)))
    cell = np.floor(rng.random((2, len(on))) ** uneven[:, on] * cells[:, on]) + 0.5
    place[:2] += (cell + pattern[:, on, which]) * (np.array([walls.width, walls.height]) / cells)[:, on]
    place[2] += recess[on, which]
    return place


def _ledges(walls: Walls, on: NDArray[np.int64], rng: np.random.Generator) -> Array:
    k = len(walls.width)
    level = rng.random((k, LEDGES)) * walls.height[:, None]
    out = rng.uniform(0, 0.2, (k, LEDGES)) * walls.cell[:, None]
    which = rng.integers(0, LEDGES, len(on))
    place = 0.02 * walls.cell[on] * rng.standard_normal((3, len(on)))
    place[0] = rng.random(len(on)) * walls.width[on]
    place[1] += level[on, which]
    place[2] += out[on, which]
    return place


def _patches(walls: Walls, on: NDArray[np.int64], rng: np.random.Generator) -> Array:
    """Clusters such as doors, signs and statues, in relief."""
    k = len(walls.width)
    centre = rng.random((2, k, PATCHES)) * np.array([walls.width, walls.height])[:, :, None]
    spread = rng.uniform(0.1, 0.8, (3, k, PATCHES)) * np.array([1.0, 1.0, 0.2])[:, None, None] * walls.cell[:, None]
    which = (PATCHES * rng.random(len(on)) ** 2).astype(np.int64)
    place = spread[:, on, which] * rng.standard_normal((3, len(on)))
    place[:2] += centre[:, on, which]
    return place


def _plain(walls: Walls, on: NDArray[np.int64], rng: np.random.Generator) -> Array:
    return rng.random((3, len(on))) * np.array([walls.width, walls.height, np.full(len(walls.width), 0.05)])[:, on]
