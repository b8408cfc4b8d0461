"""Kinds of scenes: buildings from outside, streets from within, objects from around; and their surfaces."""

import math

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from bpnp.arrays import Array
from bpnp.datamodules.synthetic_maps.scene import (
    Blobs,
    DrawnScene,
    Surface,
    Viewpoint,
    Walls,
    assemble,
    directions,
    join_walls,
    right_of,
)

WINDOW_POINTS, LEDGES, PATCHES = 14, 5, 8  # of each wall
OTHER_SIDES = 0.2  # density of points on walls that the camera cannot see, relative to the others
RELIEF = 0.8  # depth of the relief of a facade (recessed windows, balconies), metres
FACADE_CELL = 3.2  # metres between two windows
GROUND_PATCHES = 8
CLUSTERS = 14  # clusters of the points of an ellipsoid, some of them almost empty
SPREAD = (0.15, 1.5)  # smallest and largest standard deviation of a cluster on the unit sphere
PLAIN = (0.2, 0.9)  # smallest and largest fraction of evenly spread points of an ellipsoid


def alike_walls(
    start: Array,
    along: Array,
    width: Array,
    height: Array,
    *,
    cell: float = FACADE_CELL,
    relief: float = RELIEF,
    weight: float = 1.0,
) -> Walls:
    """Return walls that differ only in position and size; the outside is on the right of `along`. See `Walls`."""
    alike = (np.full(len(width), value) for value in (weight, cell, relief))
    return Walls(start, along, right_of(along), width, height, *alike)


def box_walls(centre: Array, half: Array, yaw: Array, height: Array, **alike: float) -> Walls:
    """Return the four walls of each of b boxes, whose centres and half widths are (b, 2), angles and heights (b,).

    Lengths are in metres, angles in radians; `alike` are options of `alike_walls`.
    """
    along = directions((yaw[:, None] + np.pi / 2 * np.arange(4)).ravel())  # counter-clockwise
    ahead, right = half[:, [0, 1, 0, 1]].ravel(), half[:, [1, 0, 1, 0]].ravel()
    start = np.repeat(centre, 4, 0) + right[:, None] * right_of(along) - ahead[:, None] * along
    return alike_walls(start, along, 2 * ahead, np.repeat(height, 4), **alike)


def wall_points(walls: Walls, count: int, rng: np.random.Generator) -> Surface:
    """Draw points on walls.

    Each kind of points prefers its own walls. In some scenes all walls have the same pattern.
    """
    kinds = (_windows, _ledges, _patches, _plain)
    counts = rng.multinomial(count, rng.dirichlet([3.0, 1.0, 2.0, 3.0]))
    area = walls.width * walls.height * walls.weight
    weight = np.cumsum(area * np.exp(0.7 * rng.standard_normal((len(kinds), len(area)))), 1)
    on = [np.searchsorted(w, w[-1] * rng.random(n)) for w, n in zip(weight, counts, strict=True)]
    local = np.concatenate([kind(walls, chosen, rng) for kind, chosen in zip(kinds, on, strict=True)], 1)
    wall = np.concatenate(on)
    flat = walls.start[wall] + local[0, :, None] * walls.along[wall] + local[2, :, None] * walls.normal[wall]
    return Surface(upright(flat, np.abs(local[1])), upright(walls.normal[wall], np.zeros(count)), 0.5)


def thin_hidden_walls(walls: Walls, view: Viewpoint) -> Walls:
    """Reduce the density of points on walls that the viewpoint sees from behind or not at all."""
    midpoint = walls.start + walls.width[:, None] / 2 * walls.along
    towards = view.centre[:2] - midpoint
    ahead = (towards * (view.centre - view.target)[:2]).sum(-1) > 0
    visible = ahead & ((towards * walls.normal).sum(-1) > 0)
    return walls._replace(weight=walls.weight * np.where(visible, 1.0, OTHER_SIDES))


def upright(flat: Array, up: Array) -> Array:
    """Return (n, 3) from (n, 2) and the heights (n,)."""
    points = np.empty((len(flat), 3))
    points[:, :2], points[:, 2] = flat, up
    return points


