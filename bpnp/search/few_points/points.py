"""Inputs of the compiled loops: scene points with their triangles, image points in a grid, and the prior."""

import functools
import math
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from bpnp.arrays import Array, Indices
from bpnp.search.problem import Problem
from bpnp.search.propose.minimal_solvers import Triangles, triangles_of
from bpnp.search.starts import GravityPrior, PosePrior, Prior, turned_to

IMAGE_CELLS = 48  # cells along a side of the grid of the image points [cells; cost]
PRIOR_SIGMAS = 4.0  # standard deviations of a prior beyond which no pose is tried [standard deviations; convention]
# Noise is a tenth to a third of a radius.
PRIOR_WEIGHT = 0.1  # match radii that weigh as much as one standard deviation of a prior [match radii; calibration]
ALL_AROUND_COSINE = -0.5  # cosine from the mean bearing; a camera with one below it sees all around [1; not tuned]
RANKED_NEIGHBOURS = 64  # points up to which all neighbours are ranked; beyond, only this many of each [points; cost]
CACHED_SCENES = 8  # number of scenes whose tables stay in the cache [scenes; cost]
OPPOSITE_COSINE = -0.8  # cosine of two normals below which no camera faces both [1; not tuned]
# Cosine below which a point of a triple faces away; the lines of sight to three points are not quite parallel, so it is
# that of 95 degrees.
AWAY_COSINE = math.cos(math.radians(95.0))  # [1; not tuned]
EDGE_ON_SINE = 0.15  # sine of an angle to a triangle's plane below which either orientation is possible [1; not tuned]
TESTED_DIRECTIONS = 192  # number of directions with which the orientations of a triangle are tested [directions; cost]


class SceneArrays(NamedTuple):
    """Scene points as arrays."""

    points: Array  # (n, 3) in unit size
    normals: Array  # (n, 3); (0, 3) if every point can be seen
    labels: Indices  # (n,); -1 fits any label


class Grid(NamedTuple):
    """Image points in the cells of a grid, each in all cells within its reach."""

    flat: Array  # (m, 2) stereographic coordinates
    gain: Array  # (m,) radii a unit of the coordinates (`ImageArrays`)
    labels: Indices  # (m,); -1 fits any label
    low_u: float  # first coordinate of the lower corner
    low_v: float  # second coordinate of the lower corner
    per_cell: float  # cells a unit of the coordinates
    # (cells^2 + 1,) index in `items` of the first item of each cell; the second coordinate varies fastest.
    starts: Indices
    items: Indices  # of image points


class ImageArrays(NamedTuple):
    """Bearings in a frame about `axis_of` them, and in stereographic coordinates (x, y) / (|p| + z) about its z axis.

    A difference s of coordinates is an angle of s (1 + cos theta), theta from the axis. `Grid.gain` converts
    differences near an image point to match radii.
    """

    rays: Array  # (m, 3) unit vectors
    per_radian: float  # match radii a radian
    grid: Grid


class PriorArrays(NamedTuple):
    """Prior of the pose, in the frames of the points."""

    in_scene: Array  # (k, 3) directions a
    in_camera: Array  # (k, 3) directions b = R a
    weight: float  # weight of R a - b, in match radii
    farthest2: float  # largest sum of the squares of R a - b
    translation: Array  # (3,)
    farthest_shift2: float  # largest squared distance from it; infinite without a prior translation


class Heading(NamedTuple):
    """Points and rotations for P2P, in frames whose z axis is the prior direction."""

    rays: Array  # (m, 3); empty without a prior
    points: Array  # (n, 3); empty without a prior
    # (3, 3, 3) terms of R: the first plus the others times cosine and sine of the angle about the direction. With a
    # prior rotation this angle is 0.
    terms: Array
    sine2: float  # squared sine of the largest rotation from the prior rotation, or 1


