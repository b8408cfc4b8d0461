"""What stands around: columns, trees, ground and, far away, what is hardly ever in a map."""

import numpy as np

from bpnp.datamodules.synthetic_maps.scene import Array, Surface, Walls, directions
from bpnp.datamodules.synthetic_maps.walls import upright

GROUND_PATCHES = 8


def column_points(walls: Walls, count: int, rng: np.random.Generator) -> Surface:
    """A row of columns before the first wall, or a tower beside it; many points on the rings around them."""
    columns = int(rng.integers(1, 9))
    tower = columns == 1
    radius = rng.uniform(2, 5) if tower else rng.uniform(0.3, 0.8)
    height = walls.height[0] * (rng.uniform(1, 1.8) if tower else rng.uniform(0.4, 0.9))
    foot = walls.start[0] + walls.normal[0] * rng.uniform(1, 4) - walls.along[0] * (2 * radius if tower else 0)
    place = (rng.integers(0, columns, count) + 0.5) / columns * (0 if tower else walls.width[0])
    angle, up = rng.uniform(0, 2 * np.pi, count), rng.random(count)
    rings = rng.random(5)[rng.integers(0, 5, count)]
    up = np.where(rng.random(count) < 0.6, rings + 0.01 * rng.standard_normal(count), up)
    outward = directions(angle)
    points = foot + place[:, None] * walls.along[0] + radius * outward
    return Surface(upright(points, height * np.abs(up)), upright(outward, np.zeros(count)), 0.5)


def tree_points(low: Array, high: Array, count: int, rng: np.random.Generator) -> Surface:
    """Up to five fuzzy blobs with their centres between two corners (3,) of a box."""
    trees = int(rng.integers(1, 6))
    centre = rng.uniform(low, high, (trees, 3))
    spread = rng.uniform(0.05, 0.25, (trees, 3)) * (high[2] - low[2] + 1)
    which = rng.integers(0, trees, count)
    points = centre[which] + spread[which] * rng.standard_normal((count, 3))
    np.abs(points[:, 2], out=points[:, 2])
    return Surface(points, np.zeros((count, 3)), 0.25)


def ground_points(low: Array, high: Array, count: int, rng: np.random.Generator, *, up: float = 0.0) -> Surface:
    """A level in patches, between two corners (2,), at a height; every point is turned upwards."""
    centre = rng.uniform(low, high, (GROUND_PATCHES, 2))
    spread = rng.uniform(0.03, 0.5, (GROUND_PATCHES, 1)) * np.abs(high - low)
    which = rng.integers(0, GROUND_PATCHES, count)
    flat = centre[which] + spread[which] * rng.standard_normal((count, 2))
    normals = np.zeros((count, 3))
    normals[:, 2] = 1.0
    return Surface(upright(flat, up + 0.003 * spread.max() * rng.standard_normal(count)), normals, 0.4)


def horizon_points(centre: Array, distance: float, count: int, rng: np.random.Generator) -> Surface:
    """Hills, clouds and houses in clusters around a centre (3,), from a distance to twenty times as far."""
    clusters = int(rng.integers(4, 12))
    around = rng.uniform(0, 2 * np.pi, clusters)
    far = distance * 20 ** rng.random(clusters)
    middle = centre + upright(far[:, None] * directions(around), rng.uniform(0, 0.25, clusters) * far)
    which = rng.integers(0, clusters, count)
    points = middle[which] + (0.2 * far)[which, None] * rng.standard_normal((count, 3)) * [1.0, 1.0, 0.4]
    return Surface(points, np.zeros((count, 3)), 0.3)
