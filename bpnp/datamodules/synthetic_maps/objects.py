"""Statues and other objects, seen from around: unions of ellipsoids with clustered, uneven points."""

import math

import numpy as np
from scipy.spatial.transform import Rotation

from bpnp.datamodules.synthetic_maps.buildings import TELE
from bpnp.datamodules.synthetic_maps.scene import Array, Blobs, Scene, Surface, Viewpoint, assembled, directions, joined
from bpnp.datamodules.synthetic_maps.surroundings import ground_points, horizon_points, tree_points
from bpnp.datamodules.synthetic_maps.walls import box_walls, wall_points

CLUSTERS = 14  # of each ellipsoid's points, some of them almost empty
SPREAD = (0.15, 1.5)  # of a cluster on the unit sphere, lowest and highest
PLAIN = (0.2, 0.9)  # share of the points that are spread evenly, lowest and highest
CROSS_SECTION = 0.9  # of a pedestal, of its statue's radius


def statue(count: int, half: float, rng: np.random.Generator) -> tuple[Scene, Viewpoint]:
    """A figure of stacked and attached parts, often on a pedestal, before houses far away; 1 to 40 metres high."""
    tall, parts = 40 ** rng.random(), int(rng.integers(4, 13))
    foot = tall * (rng.uniform(0.1, 0.7) if rng.random() < 0.7 else 0.02)
    height = foot + tall * np.sort(rng.random(parts))
    radii = tall * rng.uniform(0.08, 0.3, (parts, 3)) * [0.6, 0.6, 1.2]
    centre = np.stack([*(0.5 * radii[:, :2].max() * rng.standard_normal((2, parts))), height], -1)
    blobs = _blobs(centre, radii, rng)
    side = np.full((1, 2), CROSS_SECTION * radii[:, :2].max())
    pedestal = box_walls(
        np.zeros((1, 2)), side, rng.uniform(0, 1.5, 1), np.array([foot]),
        cell=max(0.1, 0.25 * foot), relief=0.02 * foot,
    )  # fmt: skip
    houses = int(rng.integers(0, 4))
    behind = box_walls(
        tall * rng.uniform(3, 10, (houses, 1)) * directions(rng.uniform(0, 2 * np.pi, houses)),
        tall * rng.uniform(0.5, 2, (houses, 2)), rng.uniform(0, 3, houses), tall * rng.uniform(0.3, 1.5, houses),
        cell=0.2 * tall, weight=0.05,
    )  # fmt: skip
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
    return scene, _around(target, tall, half, math.radians(rng.uniform(-25, 25)), rng)


def table_top(count: int, half: float, rng: np.random.Generator) -> tuple[Scene, Viewpoint]:
    """A group of rounded objects on a patterned table, seen from above."""
    parts = int(rng.integers(1, 8))
    radii = rng.uniform(0.03, 0.2, (parts, 3))
    place = rng.uniform(-0.3, 0.3, (parts, 2)) * (parts > 1)
    blobs = _blobs(np.concatenate([place, 0.8 * radii[:, 2:]], 1), radii, rng)
    on_table, around = (rng.uniform([0.05, 0.0], [0.6, 0.25]) * count).astype(int).tolist()
    scene = assembled(
        [
            blob_points(blobs, count - on_table - around, rng),
            ground_points(np.full(2, -0.6), np.full(2, 0.6), on_table, rng),
            tree_points(np.array([-2.5, -2.5, 0.0]), np.array([2.5, 2.5, 1.5]), around, rng),
        ],
        rng,
        blobs=blobs,
    )
    return scene, _around(np.array([0.0, 0.0, 0.1]), 0.5, half, math.radians(rng.uniform(10, 80)), rng)


def blob_points(blobs: Blobs, count: int, rng: np.random.Generator) -> Surface:
    """Points in clusters on the ellipsoids, outside of all the others; `count` of them, with repetition if few are."""
    parts = len(blobs.centre)
    drawn = count + count // 2
    on = rng.choice(parts, drawn, p=rng.dirichlet(np.full(parts, 2.0)))
    middle = rng.standard_normal((parts, CLUSTERS, 3))
    spread = SPREAD[0] * (SPREAD[1] / SPREAD[0]) ** rng.random((parts, CLUSTERS))
    cluster = (CLUSTERS * rng.random(drawn) ** 1.5).astype(int)
    unit = middle[on, cluster] / np.linalg.norm(middle[on, cluster], axis=-1, keepdims=True)
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


def _blobs(centre: Array, radii: Array, rng: np.random.Generator) -> Blobs:
    turn = Rotation.from_rotvec(0.5 * rng.standard_normal((len(centre), 3))).as_matrix()
    return Blobs(centre, turn.swapaxes(1, 2) / radii[:, :, None])


def _around(target: Array, size: float, half: float, rising: float, rng: np.random.Generator) -> Viewpoint:
    """A camera anywhere around an object, `rising` radians above it, at which it fills 0.3 to 1.2 of the image."""
    distance = size / (2 * max(half, TELE)) * 4 ** rng.uniform(-0.1, 0.9)
    around = rng.uniform(0, 2 * np.pi)
    away = np.array([math.cos(rising) * math.cos(around), math.cos(rising) * math.sin(around), math.sin(rising)])
    return Viewpoint(target + distance * away, target, orbit=0.3, shift=0.2, heading=0.05, parallax=(0.02, 0.5))