class SceneSide:
    """Scene of one problem, or of many, as when a device is tracked."""

    def __init__(self, points3d: Array, normals3d: Array | None, labels3d: Indices | None) -> None:
        normals = np.empty((0, 3)) if normals3d is None else np.array(normals3d, np.float64, order="C")
        labels = np.full(len(points3d), -1) if labels3d is None else np.array(labels3d, np.int64)
        self.arrays = SceneArrays(np.array(points3d, np.float64, order="C"), normals, labels)
        self.nearest = nearest_of(self.arrays.points, normals)  # (n, k) nearest points of each point
        self.tables: dict[tuple[int, int], Triangles] = {}  # triangles by (size, near) that were built so far
        self.orders: dict[tuple[int, int], tuple[Indices, Indices]] = {}

    def triangles(self, size: int, near: int) -> Triangles:
        """Return the triangles of a point and two of its `near` nearest, or with size 2 the `pairs` with one of them.

        Those of a smaller neighbourhood are the first rows.
        """
        near = min(near, self.nearest.shape[1])
        if (size, near) not in self.tables:
            sets = sets_within(self.nearest, near, size)
            self.tables[size, near] = (
                visible_triangles(self.arrays.points, self.arrays.normals, sets) if size == 3 else pairs(sets)
            )
        return self.tables[size, near]

    def by_label(self, size: int, near: int) -> tuple[Indices, Indices]:
        """Return the stable order of the `triangles` by the label of their first point, and the sorted labels."""
        near = min(near, self.nearest.shape[1])
        if (size, near) not in self.orders:
            labels = self.arrays.labels[self.triangles(size, near).triples[:, 0]]
            order = np.argsort(labels, kind="stable")
            self.orders[size, near] = order, labels[order]
        return self.orders[size, near]


class ImageSide:
    """Image points of one problem, with what the enumeration looks up about them."""

    def __init__(self, bearings: Array, radius: float, labels2d: Indices | None, reach: float) -> None:
        self.turn = turned_to(axis_of(bearings))  # R, which maps a bearing f to R f in the frame of the arrays
        rays = bearings @ self.turn.T
        per_radian = 1 / float(radius)
        flat, gain = rays[:, :2] / np.maximum(1 + rays[:, 2:], 1e-9), (1 + rays[:, 2]) * per_radian
        labels = np.full(len(rays), -1) if labels2d is None else np.array(labels2d, np.int64)
        self.arrays = ImageArrays(np.ascontiguousarray(rays), per_radian, grid_of(flat, gain, labels, reach))
        # Probability that a point drawn uniformly in the view is within one radius of a given image point.
        self.density = float(math.pi * (1 / gain**2).mean() / _area(flat, float(1 / gain.mean())))

    @functools.cached_property
    def nearest(self) -> Indices:
        """Nearest points (m, k) of each image point."""
        return nearest_of(self.arrays.rays, np.empty((0, 3)))


def axis_of(bearings: Array) -> Array:
    """Return a direction (3,) about which bearings (m, 3) have stereographic coordinates.

    It is the mean bearing. The opposite direction has no coordinates; for a camera that sees all around, the axis is
    therefore the direction whose opposite is farthest from every bearing.

    >>> axis_of(np.array([[0.0, 0, 1], [0, 0.6, 0.8]])).tolist()
    [0.0, 0.3, 0.9]
    """
    mean = bearings.mean(0)
    length = float(np.linalg.norm(mean))
    if float((bearings @ mean).min()) > ALL_AROUND_COSINE * length:
        return np.asarray(mean)
    return np.asarray(DIRECTIONS[(bearings @ DIRECTIONS.T).min(0).argmax()])


def scene_side(points3d: Array, normals3d: Array | None, labels3d: Indices | None) -> SceneSide:
    """Return the scene, from a cache of the last few."""
    return _remembered(
        *(None if x is None else np.ascontiguousarray(x).tobytes() for x in (points3d, normals3d, labels3d))
    )


@functools.lru_cache(maxsize=CACHED_SCENES)
def _remembered(points3d: bytes, normals3d: bytes | None, labels3d: bytes | None) -> SceneSide:
    """Build a scene from the bytes of its arrays, which are the key of the cache."""
    return SceneSide(
        np.frombuffer(points3d).reshape(-1, 3),
        None if normals3d is None else np.frombuffer(normals3d).reshape(-1, 3),
        None if labels3d is None else np.frombuffer(labels3d, np.int64),
    )