def column_points(walls: Walls, count: int, rng: np.random.Generator) -> Surface:
    """Draw points on a row of columns before the first wall, or on a tower next to it, many of them on rings."""
    columns = int(rng.integers(1, 9))
    tower = columns == 1
    radius = rng.uniform(2, 5) if tower else rng.uniform(0.3, 0.8)
    height = walls.height[0] * (rng.uniform(1, 1.8) if tower else rng.uniform(0.4, 0.9))
    foot = walls.start[0] + walls.normal[0] * rng.uniform(1, 4) - walls.along[0] * (2 * radius if tower else 0)
    along = (rng.integers(0, columns, count) + 0.5) / columns * (0 if tower else walls.width[0])
    angle, up = rng.uniform(0, 2 * np.pi, count), rng.random(count)
    rings = rng.random(5)[rng.integers(0, 5, count)]
    up = np.where(rng.random(count) < 0.6, rings + 0.01 * rng.standard_normal(count), up)
    outward = directions(angle)
    points = foot + along[:, None] * walls.along[0] + radius * outward
    return Surface(upright(points, height * np.abs(up)), upright(outward, np.zeros(count)), 0.5)


def tree_points(low: Array, high: Array, count: int, rng: np.random.Generator) -> Surface:
    """Draw points of up to five fuzzy blobs with centres between two corners (3,) of a box."""
    trees = int(rng.integers(1, 6))
    centre = rng.uniform(low, high, (trees, 3))
    spread = rng.uniform(0.05, 0.25, (trees, 3)) * (high[2] - low[2] + 1)
    which = rng.integers(0, trees, count)
    points = centre[which] + spread[which] * rng.standard_normal((count, 3))
    np.abs(points[:, 2], out=points[:, 2])
    return Surface(points, np.zeros((count, 3)), 0.25)


def ground_points(low: Array, high: Array, count: int, rng: np.random.Generator) -> Surface:
    """Draw points on the ground in patches, between two corners (2,); their normals point upwards."""
    centre = rng.uniform(low, high, (GROUND_PATCHES, 2))
    spread = rng.uniform(0.03, 0.5, (GROUND_PATCHES, 1)) * np.abs(high - low)
    which = rng.integers(0, GROUND_PATCHES, count)
    flat = centre[which] + spread[which] * rng.standard_normal((count, 2))
    normals = np.zeros((count, 3))
    normals[:, 2] = 1.0
    return Surface(upright(flat, 0.003 * spread.max() * rng.standard_normal(count)), normals, 0.4)


def horizon_points(centre: Array, distance: float, count: int, rng: np.random.Generator) -> Surface:
    """Draw hills, clouds and houses in clusters around a centre (3,), from `distance` to twenty times as far."""
    clusters = int(rng.integers(4, 12))
    around = rng.uniform(0, 2 * np.pi, clusters)
    far = distance * 20 ** rng.random(clusters)
    cluster_centre = centre + upright(far[:, None] * directions(around), rng.uniform(0, 0.25, clusters) * far)
    which = rng.integers(0, clusters, count)
    points = cluster_centre[which] + (0.2 * far)[which, None] * rng.standard_normal((count, 3)) * [1.0, 1.0, 0.4]
    return Surface(points, np.zeros((count, 3)), 0.3)


def blob_points(blobs: Blobs, count: int, rng: np.random.Generator) -> Surface:
    """Draw `count` points in clusters on the ellipsoids.

    Of 1.5 times as many, those outside of all other ellipsoids are taken first, and others only if these are too few.
    """
    parts = len(blobs.centre)
    drawn = count + count // 2
    on = rng.choice(parts, drawn, p=rng.dirichlet(np.full(parts, 2.0)))
    cluster_centre = rng.standard_normal((parts, CLUSTERS, 3))
    spread = SPREAD[0] * (SPREAD[1] / SPREAD[0]) ** rng.random((parts, CLUSTERS))
    cluster = (CLUSTERS * rng.random(drawn) ** 1.5).astype(int)
    unit = cluster_centre[on, cluster] / np.linalg.norm(cluster_centre[on, cluster], axis=-1, keepdims=True)
    unit = unit + spread[on, cluster][:, None] * rng.standard_normal((drawn, 3))
    plain = rng.random(drawn) < rng.uniform(*PLAIN)
    unit[plain] = rng.standard_normal((int(plain.sum()), 3))
    unit /= np.linalg.norm(unit, axis=-1, keepdims=True)
    from_sphere = np.linalg.inv(blobs.to_sphere)
    points = blobs.centre[on] + np.einsum("nij,nj->ni", from_sphere[on], unit)
    normals = np.einsum("nij,ni->nj", blobs.to_sphere[on], unit)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    offset = np.einsum("kij,kj->ki", blobs.to_sphere, blobs.centre)
    depth = np.stack([((points @ blobs.to_sphere[k].T - offset[k]) ** 2).sum(-1) for k in range(parts)], 1)
    depth[np.arange(drawn), on] = np.inf
    chosen = np.argsort(depth.min(1) < 1, kind="stable")[:count]
    return Surface(points[chosen], normals[chosen], 0.55)


