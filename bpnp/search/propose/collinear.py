"""Rotations of a pose about a line that holds most of its matched points.

Such a rotation hardly moves the points on the line. The few other points decide it, so that a wrong pose has the
matches of the line too, and one or two coincidences. The rotations under which most other points are seen at image
points compete with the pose.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from bpnp.search.config import COLLINEAR, MATCHES
from bpnp.search.problem import Problem

Array = NDArray[np.float64]


class Line(NamedTuple):
    """Line through many of some points.

    Attributes:
        point: (3,) a point of the line.
        axis: (3,) unit vector along it.
        radius: Largest distance from the line of a point that lies on it.
    """

    point: Array
    axis: Array
    radius: float

    def distances(self, points: Array) -> Array:
        """Return the distances (n,) of points (n, 3) from the line."""
        return np.linalg.norm(np.cross(points - self.point, self.axis), axis=-1)


def find_line(points: Array) -> Line | None:
    """Return the line through most of the points, of those through two of them.

    Args:
        points: (n, 3) points; of more than `COLLINEAR.pairs` a sample of this size is used.

    Returns:
        The line, or None if fewer than `COLLINEAR.fewest` points or less than `COLLINEAR.least` of them lie on it.

    >>> points = np.concatenate([np.outer(np.linspace(-1, 1, 9), [1, 0, 0]), np.eye(3)])
    >>> line = find_line(points)
    >>> int((line.distances(points) <= line.radius).sum())
    10
    """
    rng, count = np.random.default_rng(0), len(points)
    if count < COLLINEAR.fewest:
        return None
    if count > COLLINEAR.pairs:
        points, count = points[rng.choice(count, COLLINEAR.pairs, replace=False)], COLLINEAR.pairs
    pairs = np.stack(np.triu_indices(count, 1), -1)
    if len(pairs) > COLLINEAR.pairs:
        pairs = pairs[rng.choice(len(pairs), COLLINEAR.pairs, replace=False)]
    edges = points[pairs[:, 1]] - points[pairs[:, 0]]
    lengths = np.linalg.norm(edges, axis=-1)
    pairs, axes = pairs[lengths > 0], edges[lengths > 0] / lengths[lengths > 0, None]
    if not len(pairs):
        return None
    offsets = points - points[pairs[:, :1]]
    away = np.linalg.norm(np.cross(offsets, axes[:, None]), axis=-1)
    radius = COLLINEAR.thin * np.linalg.norm(edges[lengths > 0], axis=-1)
    held = (away <= radius[:, None]).sum(-1)
    best = int(held.argmax())
    if held[best] < max(COLLINEAR.fewest, COLLINEAR.least * count):
        return None
    return Line(points[pairs[best, 0]], axes[best], float(radius[best]))


def rotations_about(
    problem: Problem, rotation: Array, translation: Array, line: Line, scale: float
) -> tuple[Array, Array]:
    """Return a pose rotated about a line by those angles under which most other points are seen at image points.

    Args:
        problem: Points of the problem.
        rotation: (3, 3) of the pose.
        translation: (3,) of the pose.
        line: Line that holds most of its matched points.
        scale: Standard deviation of its residuals, radians.

    Returns:
        Rotations (c, 3, 3) and translations (c, 3) of at most `COLLINEAR.kept` poses.

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
    others = others[np.argsort(np.linalg.norm(others, axis=-1), kind="stable")[: COLLINEAR.others]] @ rotation.T
    if not len(others):
        return np.empty((0, 3, 3)), np.empty((0, 3))
    step = 2 * math.pi / COLLINEAR.angles
    angles = step * np.arange(1, COLLINEAR.angles)
    along = others @ axis
    radial = others - along[:, None] * axis
    cosines, sines = np.cos(angles)[:, None, None], np.sin(angles)[:, None, None]
    moved = origin + along[:, None] * axis + cosines * radial + sines * np.cross(axis, radial)
    depths = np.linalg.norm(moved, axis=-1)
    # From one angle to the next a point moves by its distance from the line times the step.
    reach = MATCHES.reach * scale + 0.5 * step * np.linalg.norm(radial, axis=-1) / depths
    away, _ = cKDTree(problem.bearings).query(moved / depths[..., None])
    votes = (away < reach).sum(-1)
    kept: list[int] = []
    for k in np.argsort(-votes, kind="stable")[: (votes > 0).sum()].tolist():
        if all(abs(k - other) > COLLINEAR.apart for other in kept):
            kept.append(k)
        if len(kept) == COLLINEAR.kept:
            break
    turns = Rotation.from_rotvec(angles[kept, None] * axis).as_matrix().reshape(-1, 3, 3)
    return turns @ rotation, turns @ (translation - origin) + origin
