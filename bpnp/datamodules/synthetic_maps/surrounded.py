"""The camera within the scene: streets, courtyards and rooms. Depths vary strongly, and other photos are near by."""

import numpy as np

from bpnp.datamodules.synthetic_maps.scene import Array, Scene, Surface, Viewpoint, Walls, assembled, directions, joined
from bpnp.datamodules.synthetic_maps.surroundings import ground_points, horizon_points, tree_points
from bpnp.datamodules.synthetic_maps.walls import before, box_walls, wall_points

EYE = (1.2, 2.0)  # metres above the ground, lowest and highest


def street(count: int, half: float, rng: np.random.Generator) -> tuple[Scene, Viewpoint]:
    """Houses on both sides of a street, some of them twins, cars, trees and poles; a walk along it."""
    del half
    houses = int(rng.integers(3, 9))
    across, deep = rng.uniform(4, 12), rng.uniform(4, 8)
    width, tall = rng.uniform(4, 14, (2, houses)), rng.uniform(5, 18, (2, houses))
    if rng.random() < 0.4:
        width[:], tall[:] = width[0, 0], tall[0, 0]
    along = np.cumsum(width, 1) - width / 2
    sides = [
        box_walls(
            np.stack([along[k], np.full(houses, (across + deep) * (1 - 2 * k))], -1),
            np.stack([width[k] / 2, np.full(houses, deep)], -1), np.zeros(houses), tall[k],
        )
        for k in (0, 1)
    ]  # fmt: skip
    cars = int(rng.integers(0, 6))
    length = float(width.sum(1).min())
    parked = np.stack([rng.uniform(0, length, cars), rng.choice([-0.75, 0.75], cars) * across], -1)
    half_size = np.tile([2.2, 0.9], (cars, 1))
    walls = joined([*sides, box_walls(parked, half_size, np.zeros(cars), np.full(cars, 1.5), cell=0.8, weight=3.0)])
    where = np.array([length * rng.uniform(0.05, 0.7), rng.uniform(-0.8, 0.8) * across, rng.uniform(*EYE)])
    view = _walk(where, rng.choice([0.0, np.pi]) + rng.normal(0, 0.5), 0.08 * rng.standard_normal(), rng)
    shares = rng.uniform([0.02, 0.03, 0.0], [0.25, 0.2, 0.35])
    ground = np.array([[0.0, -across], [length, across]])
    return _outdoors(walls, view, count, shares, ground, np.c_[ground, [1.5, 6.0]], 80.0, rng), view


def courtyard(count: int, half: float, rng: np.random.Generator) -> tuple[Scene, Viewpoint]:
    """Four facades around a yard, seen from within."""
    del half
    size = rng.uniform(6, 22, (1, 2))
    walls = box_walls(np.zeros((1, 2)), size, np.zeros(1), rng.uniform(5, 16, 1), inwards=True)
    where = np.array([*(rng.uniform(-0.85, 0.85, 2) * size[0]), rng.uniform(*EYE)])
    view = _walk(where, rng.uniform(0, 2 * np.pi), rng.normal(0.1, 0.1), rng)
    shares = rng.uniform([0.0, 0.03, 0.0], [0.2, 0.25, 0.05])
    ground = np.concatenate([-size, size])
    return _outdoors(walls, view, count, shares, ground, np.c_[0.7 * ground, [1.0, 5.0]], 60.0, rng), view


def interior(count: int, half: float, rng: np.random.Generator) -> tuple[Scene, Viewpoint]:
    """A room with furniture, shelves and pictures, and mostly another one beyond an open side."""
    del half
    size, tall = rng.uniform(1.8, 7, 2), float(rng.uniform(2.3, 4.5))
    room = box_walls(np.zeros((1, 2)), size[None], np.zeros(1), np.array([tall]), cell=0.9, relief=0.1, inwards=True)
    rooms = [room]
    if rng.random() < 0.6:
        wide = size * rng.uniform(0.8, 1.6)
        place = np.array([[0.0, -size[1] - wide[1]]])
        beyond = box_walls(place, wide[None], np.zeros(1), np.array([tall]), cell=0.9, relief=0.1, inwards=True)
        rooms = [without(room, 0), without(beyond, 2)]
    pieces = int(rng.integers(2, 9))
    angle = rng.uniform(0, 2 * np.pi, pieces)
    place = directions(angle) * size * rng.uniform(0.3, 0.95, (pieces, 1))
    furniture = box_walls(
        place, rng.uniform(0.2, 0.8, (pieces, 2)), rng.choice([0.0, 0.3], pieces), rng.uniform(0.4, 1.8, pieces),
        cell=0.35, relief=0.08, weight=4.0,
    )  # fmt: skip
    where = np.array([*(rng.uniform(-0.8, 0.8, 2) * size), rng.uniform(1.0, 1.9)])
    heading = float(np.arctan2(*(-where[1::-1]))) + rng.normal(0, 0.9)  # mostly towards the middle
    view = _walk(where, heading, rng.normal(-0.08, 0.12), rng, step=0.4)
    walls = joined([*rooms, furniture])
    on_floor, on_ceiling, on_things = (rng.uniform([0.02, 0.0, 0.0], [0.2, 0.15, 0.25]) * count).astype(int).tolist()
    ceiling = ground_points(-size, size, on_ceiling, rng, up=tall)
    scene = assembled(
        [
            wall_points(before(walls, view), count - on_floor - on_ceiling - on_things, rng),
            ground_points(-size, size, on_floor, rng),
            Surface(ceiling.points, -ceiling.normals, ceiling.found_again),
            tree_points(np.array([*-0.8 * size, 0.3]), np.array([*0.8 * size, 1.2]), on_things, rng),
        ],
        rng,
        walls=walls,
    )
    return scene, view


def without(walls: Walls, wall: int) -> Walls:
    """All walls but one."""
    return Walls(*(np.delete(field, wall, 0) for field in walls))


def _outdoors(
    walls: Walls, view: Viewpoint, count: int, shares: Array, ground: Array, trees: Array, away: float,
    rng: np.random.Generator,
) -> Scene:  # fmt: skip
    """`count` points: `shares` (3,) of them on trees, on the ground and `away` metres or more, the others on the walls.

    ground, trees: lowest and highest corner of the rectangle (2, 2) and of the box (2, 3) that they fill.
    """
    on_trees, on_ground, far = (shares * count).astype(int).tolist()
    surfaces = [
        wall_points(before(walls, view), count - on_trees - on_ground - far, rng),
        tree_points(trees[0], trees[1], on_trees, rng),
        ground_points(ground[0], ground[1], on_ground, rng),
        horizon_points(np.zeros(3), away, far, rng),
    ]
    return assembled(surfaces, rng, walls=walls)


def _walk(
    where: np.ndarray, heading: float, rising: float, rng: np.random.Generator, *, step: float = 1.0
) -> Viewpoint:
    """A camera that looks in a direction, and others within steps of it that look almost the same way."""
    distance = 8.0 * step * 4 ** rng.uniform(-0.5, 0.8)
    ahead = np.array([np.cos(rising) * np.cos(heading), np.cos(rising) * np.sin(heading), np.sin(rising)])
    return Viewpoint(where, where + distance * ahead, orbit=0.05, shift=0.08, heading=0.08, parallax=(5e-4, 0.1))