def _windows(walls: Walls, on: NDArray[np.int64], rng: np.random.Generator) -> Array:
    """Return points of a grid of windows, all alike: (3, n) along the wall, up, and out of it."""
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
    local = 0.012 * walls.cell[on] * rng.standard_normal((3, len(on)))
    cell = np.floor(rng.random((2, len(on))) ** uneven[:, on] * cells[:, on]) + 0.5
    local[:2] += (cell + pattern[:, on, which]) * (np.array([walls.width, walls.height]) / cells)[:, on]
    local[2] += recess[on, which]
    return local


def _ledges(walls: Walls, on: NDArray[np.int64], rng: np.random.Generator) -> Array:
    k = len(walls.width)
    level = rng.random((k, LEDGES)) * walls.height[:, None]
    out = rng.uniform(0, 0.2, (k, LEDGES)) * walls.cell[:, None]
    which = rng.integers(0, LEDGES, len(on))
    local = 0.02 * walls.cell[on] * rng.standard_normal((3, len(on)))
    local[0] = rng.random(len(on)) * walls.width[on]
    local[1] += level[on, which]
    local[2] += out[on, which]
    return local


def _patches(walls: Walls, on: NDArray[np.int64], rng: np.random.Generator) -> Array:
    """Return clusters such as doors, signs and statues, in relief: (3, n) as `_windows`."""
    k = len(walls.width)
    centre = rng.random((2, k, PATCHES)) * np.array([walls.width, walls.height])[:, :, None]
    spread = rng.uniform(0.1, 0.8, (3, k, PATCHES)) * np.array([1.0, 1.0, 0.2])[:, None, None] * walls.cell[:, None]
    which = (PATCHES * rng.random(len(on)) ** 2).astype(np.int64)
    local = spread[:, on, which] * rng.standard_normal((3, len(on)))
    local[:2] += centre[:, on, which]
    return local


def _plain(walls: Walls, on: NDArray[np.int64], rng: np.random.Generator) -> Array:
    return rng.random((3, len(on))) * np.array([walls.width, walls.height, np.full(len(walls.width), 0.05)])[:, on]


MAIN_WEIGHT = 3.0  # density of points on the main building, relative to the others
TELE = 0.15  # half of the image over the focal length, below which the camera distance stays the same
CROSS_SECTION = 0.9  # half width of a pedestal, relative to the radius of its statue
EYE = (1.2, 2.0)  # smallest and largest height of the camera, metres