def nearest_of(points: Array, normals: Array) -> Indices:
    """Return the nearest points (n, k) of each point, without the point itself.

    Points whose normals, (n, 3) or (0, 3), no camera can face at once come last.
    """
    n = len(points)
    if n > RANKED_NEIGHBOURS:
        order = cKDTree(points).query(points, RANKED_NEIGHBOURS)[1]
        itself_last = np.argsort(order == np.arange(n)[:, None], axis=1, kind="stable")
        order = np.take_along_axis(order, itself_last, 1)[:, :-1]
    else:
        distance2 = ((points[:, None] - points[None]) ** 2).sum(-1)
        if len(normals):
            distance2 += np.where(normals @ normals.T < OPPOSITE_COSINE, 1e6 * (distance2.max() + 1e-300), 0.0)
        np.fill_diagonal(distance2, np.inf)
        order = np.argsort(distance2, axis=1, kind="stable")[:, :-1]
    return np.ascontiguousarray(order, np.int64)


def sets_within(nearest: Indices, near: int, size: int) -> Indices:
    """Return sets (t, size) of a point and one or two of its `near` nearest, each set once, nearest in rank first.

    >>> sets_within(np.array([[1, 2], [0, 2], [1, 0]]), 2, 2).tolist()
    [[0, 1], [2, 1], [0, 2]]
    """
    n, near = len(nearest), min(near, nearest.shape[1])
    ranks = np.arange(near)[None] if size == 2 else np.array(np.tril_indices(near, -1))[::-1]
    members = [np.broadcast_to(np.arange(n), (ranks.shape[1], n)), *nearest.T[ranks]]
    sets = np.stack(members, -1).reshape(-1, size)
    key = np.sort(sets, 1) @ n ** np.arange(size)
    return np.ascontiguousarray(sets[np.sort(np.unique(key, return_index=True)[1])])


def visible_triangles(points: Array, normals: Array, triples: Indices) -> Triangles:
    """Return the triangles of scene triples (t, 3) that a camera can see; normals are (n, 3) or (0, 3)."""
    triangles = triangles_of(points, triples)
    orientation = triangles.orientation
    if len(normals):
        facing = (normals @ DIRECTIONS.T > AWAY_COSINE)[triangles.triples].all(1)
        above = triangles.frames[:, 2] @ DIRECTIONS.T
        seen = [(facing & (side * above < EDGE_ON_SINE)).any(1) for side in (-1, 1)]
        orientation &= np.stack(seen, -1) @ (1, 2)
    tables: Any = (np.ascontiguousarray(table[orientation > 0]) for table in triangles)
    return Triangles(*tables)


def pairs(sets: Indices) -> Triangles:
    """Return pairs (t, 2) in the record of triangles: the second point is repeated as the third."""
    everything = np.full(len(sets), 3)
    return Triangles(
        np.ascontiguousarray(sets[:, [0, 1, 1]]), np.empty((0, 3)), np.empty((0, 3, 3)), np.empty((0, 3)), everything
    )


def sphere(count: int) -> Array:
    """Return unit vectors (count, 3) spread evenly over the sphere (golden spiral)."""
    z = 1 - (2 * np.arange(count) + 1) / count
    angle = math.pi * (3 - math.sqrt(5)) * np.arange(count)
    radius = np.sqrt(1 - z * z)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z], -1)


DIRECTIONS = sphere(TESTED_DIRECTIONS)


