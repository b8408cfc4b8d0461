"""The kinds of scenes: buildings from outside, streets from within, and objects seen from around."""

import math

import numpy as np
from scipy.spatial.transform import Rotation

from bpnp.datamodules.synthetic_maps.scene import (
    Blobs,
    Scene,
    Viewpoint,
    Walls,
    assembled,
    directions,
    joined,
    right_of,
)
from bpnp.datamodules.synthetic_maps.surfaces import (
    FACADE_CELL,
    RELIEF,
    before,
    blob_points,
    box_walls,
    column_points,
    ground_points,
    horizon_points,
    tree_points,
    wall_points,
)

MAIN_WEIGHT = 3.0  # points on an area of the building that is looked at, of those on as much of another
TELE = 0.15  # half of the image over the focal length; from narrower views the camera steps back no further
CROSS_SECTION = 0.9  # of a pedestal, of its statue's radius
EYE = (1.2, 2.0)  # metres above the ground, lowest and highest


def facades(count: int, half: float, rng: np.random.Generator) -> tuple[Scene, Viewpoint]:
    """One to three walls in a line, each a corner with the last, mostly at right angles; columns, trees, boxes."""
    main = _corner_walls(int(rng.integers(1, 4)), rng)
    boxes = int(rng.integers(0, 5))
    first = main.start[0] + main.width[0] / 2 * main.along[0]
    away = rng.uniform(20, 60, (boxes, 1)) * directions(rng.uniform(0, 2 * np.pi, boxes))
    size, yaw, tall = rng.uniform(3, 10, (boxes, 2)), rng.uniform(0, 2 * np.pi, boxes), rng.uniform(4, 20, boxes)
    view = _before_wall(main, int(rng.integers(len(main.width))), half, rng)
    walls = joined([main, box_walls(first + away, size, yaw, tall)])
    shares = np.array([rng.random() < 0.6, 1, 1, 1])
    shares = rng.uniform([0.0, 0.02, 0.02, 0.0], [0.25, 0.2, 0.15, 0.1]) * shares
    on_columns, on_trees, on_ground, far = (shares * count).astype(int).tolist()
    low, high = first - main.width[0] * np.ones(2), first + main.width[0] * np.ones(2)
    yard, reach = first + rng.uniform(2, 20) * main.normal[0], main.width[0] / 2
    surfaces = [
        wall_points(before(walls, view), count - on_columns - on_trees - on_ground - far, rng),
        column_points(walls, on_columns, rng),
        tree_points(np.array([*low, 1.0]), np.array([*high, 7.0]), on_trees, rng),
        ground_points(yard - reach, yard + reach, on_ground, rng),
        horizon_points(np.array([*first, 0.0]), 60.0, far, rng),
    ]
    return assembled(surfaces, rng, walls=walls), view