def facades(count: int, half: float, rng: np.random.Generator) -> tuple[DrawnScene, Viewpoint]:
    """Draw a scene of one to three walls in a line with corners, mostly at right angles; columns, trees and boxes.

    `half` is half of the longer side of the image over the focal length.
    """
    main = _corner_walls(int(rng.integers(1, 4)), rng)
    boxes = int(rng.integers(0, 5))
    first = main.start[0] + main.width[0] / 2 * main.along[0]
    away = rng.uniform(20, 60, (boxes, 1)) * directions(rng.uniform(0, 2 * np.pi, boxes))
    size, yaw, tall = rng.uniform(3, 10, (boxes, 2)), rng.uniform(0, 2 * np.pi, boxes), rng.uniform(4, 20, boxes)
    view = _before_wall(main, int(rng.integers(len(main.width))), half, rng)
    walls = join_walls([main, box_walls(first + away, size, yaw, tall)])
    shares = np.array([rng.random() < 0.6, 1, 1, 1])
    shares = rng.uniform([0.0, 0.02, 0.02, 0.0], [0.25, 0.2, 0.15, 0.1]) * shares
    on_columns, on_trees, on_ground, far = (shares * count).astype(int).tolist()
    low, high = first - main.width[0] * np.ones(2), first + main.width[0] * np.ones(2)
    yard, reach = first + rng.uniform(2, 20) * main.normal[0], main.width[0] / 2
    surfaces = [
        wall_points(thin_hidden_walls(walls, view), count - on_columns - on_trees - on_ground - far, rng),
        column_points(walls, on_columns, rng),
        tree_points(np.array([*low, 1.0]), np.array([*high, 7.0]), on_trees, rng),
        ground_points(yard - reach, yard + reach, on_ground, rng),
        horizon_points(np.array([*first, 0.0]), 60.0, far, rng),
    ]
    return assemble(surfaces, walls, rng), view


def street(count: int, half: float, rng: np.random.Generator) -> tuple[DrawnScene, Viewpoint]:
    """Draw a scene of houses on both sides of a street, some of them identical; cars, trees and poles.

    The camera is within the scene: depths vary strongly, and other photos are near. `half` is not used.
    """
    del half
    houses = int(rng.integers(3, 9))
    across, deep = rng.uniform(4, 12), rng.uniform(4, 8)
    width, tall = rng.uniform(4, 14, (2, houses)), rng.uniform(5, 18, (2, houses))
    if rng.random() < 0.4:
        width[:], tall[:] = width[0, 0], tall[0, 0]
    along = np.cumsum(width, 1) - width / 2
    level = np.zeros(houses)
    sides = []
    for k, side in enumerate((across + deep, -across - deep)):
        size = np.stack([width[k] / 2, np.full(houses, deep)], -1)
        sides.append(box_walls(np.stack([along[k], np.full(houses, side)], -1), size, level, tall[k]))
    cars = int(rng.integers(0, 6))
    length = float(width.sum(1).min())
    parked = np.stack([rng.uniform(0, length, cars), rng.choice([-0.75, 0.75], cars) * across], -1)
    half_size = np.tile([2.2, 0.9], (cars, 1))
    walls = join_walls([*sides, box_walls(parked, half_size, np.zeros(cars), np.full(cars, 1.5), cell=0.8, weight=3.0)])
    position = np.array([length * rng.uniform(0.05, 0.7), rng.uniform(-0.8, 0.8) * across, rng.uniform(*EYE)])
    heading, rising = rng.choice([0.0, np.pi]) + rng.normal(0, 0.5), 0.08 * rng.standard_normal()
    ahead = np.array([np.cos(rising) * np.cos(heading), np.cos(rising) * np.sin(heading), np.sin(rising)])
    target = position + 8.0 * 4 ** rng.uniform(-0.5, 0.8) * ahead
    view = Viewpoint(position, target, orbit=0.05, shift=0.08, heading=0.08, parallax=(5e-4, 0.1))
    shares = rng.uniform([0.02, 0.03, 0.0], [0.25, 0.2, 0.35])
    on_trees, on_ground, far = (shares * count).astype(int).tolist()
    surfaces = [
        wall_points(thin_hidden_walls(walls, view), count - on_trees - on_ground - far, rng),
        tree_points(np.array([0.0, -across, 1.5]), np.array([length, across, 6.0]), on_trees, rng),
        ground_points(np.array([0.0, -across]), np.array([length, across]), on_ground, rng),
        horizon_points(np.zeros(3), 80.0, far, rng),
    ]
    return assemble(surfaces, walls, rng), view


