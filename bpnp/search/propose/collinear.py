"""Rotations of a pose about a line that holds most of its matched points.

Such a rotation hardly moves the points on the line. The few other points decide it, so that a wrong pose has the
matches of the line too, and one or two coincidences. The rotations under which most other points are seen at image
points compete with the pose.
"""

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from bpnp.arrays import Array
from bpnp.search.possible_matches import MATCH_REACH
from bpnp.search.problem import Problem

FEWEST_ON_LINE = 5  # smallest number of matched points on the line [points; not tuned]
# A wrong pose explains at least half of its matches by independent coincidences, unless this fraction lies on a line.
LEAST_ON_LINE = 0.5  # smallest fraction of the matched points on the line [fraction; derived]
THIN_LINE = 0.05  # largest distance of a point on the line, in distances of the two that it is through [1; not tuned]
# All pairs miss a line of half of the points with a probability of (1 - 1/4)^256.
LINE_PAIRS = 256  # number of pairs of points whose lines are tried [pairs; derived]
ANGLES = 360  # number of angles of a full turn [angles; cost]
APART_STEPS = 2  # two angles within this many steps are one, since poses are refined [steps; not tuned]
MOST_OTHERS = 500  # largest number of points off the line that are rotated, the nearest ones [points; cost]
KEPT_ANGLES = 6  # largest number of competing poses, those that explain the most points [poses; cost]
CACHED_LINES = 64  # number of sets of points whose line stays in the cache [sets; cost]


class Line(NamedTuple):
    """Line through many of some points."""

    point: Array  # (3,) a point of the line
    axis: Array  # (3,) unit vector along it
    radius: float  # largest distance from the line of a point that lies on it

    def distances(self, points: Array) -> Array:
        """Return the distances (n,) of points (n, 3) from the line."""
        return np.linalg.norm(np.cross(points - self.point, self.axis), axis=-1)


def find_line(points: Array) -> Line | None:
    """Return the line through most of the points (n, 3), of those through two of them.

    None if fewer than `FEWEST_ON_LINE` points or less than `LEAST_ON_LINE` of them lie on it. Of more than `LINE_PAIRS`
    points a sample of this size is used.

    >>> points = np.concatenate([np.outer(np.linspace(-1, 1, 9), [1, 0, 0]), np.eye(3)])
    >>> line = find_line(points)
    >>> int((line.distances(points) <= line.radius).sum())
    10
    """
    if len(points) <= LINE_PAIRS:
        return _line_of_few(np.ascontiguousarray(points, np.float64).tobytes())
    rng = np.random.default_rng(0)
    return _line_through(points[rng.choice(len(points), LINE_PAIRS, replace=False)], rng)


@lru_cache(maxsize=CACHED_LINES)
def _line_of_few(content: bytes) -> Line | None:
    """Return the line through most of the points in a buffer, cached: several tests look for that of one pose."""
    return _line_through(np.frombuffer(content).reshape(-1, 3), np.random.default_rng(0))


def _line_through(points: Array, rng: np.random.Generator) -> Line | None:
    """Return the line of `find_line` through at most `LINE_PAIRS` points (n, 3)."""
    if (count := len(points)) < FEWEST_ON_LINE:
        return None
    pairs = np.stack(np.triu_indices(count, 1), -1)
    if len(pairs) > LINE_PAIRS:
        pairs = pairs[rng.choice(len(pairs), LINE_PAIRS, replace=False)]
    edges = points[pairs[:, 1]] - points[pairs[:, 0]]
    lengths = np.linalg.norm(edges, axis=-1)
    pairs, axes = pairs[lengths > 0], edges[lengths > 0] / lengths[lengths > 0, None]
    if not len(pairs):
        return None
    offsets = points - points[pairs[:, :1]]
    away = np.linalg.norm(np.cross(offsets, axes[:, None]), axis=-1)
    radius = THIN_LINE * lengths[lengths > 0]
    held = (away <= radius[:, None]).sum(-1)
    best = int(held.argmax())
    if held[best] < max(FEWEST_ON_LINE, LEAST_ON_LINE * count):
        return None
    return Line(points[pairs[best, 0]], axes[best], float(radius[best]))


def rotations_about(
    problem: Problem, rotation: Array, translation: Array, line: Line, scale: float
) -> tuple[Array, Array]:
    """Return a pose rotated about a line by those angles under which most other points are seen at image points.

    The line holds most matched points of the pose; `scale` is the standard deviation of its residuals, radians. There
    are at most `KEPT_ANGLES` poses.

    >>> line = np.outer(np.linspace(-1, 1, 9), [1, 0, 0])
    >>> points = np.concatenate([line, [[0.1, 1, 0], [-0.4, 0, 0.9], [0.7, 0.2, -0.6]]])
    >>> camera = points + [0, 0, 6]
    >>> problem = Problem(camera / np.linalg.norm(camera, axis=1, keepdims=True), points)
    >>> rolled = np.diag([1.0, -1.0, -1.0])  # a half turn about the line
    >>> rotations, _ = rotations_about(problem, rolled, np.array([0, 0, 6.0]), find_line(points), 1e-3)
    >>> bool(np.allclose(rotations[0], np.eye(3), atol=0.05))  # the poses are refined later
    True
    """
    origin, axis = rotation @ line.point + translation, rotation @ line.axis
    others = problem.points3d[line.distances(problem.points3d) > line.radius] - line.point
    others = others[np.argsort(np.linalg.norm(others, axis=-1), kind="stable")[:MOST_OTHERS]] @ rotation.T
    if not len(others):
        return np.empty((0, 3, 3)), np.empty((0, 3))
    step = 2 * math.pi / ANGLES
    angles = step * np.arange(1, ANGLES)
    along = others @ axis
    radial = others - along[:, None] * axis
    cosines, sines = np.cos(angles)[:, None, None], np.sin(angles)[:, None, None]
    moved = origin + along[:, None] * axis + cosines * radial + sines * np.cross(axis, radial)
    depths = np.linalg.norm(moved, axis=-1)
    # From one angle to the next a point moves by its distance from the line times the step.
    reach = MATCH_REACH * scale + 0.5 * step * np.linalg.norm(radial, axis=-1) / depths
    away, _ = cKDTree(problem.bearings).query(moved / depths[..., None])
    votes = (away < reach).sum(-1)
    kept: list[int] = []
    for k in np.argsort(-votes, kind="stable")[: (votes > 0).sum()].tolist():
        if all(abs(k - other) > APART_STEPS for other in kept):
            kept.append(k)
        if len(kept) == KEPT_ANGLES:
            break
    turns = Rotation.from_rotvec(angles[kept, None] * axis).as_matrix().reshape(-1, 3, 3)
    return turns @ rotation, turns @ (translation - origin) + origin