def grid_of(flat: Array, gain: Array, labels: Indices, reach: float) -> Grid:
    """Build the grid of image points (m, 2), each in all cells within `reach` radii."""
    cells, around = IMAGE_CELLS, reach / gain[:, None]
    low, high = (flat - around).min(0), (flat + around).max(0)
    per_cell = cells / (float((high - low).max()) * (1 + 1e-9) + 1e-12)
    first, last = (
        np.clip(((flat + side * around - low) * per_cell).astype(np.int64), 0, cells - 1) for side in (-1, 1)
    )
    size = last - first + 1
    count = size.prod(1)
    item = np.repeat(np.arange(len(flat)), count)
    nth = np.arange(len(item)) - np.repeat(np.cumsum(count) - count, count)
    row, column = first[item].T + np.stack(np.divmod(nth, size[item, 1]))
    cell = row * cells + column
    order = np.argsort(cell, kind="stable")
    starts = np.searchsorted(cell[order], np.arange(cells**2 + 1))
    return Grid(np.ascontiguousarray(flat), gain, labels, float(low[0]), float(low[1]), per_cell, starts, item[order])


def _area(flat: Array, radius: float) -> float:
    """Return the area of the bounding rectangle along the principal axes, each side at least two radii."""
    centred = flat - flat.mean(0)
    axes = np.linalg.eigh(centred.T @ centred)[1]
    return float((np.ptp(centred @ axes, axis=0) + 2 * radius).prod())


def predicted_pose(prior: Prior | None) -> tuple[Array, Array] | None:
    """Return rotation and translation of a prior with both, else None."""
    if not isinstance(prior, PosePrior) or prior.translation is None or not math.isfinite(prior.translation_sigma):
        return None
    return np.asarray(prior.rotation, np.float64), np.asarray(prior.translation, np.float64)


def prior_arrays(problem: Problem, scene: SceneSide, image: ImageSide) -> tuple[PriorArrays, Heading, float]:
    """Return the prior as arrays, the input of P2P, and the log of the fraction of rotations that it allows.

    Where two matches fix a pose, one direction is taken as exact. It is the vertical, or the direction of the view: the
    image measures a rotation about this one best.
    """
    prior, none = problem.prior, np.empty((0, 3))
    translation, farthest_shift2, log_share, sine2 = np.zeros(3), math.inf, 0.0, 1.0
    if prior is None:
        arrays = PriorArrays(none, none, 0.0, 0.0, translation, farthest_shift2)
        return arrays, Heading(none, none, np.zeros((3, 3, 3)), sine2), log_share
    if isinstance(prior, GravityPrior):
        camera, up = prior.directions()
        sigma, moved = math.radians(prior.sigma_deg), 1
        in_scene, in_camera = up[None], (image.turn @ camera)[None]
        from_camera, from_scene = turned_to(in_camera[0]), turned_to(up)
    else:
        prior_rotation, sigma, moved = np.asarray(prior.rotation, np.float64), math.radians(prior.rotation_sigma_deg), 2
        rotation = image.turn @ prior_rotation
        from_camera, from_scene = np.eye(3), rotation
        in_scene, in_camera = np.eye(3), np.ascontiguousarray(rotation.T)
        if (predicted := predicted_pose(prior)) is not None:
            translation = image.turn @ predicted[1]
            farthest_shift2 = (PRIOR_SIGMAS * prior.translation_sigma) ** 2
        most = min(PRIOR_SIGMAS * sigma, math.pi)
        log_share, sine2 = math.log((most - math.sin(most)) / math.pi), math.sin(min(most, math.pi / 2)) ** 2
    about = np.array([np.diag([0.0, 0, 1]), np.diag([1.0, 1, 0]), [[0, -1, 0], [1, 0, 0], [0, 0, 0]]])
    rays = np.ascontiguousarray(image.arrays.rays @ from_camera.T)
    points = np.ascontiguousarray(scene.arrays.points @ from_scene.T)
    heading = Heading(rays, points, from_camera.T @ about @ from_scene, sine2)
    # A rotation by v about an axis across `moved` directions moves each of them by 2 sin(v / 2).
    weight = PRIOR_WEIGHT / (math.sqrt(moved) * sigma)
    farthest2 = moved * (2 * math.sin(min(PRIOR_SIGMAS * sigma, math.pi) / 2)) ** 2
    arrays = PriorArrays(in_scene, in_camera, float(weight), float(farthest2), translation, float(farthest_shift2))
    return arrays, heading, log_share