def statue(count: int, half: float, rng: np.random.Generator) -> tuple[DrawnScene, Viewpoint]:
    """Draw a figure of stacked parts, often on a pedestal, before distant houses; 1 to 40 metres high.

    `half` is half of the longer side of the image over the focal length.
    """
    tall, parts = 40 ** rng.random(), int(rng.integers(4, 13))
    foot = tall * (rng.uniform(0.1, 0.7) if rng.random() < 0.7 else 0.02)
    height = foot + tall * np.sort(rng.random(parts))
    radii = tall * rng.uniform(0.08, 0.3, (parts, 3)) * [0.6, 0.6, 1.2]
    centre = np.stack([*(0.5 * radii[:, :2].max() * rng.standard_normal((2, parts))), height], -1)
    rotation = Rotation.from_rotvec(0.5 * rng.standard_normal((parts, 3))).as_matrix()
    blobs = Blobs(centre, rotation.swapaxes(1, 2) / radii[:, :, None])
    side, yaw = np.full((1, 2), CROSS_SECTION * radii[:, :2].max()), rng.uniform(0, 1.5, 1)
    cell = max(0.1, 0.25 * foot)
    pedestal = box_walls(np.zeros((1, 2)), side, yaw, np.array([foot]), cell=cell, relief=0.02 * foot)
    houses = int(rng.integers(0, 4))
    position = tall * rng.uniform(3, 10, (houses, 1)) * directions(rng.uniform(0, 2 * np.pi, houses))
    size, yaw = tall * rng.uniform(0.5, 2, (houses, 2)), rng.uniform(0, 3, houses)
    behind = box_walls(position, size, yaw, tall * rng.uniform(0.3, 1.5, houses), cell=0.2 * tall, weight=0.05)
    walls = join_walls([pedestal, behind])
    on_walls, on_ground, far = (rng.uniform([0.1, 0.0, 0.0], [0.4, 0.15, 0.25]) * count).astype(int).tolist()
    surfaces = [
        blob_points(blobs, count - on_walls - on_ground - far, rng),
        ground_points(np.full(2, -tall), np.full(2, tall), on_ground, rng),
        horizon_points(np.zeros(3), 8 * tall, far, rng),
        wall_points(walls, on_walls, rng),
    ]
    scene = assemble(surfaces, walls, rng, blobs)
    target = np.array([0.0, 0.0, foot + tall * rng.uniform(0.2, 0.7)])
    # Anywhere around, up to 25 degrees above or below; it fills 0.3 to 1.2 of the image.
    rising = math.radians(rng.uniform(-25, 25))
    distance = tall / (2 * max(half, TELE)) * 4 ** rng.uniform(-0.1, 0.9)
    around = rng.uniform(0, 2 * np.pi)
    away = np.array([math.cos(rising) * math.cos(around), math.cos(rising) * math.sin(around), math.sin(rising)])
    return scene, Viewpoint(target + distance * away, target, orbit=0.3, shift=0.2, heading=0.05, parallax=(0.02, 0.5))


def _before_wall(walls: Walls, wall: int, half: float, rng: np.random.Generator) -> Viewpoint:
    """Draw a camera before a wall, mostly at eye level, so that the wall fills 0.4 to 2 of the image."""
    width, height = float(walls.width[wall]), float(walls.height[wall])
    angle = float(np.clip(rng.normal(0, math.radians(30)), -1.15, 1.15))  # to the normal
    away = math.cos(angle) * walls.normal[wall] + math.sin(angle) * walls.along[wall]
    distance = max(3.0, math.sqrt(width * height) / (2 * max(half, TELE)) * 5 ** rng.uniform(-0.45, 0.55))
    flat = walls.start[wall] + width * rng.uniform(0.15, 0.85) * walls.along[wall]
    up = rng.uniform(1.4, 2.5) if rng.random() < 0.7 else rng.uniform(0, 0.8 * height)
    target = np.array([*flat, height * rng.uniform(0.15, 0.75)])
    return Viewpoint(
        np.array([*(flat + distance * away), up]), target, orbit=0.25, shift=0.2, heading=0.1, parallax=(0.02, 0.5)
    )


def _corner_walls(count: int, rng: np.random.Generator) -> Walls:
    chance = rng.random((3, count))
    turn = np.where(chance[0] < 0.65, 1, -1) * np.where(chance[1] < 0.2, 0.6 + 1.4 * chance[2], np.pi / 2)
    along = directions(np.cumsum(turn) - turn[0])
    width = rng.uniform(8, 30, count)
    start = np.cumsum(width[:, None] * along, 0) - width[:, None] * along
    height = rng.uniform(6, 25) * rng.uniform(0.7, 1.1, count)
    return alike_walls(start, along, width, height, weight=MAIN_WEIGHT)
