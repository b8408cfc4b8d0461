"""Problem in the form that the annealing reads: float32, random order, weighted clusters."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from bpnp.arrays import Array32
from bpnp.poses import MIN_POINTS
from bpnp.runtime import NEVER, Deadline
from bpnp.search.kernels.density_map import DensityMap
from bpnp.search.kernels.sides import (
    FORWARD,
    WeightedBearings,
    WeightedPoints,
    blocks_of,
    kernel_sides,
    side_of,
    with_partners,
)
from bpnp.search.kernels.sparse import Tiles, build_tiles
from bpnp.search.problem import LINE_RATIO, Problem, in_bulk
from bpnp.search.settings import DensityShape, SearchSettings
from bpnp.search.starts import GravityPrior, Prior, turned_to

# Weight of a shift along the view over one across it, for an RMS angular radius of one radian; at most 1.
SHIFT_ALONG = 5.0  # [per radian; not tuned]
# An annealing ends at the least of the next two scales and of `Problem.floor`.
SMALLEST_ANNEALED = 2e-4  # a tenth of a pixel at a focal length of 500 pixels [radians; convention]
SMALLEST_RELATIVE = 1e-3  # smallest scale of the annealing, for narrow views [RMS angular radii; convention]

Sides = tuple[WeightedBearings, WeightedPoints]


class Companion(NamedTuple):
    """Other rig camera that sees the same points, rigidly attached to the camera of a scene."""

    scene: "SearchFrame"
    turn: Array32  # (3, 3) rotation; x' = turn x + shift maps the frame of the first camera to that of this one
    shift: Array32  # (3,) translation, in the unit of both scenes


class SearchFrame:
    """Problem in float32 and in random order, with the camera turned to the mean bearing.

    A function that takes a `SearchFrame` takes and returns poses and priors in its frame, the frame of the scene,
    unless its docstring says that they are of a problem.
    """

    def __init__(self, problem: Problem, seed: int, settings: SearchSettings, deadline: Deadline = NEVER) -> None:
        bearings, points3d = problem.bearings, problem.points3d
        self.settings, self.deadline = settings, deadline
        # Density maps of the bearings that were computed so far.
        self.density_maps: dict[tuple[DensityShape, float], DensityMap] = {}
        self.companions: list[Companion] = []  # other rig cameras with the same points
        self._tiles: dict[int, tuple[Tiles, WeightedPoints]] = {}
        self._points: dict[int, WeightedPoints] = {}
        self.rng = np.random.default_rng(seed)  # generator of all random numbers
        self.frame = turned_to(bearings.mean(0))  # (3, 3) rotation from the camera of the problem to that of the scene
        order2d = self.rng.permutation(len(bearings))
        # (m, 3) unit bearings minus (0, 0, 1), their mean direction after `frame` has turned the camera. In this form
        # float32 keeps the digits of a narrow view.
        self.offsets = (bearings @ self.frame.T - FORWARD)[order2d].astype(np.float32)
        order = self.rng.permutation(len(points3d))
        self.points3d = points3d[order].astype(np.float32)  # (n, 3) scene points
        # (b, 3) scene points that determine the origin and the unit of the problem.
        self.bulk3d = self.points3d[in_bulk(points3d)[order]]
        # Image and scene points with their annotations.
        self.image = side_of(self.offsets, problem.scores2d, problem.labels2d, None, order2d)
        self.seen = side_of(self.points3d, problem.scores3d, problem.labels3d, problem.cones3d, order)
        self.image, self.seen = with_partners(self.image, self.seen), with_partners(self.seen, self.image)
        # solid_angle: solid angle that the bearings fill, steradians.
        # spread: RMS distance of the bearings from their mean; radians for a narrow view.
        self.spread, self.solid_angle = problem.image.spread, problem.image.solid_angle
        # (3,) weights of the axes in comparisons of translations. A narrow image hardly shows a shift along the view.
        self.shift_weight = np.array([1, 1, min(1, SHIFT_ALONG * self.spread)], np.float32)
        floor = math.inf if problem.floor is None else problem.floor
        # Smallest scale of the residuals, radians.
        self.smallest_scale = min(SMALLEST_ANNEALED, SMALLEST_RELATIVE * self.spread, floor)

    def outlier_density(self, share: float) -> np.float32:
        """Return the density of outliers over that of a kernel (Myronenko, Song).

        The density is o / s^2, o = 2 pi s^2 w / ((1 - w) A), w the outlier fraction `share`, A the solid angle.
        """
        return np.float32(2 * math.pi * share / ((1 - share) * self.solid_angle))

    def join(self, other: "SearchFrame", turn: NDArray[np.float64], shift: NDArray[np.float64]) -> None:
        """Add a rig camera with the same points, x' = turn x + shift in the coordinates of the problem."""
        turned, moved = other.frame @ turn @ self.frame.T, other.frame @ shift
        self.companions.append(Companion(other, turned.astype(np.float32), moved.astype(np.float32)))

    def enter_prior(self, prior: Prior) -> Prior:
        """Return the prior of a problem in the frame of the scene."""
        if isinstance(prior, GravityPrior):
            return prior._replace(up_camera=self.frame @ np.asarray(prior.up_camera))
        rotation = np.asarray(prior.rotation, np.float64)
        if prior.translation is None:
            return prior._replace(rotation=self.frame @ rotation)
        turned, moved = self.enter(rotation, np.asarray(prior.translation, np.float64))
        return prior._replace(rotation=turned, translation=moved)

    def enter(self, rotation: NDArray[np.float64], translation: NDArray[np.float64]) -> tuple[Array32, Array32]:
        """Return poses (k, 3, 3), (k, 3) of the problem in the frame of the scene, float32."""
        return (self.frame @ rotation).astype(np.float32), (translation @ self.frame.T).astype(np.float32)

    def leave(self, rotation: Array32, translation: Array32) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return poses of the scene in the frame of the problem, in float64.

        The rotations are orthogonal to float64 precision.
        """
        turn = self.frame.T @ Rotation.from_matrix(rotation.astype(np.float64)).as_matrix()
        return turn, translation.astype(np.float64) @ self.frame

    def clusters(self, counts: Sequence[int]) -> list[Sides]:
        """Return clusters of both point sets, ordered by label, for each approximate number of them.

        Smaller sets are clusters of the next larger one.
        """
        sides, image, seen = {}, self.image, self.seen
        for count in sorted(set(counts), reverse=True):
            image = image.clustered(count, self.rng)
            f = image.points.astype(np.float64) + FORWARD  # a mean of unit vectors is shorter
            unit = (f / np.linalg.norm(f, axis=-1, keepdims=True) - FORWARD).astype(np.float32)
            seen = seen.clustered(count, self.rng)
            bearings, points = kernel_sides(image._replace(points=unit), seen)
            sides[count] = bearings, points._replace(blocks=blocks_of(image.labels, seen.labels))
        return [sides[count] for count in counts]

    def sides(self, bearings: int | None = None, points: int | None = None) -> Sides:
        """Return bearings and points in random order; the first `bearings` and `points` of them, None for all."""
        return kernel_sides(self.image.at(slice(bearings)), self.seen.at(slice(points)))

    def seen_points(self, count: int) -> WeightedPoints:
        """Return the first `count` points as the density map scores them, from a cache."""
        if count not in self._points:
            self._points[count] = self.sides(points=count)[1]
        return self._points[count]

    def tiles(self, bearings: int | None = None) -> tuple[Tiles, WeightedPoints]:
        """Return all points, and the first `bearings` bearings (None for all) in tiles, from a cache."""
        count = len(self.offsets) if bearings is None else min(bearings, len(self.offsets))
        if count not in self._tiles:
            image, points = self.sides(count)
            self._tiles[count] = build_tiles(image), points
        return self._tiles[count]


def degenerate(points: NDArray[np.float64]) -> bool:
    """Return True for fewer than 4 points, or for points that all coincide or lie on one line."""
    if len(points) < MIN_POINTS:
        return True
    values = np.linalg.svd(points - points.mean(0), compute_uv=False)
    extent = max(float(np.abs(points).max()), float(values[0]))
    return bool(values[0] <= 1e-9 * extent or values[1] <= LINE_RATIO * values[0])
