"""Possible correspondences of image points and scene points under a pose."""

import math
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from bpnp.arrays import Array, Labels
from bpnp.matching import DENSE_MATCHES, FEW_NEIGHBOURS
from bpnp.search.problem import Problem, faces
from bpnp.search.settings import OUTLIERS

# Distance within which an image point has a match, and default inlier threshold; 98.9 % of the errors of two normal
# coordinates are within it.
MATCH_REACH = 3.0  # [scales of the residuals; convention]
# Distance within which a scene point counts as a possible correspondence in a weighted fit, where each counts by its
# likelihood; beyond, it is below e^-8.
FARTHEST_MATCH = 4.0  # [scales of the residuals; derived]
MOST_NEIGHBOURS = 64  # number that is tried if all of the few are in reach [points; cost]


def facing(problem: Problem, camera: Array, rotation: Array) -> Labels:
    """Return the indices of the scene points, (n, 3) in the camera's frame, that the camera may see."""
    used = np.einsum("ki,ki->k", camera, camera) > 0
    if problem.normals3d is not None:
        used &= faces(problem.normals3d, problem.cosines3d, camera, rotation)
    return np.flatnonzero(used)


def possible_matches(
    problem: Problem, directions: Array, indices: Labels, chosen: Labels, scale: float, most: int = MOST_NEIGHBOURS
) -> tuple[Any, Any, Array, Array]:
    """Return the possible matches of chosen image points (m,) and scene points near them, of fitting labels.

    They are index (k,) into `chosen`, index (k,) into `directions` (n, 3), of the scene points `indices` (n,), and
    density (k,) of each match; and the total density (m,) of each image point, which includes that of no
    correspondence. An image point has at most `most` neighbours. The standard deviation of the residuals, `scale`, is
    in radians.
    """
    bearings, reach = problem.bearings[chosen], FARTHEST_MATCH * scale
    if len(bearings) * len(directions) <= DENSE_MATCHES:
        squared = ((bearings[:, None] - directions) ** 2).sum(-1)
        i, j = np.nonzero(squared < reach**2)
        squared = squared[i, j]
    else:
        tree, counts = cKDTree(directions), range(1, min(most, len(directions)) + 1)
        for count in (counts[:FEW_NEIGHBOURS][-1], counts[-1]):  # few are enough unless all of them are near
            distance, nearest = tree.query(bearings, counts[:count], distance_upper_bound=reach)
            if count == len(counts) or not np.isfinite(distance[:, -1]).any():
                break
        i, nth = np.nonzero(np.isfinite(distance))
        j, squared = nearest[i, nth].astype(np.int64), distance[i, nth] ** 2
    candidates = np.full(len(bearings), len(directions))
    odds = np.ones(len(i))
    if problem.odds2d is not None and problem.classes3d is not None:
        odds = (problem.odds2d[chosen[i]] * problem.classes3d[indices[j]]).sum(-1)
    elif problem.labels2d is not None and problem.labels3d is not None:
        label, others = problem.labels2d[chosen], problem.labels3d[indices]
        agree = (label[i] == others[j]) | (label[i] < 0) | (others[j] < 0)
        i, j, squared, odds = i[agree], j[agree], squared[agree], odds[agree]
        of_label = np.bincount(others + 1, minlength=int(label.max(initial=0)) + 2)
        candidates = np.where(label < 0, len(directions), of_label[label + 1] + of_label[0])
    density = odds * np.exp(squared * (-0.5 / scale**2)) * (1 - OUTLIERS) / (candidates[i] * 2 * math.pi * scale**2)
    every = np.bincount(i, density, len(bearings)) + OUTLIERS / problem.image.solid_angle
    return i, j, np.asarray(density, np.float64), np.asarray(every, np.float64)


def score_pose(problem: Problem, rotation: Array, translation: Array, scale: float) -> tuple[float, float]:
    """Return the mean log-likelihood of the bearings under a pose, nats, and the expected number of matches.

    It is in the units of the annealing: the maximum of a kernel is 1 / s^2, s the scale in radians; -inf if no scene
    point is seen. The number of matches is at most that of the image points or scene points.
    """
    camera, chosen = problem.points3d @ rotation.T + translation, problem.image.chosen
    indices = facing(problem, camera, rotation)
    if not len(indices):
        return -math.inf, 0.0
    directions = camera[indices] / np.linalg.norm(camera[indices], axis=-1, keepdims=True)
    i, _, density, every = possible_matches(problem, directions, indices, chosen, scale)
    matched = float((density / every[i]).sum()) * len(problem.bearings) / len(chosen)
    return float(np.log(2 * math.pi * every).mean()), min(
        matched, float(min(len(problem.bearings), len(problem.points3d)))
    )
