"""Buildings from outside: a facade with its corners, several buildings in one map, and buildings from the air."""

import math

import numpy as np

from bpnp.datamodules.synthetic_maps.scene import (
    Array,
    Scene,
    Viewpoint,
    Walls,
    assembled,
    directions,
    joined,
    right_of,
)
from bpnp.datamodules.synthetic_maps.surroundings import column_points, ground_points, horizon_points, tree_points
from bpnp.datamodules.synthetic_maps.walls import FACADE_CELL, RELIEF, before, box_walls, wall_points

MAIN_WEIGHT = 3.0  # points on an area of the building that is looked at, of those on as much of another
TELE = 0.15  # half of the image over the focal length; from narrower views the camera steps back no further


def facades(count: int, half: float, rng: np.random.Generator) -> tuple[Scene, Viewpoint]:
    """One to three walls in a line, each a corner with the last, mostly at right angles; columns, trees, boxes."""
    main = _corner_walls(int(rng.integers(1, 4)), rng)
    boxes = int(rng.integers(0, 5))
    middle = main.start[0] + main.width[0] / 2 * main.along[0]
    others = box_walls(
        middle + rng.uniform(20, 60, (boxes, 1)) * directions(rng.uniform(0, 2 * np.pi, boxes)),
        rng.uniform(3, 10, (boxes, 2)), rng.uniform(0, 2 * np.pi, boxes), rng.uniform(4, 20, boxes),
    )  # fmt: skip
    view = before_wall(main, int(rng.integers(len(main.width))), half, rng)
    return _outside(joined([main, others]), view, count, rng, columns=rng.random() < 0.6), view


def several_buildings(count: int, half: float, rng: np.random.Generator) -> tuple[Scene, Viewpoint]:
    """Three to eight blocks on a square, some of them twins; the camera looks at one, across others."""
    blocks = int(rng.integers(3, 9))
    size, tall = rng.uniform(4, 14, (blocks, 2)), rng.uniform(4, 22, blocks)
    if rng.random() < 0.4:
        size[:], tall[:] = size[0], tall[0]
    grid = np.stack(np.meshgrid(np.arange(3), np.arange(3)), -1).reshape(-1, 2)
    cell = rng.permutation(grid)[:blocks] + rng.uniform(-0.12, 0.12, (blocks, 2))
    yaw = 0.1 * rng.standard_normal(blocks) * (rng.random() < 0.5)
    walls = box_walls(rng.uniform(3, 5) * size.mean() * cell, size, yaw, tall)
    outside = np.einsum("ij,ij->i", walls.normal, walls.start - walls.start.mean(0)) > 0
    view = before_wall(walls, int(rng.choice(np.flatnonzero(outside))), half, rng)
    return _outside(walls, view, count, rng, columns=False), view


def from_the_air(count: int, half: float, rng: np.random.Generator) -> tuple[Scene, Viewpoint]:
    """A village seen by a drone, from straight above to 25 degrees above the horizon."""
    houses = int(rng.integers(4, 16))
    extent = rng.uniform(25, 70)
    size, tall = rng.uniform(3, 9, (houses, 2)), rng.uniform(3, 10, houses)
    centre = rng.uniform(-extent, extent, (houses, 2))
    walls = box_walls(centre, size, rng.uniform(0, np.pi, houses), tall)
    down, around = math.radians(rng.uniform(25, 90)), rng.uniform(0, 2 * np.pi)
    target = np.array([*rng.uniform(-0.4 * extent, 0.4 * extent, 2), 0.0])
    distance = extent * rng.uniform(0.5, 1.3) / max(half, TELE)
    away = np.array([math.cos(down) * math.cos(around), math.cos(down) * math.sin(around), math.sin(down)])
    view = Viewpoint(target + distance * away, target, orbit=0.2, shift=0.25, heading=0.06, parallax=(0.02, 0.5))
    on_roofs, on_ground, on_trees = (rng.dirichlet([4.0, 3.0, 1.0, 4.0])[:3] * count).astype(int).tolist()
    roofs = [
        ground_points(centre[k] - size[k].min(), centre[k] + size[k].min(), on_roofs // houses, rng, up=tall[k])
        for k in range(houses)
    ]  # fmt: skip
    left = count - sum(len(roof.points) for roof in roofs) - on_ground - on_trees
    corner = np.full(2, extent)
    scene = assembled(
        [
            wall_points(before(walls, view), left, rng),
            *roofs,
            ground_points(-corner, corner, on_ground, rng),
            tree_points(np.array([*-corner, 2.0]), np.array([*corner, 6.0]), on_trees, rng),
        ],
        rng,
        walls=walls,
    )
    return scene, view


def before_wall(walls: Walls, wall: int, half: float, rng: np.random.Generator) -> Viewpoint:
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


def _outside(walls: Walls, view: Viewpoint, count: int, rng: np.random.Generator, *, columns: bool) -> Scene:
    """Walls with trees and ground before them and a horizon behind."""
    shares = rng.uniform([0.0, 0.02, 0.02, 0.0], [0.25, 0.2, 0.15, 0.1]) * [columns, 1, 1, 1]
    on_columns, on_trees, on_ground, far = (shares * count).astype(int).tolist()
    first = walls.start[0] + walls.width[0] / 2 * walls.along[0]
    low, high = first - walls.width[0] * np.ones(2), first + walls.width[0] * np.ones(2)
    yard: Array = first + rng.uniform(2, 20) * walls.normal[0]
    reach = walls.width[0] / 2
    return assembled(
        [
            wall_points(before(walls, view), count - on_columns - on_trees - on_ground - far, rng),
            column_points(walls, on_columns, rng),
            tree_points(np.array([*low, 1.0]), np.array([*high, 7.0]), on_trees, rng),
            ground_points(yard - reach, yard + reach, on_ground, rng),
            horizon_points(np.array([*first, 0.0]), 60.0, far, rng),
        ],
        rng,
        walls=walls,
    )