def street(count: int, half: float, rng: np.random.Generator) -> tuple[Scene, Viewpoint]:
    """Houses on both sides of a street, some of them twins, cars, trees and poles; a walk along it.

    The camera is within the scene: depths vary strongly, and other photos are near by.
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
    walls = joined([*sides, box_walls(parked, half_size, np.zeros(cars), np.full(cars, 1.5), cell=0.8, weight=3.0)])
    place = np.array([length * rng.uniform(0.05, 0.7), rng.uniform(-0.8, 0.8) * across, rng.uniform(*EYE)])
    heading, rising = rng.choice([0.0, np.pi]) + rng.normal(0, 0.5), 0.08 * rng.standard_normal()
    ahead = np.array([np.cos(rising) * np.cos(heading), np.cos(rising) * np.sin(heading), np.sin(rising)])
    target = place + 8.0 * 4 ** rng.uniform(-0.5, 0.8) * ahead
    view = Viewpoint(place, target, orbit=0.05, shift=0.08, heading=0.08, parallax=(5e-4, 0.1))
    shares = rng.uniform([0.02, 0.03, 0.0], [0.25, 0.2, 0.35])
    on_trees, on_ground, far = (shares * count).astype(int).tolist()
    surfaces = [
        wall_points(before(walls, view), count - on_trees - on_ground - far, rng),
        tree_points(np.array([0.0, -across, 1.5]), np.array([length, across, 6.0]), on_trees, rng),
        ground_points(np.array([0.0, -across]), np.array([length, across]), on_ground, rng),
        horizon_points(np.zeros(3), 80.0, far, rng),
    ]
    return assembled(surfaces, rng, walls=walls), view


def statue(count: int, half: float, rng: np.random.Generator) -> tuple[Scene, Viewpoint]:
    """A figure of stacked and attached parts, often on a pedestal, before houses far away; 1 to 40 metres high."""
    tall, parts = 40 ** rng.random(), int(rng.integers(4, 13))
    foot = tall * (rng.uniform(0.1, 0.7) if rng.random() < 0.7 else 0.02)
    height = foot + tall * np.sort(rng.random(parts))
    radii = tall * rng.uniform(0.08, 0.3, (parts, 3)) * [0.6, 0.6, 1.2]
    centre = np.stack([*(0.5 * radii[:, :2].max() * rng.standard_normal((2, parts))), height], -1)
    turn = Rotation.from_rotvec(0.5 * rng.standard_normal((parts, 3))).as_matrix()
    blobs = Blobs(centre, turn.swapaxes(1, 2) / radii[:, :, None])
    side, yaw = np.full((1, 2), CROSS_SECTION * radii[:, :2].max()), rng.uniform(0, 1.5, 1)
    cell = max(0.1, 0.25 * foot)
    pedestal = box_walls(np.zeros((1, 2)), side, yaw, np.array([foot]), cell=cell, relief=0.02 * foot)
    houses = int(rng.integers(0, 4))
    place = tall * rng.uniform(3, 10, (houses, 1)) * directions(rng.uniform(0, 2 * np.pi, houses))
    size, yaw = tall * rng.uniform(0.5, 2, (houses, 2)), rng.uniform(0, 3, houses)
    behind = box_walls(place, size, yaw, tall * rng.uniform(0.3, 1.5, houses), cell=0.2 * tall, weight=0.05)
    walls = joined([pedestal, behind])
    on_walls, on_ground, far = (rng.uniform([0.1, 0.0, 0.0], [0.4, 0.15, 0.25]) * count).astype(int).tolist()
    surfaces = [
        blob_points(blobs, count - on_walls - on_ground - far, rng),
        ground_points(np.full(2, -tall), np.full(2, tall), on_ground, rng),
        horizon_points(np.zeros(3), 8 * tall, far, rng),
        wall_points(walls, on_walls, rng),
    ]
    scene = assembled(surfaces, rng, walls=walls, blobs=blobs)
    target = np.array([0.0, 0.0, foot + tall * rng.uniform(0.2, 0.7)])
    # Anywhere around, up to 25 degrees above or below; it fills 0.3 to 1.2 of the image.
    rising = math.radians(rng.uniform(-25, 25))
    distance = tall / (2 * max(half, TELE)) * 4 ** rng.uniform(-0.1, 0.9)
    around = rng.uniform(0, 2 * np.pi)
    away = np.array([math.cos(rising) * math.cos(around), math.cos(rising) * math.sin(around), math.sin(rising)])
    return scene, Viewpoint(target + distance * away, target, orbit=0.3, shift=0.2, heading=0.05, parallax=(0.02, 0.5))


def _before_wall(walls: Walls, wall: int, half: float, rng: np.random.Generator) -> Viewpoint:
    """A camera before a wall, mostly at eye level, at which the wall fills 0.4 to 2 of the image."""
    width, height = float(walls.width[wall]), float(walls.height[wall])
    angle = float(np.clip(rng.normal(0, math.radians(30)), -1.15, 1.15))  # from the normal
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
    return Walls(
        start=np.cumsum(width[:, None] * along, 0) - width[:, None] * along,
        along=along,
        normal=right_of(along),
        width=width,
        height=rng.uniform(6, 25) * rng.uniform(0.7, 1.1, count),
        weight=np.full(count, MAIN_WEIGHT),
        cell=np.full(count, FACADE_CELL),
        relief=np.full(count, RELIEF),
    )
