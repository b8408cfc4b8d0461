"""Extent and density of image points, and the scales at which their residuals are examined."""

import math

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

from bpnp.arrays import Array
from bpnp.search.kernels.neighbours import sums_near

# Factor from one scale of the residuals to the next.
SCALE_STEP = 2.0  # [factor; measured, coarser steps give the same evidence in half the time]
# In spacings sqrt(A / m).
COARSEST_SCALE = 0.5  # largest scale; beyond it only the outline fits [spacings of the points; not tuned]
FLOOR_SCALE = 2e-4  # smallest scale: some hundredths of a pixel of an ordinary camera [RMS angular radii; convention]
TOGETHER_SCALES = 2.0  # distance, in scales, below which points count as one observation [scales; convention]
CROWDED_SIGMAS = 2.0  # excess over an even spread from which neighbours are a clump [standard deviations; not tuned]
MOST_IMAGE_POINTS = 2000  # largest number of image points that are used, evenly spaced [points; cost]


class ImageStatistics:
    """Extent of the bearings of an image, scales of their residuals, and weights of bearings that lie together."""

    def __init__(self, bearings: Array, floor: float | None) -> None:
        m = len(bearings)
        self.centre = bearings.mean(0)  # (3,) mean of the bearings
        centred = bearings - self.centre
        self.spread = max(float(np.sqrt((centred**2).sum(-1).mean())), 1e-12)  # RMS distance of the bearings from it
        variance, axes = np.linalg.eigh(centred.T @ centred / max(m - 1, 1))
        # half_widths: (2,) half widths of the rectangle with the standard deviations of the bearings.
        # axes: (3, 2) principal axes on the tangent plane.
        self.half_widths, self.axes = np.sqrt(3 * np.maximum(variance[1:], 1e-24)), axes[:, 1:]
        area = 12 * math.sqrt(max(float(variance[1:].prod()), 0.0))
        self.solid_angle = float(np.clip(area, 1e-24, 4 * math.pi))  # area of this rectangle, steradians, at most 4 pi
        smallest = max(floor or 0.0, FLOOR_SCALE * self.spread)
        largest = max(COARSEST_SCALE * math.sqrt(self.solid_angle / m), 2 * smallest)
        steps = max(3, 1 + math.ceil(math.log(largest / smallest) / math.log(SCALE_STEP)))
        # (S,) scales of residuals, radians, from the noise floor to a fraction of the mean distance of the points.
        self.scales = np.geomspace(smallest, largest, steps)
        # (k,) indices of the image points that are used, at most `MOST_IMAGE_POINTS`.
        self.chosen = (
            np.arange(m) if m <= MOST_IMAGE_POINTS else np.linspace(0, m - 1, MOST_IMAGE_POINTS).astype(np.int64)
        )
        within = TOGETHER_SCALES * self.scales
        looked_at = bearings[self.chosen]
        together = sums_near(looked_at, looked_at, self.axes, within, np.zeros(steps))
        self.together = together.astype(np.int64)  # (k, S) number of used points within `TOGETHER_SCALES` of each
        expected = 1 + (len(looked_at) - 1) * math.pi * within**2 / self.solid_angle
        # (k, S, S) weights of the evidence, see `_weights`.
        self.weights = _weights(self.together, expected, CROWDED_SIGMAS)


def _weights(together: NDArray[np.int64], expected: Array, crowded_sigmas: float) -> Array:
    """Return weights (k, S, S) of log x_i at the scale s_q in the evidence of image point i at the scale s_r: i, r, q.

    log x_i at s_r is a sum of steps, from the largest scale to s_r. A step from 2 s to s counts with the lesser of 1 /
    n_i(s_r) and 1 / c_i(s). n_i(s) (k, S) is the number of image points within 2 s of i. c_i(s) is n_i(s) over the
    number for an even spread (S,) if the points are a clump, else 1. The position of a clump is then one observation,
    and the position of each of its points within it is one more.
    """
    clump = together > expected + crowded_sigmas * np.sqrt(expected)
    crowded = np.where(clump, together / expected, 1.0)
    steps = np.triu(1 / np.maximum(together[:, :, None], crowded[:, None, :]))
    steps[:, :, 1:] -= steps[:, :, :-1]
    return np.asarray(steps)


class Outline:
    """Convex hull of projected directions (n, 3) on the tangent plane of an image; empty if they are on a line.

    Directions behind the camera, and NaN, are left out.
    """

    def __init__(self, image: ImageStatistics, directions: Array) -> None:
        self._image, self._sides, self.area = image, np.empty((0, 3)), 0.0
        try:
            hull = ConvexHull(self._on_plane(directions[directions @ image.centre > 0]))
        except (QhullError, ValueError):  # collinear or too few points
            return
        self._sides, self.area = hull.equations, float(hull.volume)  # area: on the plane, about steradians

    def contains(self, directions: Array) -> NDArray[np.bool_]:
        """Return which directions (..., 3) project into the outline."""
        sides, in_front = self._sides, directions @ self._image.centre > 0  # those behind project to the other side
        if not len(sides):
            return np.zeros(in_front.shape, np.bool_)
        within = self._on_plane(directions) @ sides[:, :2].T + sides[:, 2] <= 0
        return np.asarray(within.all(-1) & in_front)

    def _on_plane(self, directions: Array) -> Array:
        return np.asarray(directions @ self._image.axes / (directions @ self._image.centre)[..., None])
