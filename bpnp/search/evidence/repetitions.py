"""Poses that a repeated structure confuses: a facade moved by a window, a lattice by a cell, a plane by half a turn."""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from bpnp.search.evidence.false_alarms import alarms_of
from bpnp.search.point_sets import PointSets

Array = NDArray[np.float64]
NEAR = 3.0  # scales of the residuals within which an image point has a partner, and a moved point lies on another
SHARE = 0.5  # of the points with a partner that must come to lie on others
FEWEST = 6  # points with a partner; of fewer, three that fix a pose are too large a part
REFERENCES = 3  # points that are laid onto every other one; a motion may leave one of them without a counterpart
AROUND = 4096  # scene points that they are laid onto
FIRST, MOST = 4, 48  # points that are moved to find motions, and to confirm them
CONFIRMED, WEIGHED, KEPT = 512, 24, 4  # motions, best first, that are confirmed, whose poses are weighed, and returned


def repeated_poses(sets: PointSets, rotation: Array, translation: Array, scale: float) -> tuple[Array, Array]:
    """Poses (c, 3, 3), (c, 3) that see other scene points where this one sees those that have a partner in the image.

    If a motion p -> Q p + d takes these points onto other scene points, the pose (R Q^T, t - R Q^T d) sees the latter
    in the same directions. Q: none, half turns about the axes of the points, and quarter turns where they repeat. d:
    from one of three points in their middle to any of the 4096 nearest scene points. scale: of the residuals, radians.
    The poses with the fewest false alarms come first.

    >>> import numpy as np
    >>> motif = np.random.default_rng(0).uniform(0, 1, (12, 3))
    >>> scene = np.concatenate([motif + [2 * k, 0, 6] for k in range(3)])
    >>> image = motif + [0, 0, 6]  # the first of three equal things
    >>> sets = PointSets(image / np.linalg.norm(image, axis=1, keepdims=True), scene)
    >>> sorted(repeated_poses(sets, np.eye(3), np.zeros(3), 1e-3)[1][:, 0].round(6).tolist())
    [-4.0, -2.0]
    """
    none = np.empty((0, 3, 3)), np.empty((0, 3))
    points = sets.points3d
    camera = points @ rotation.T + translation
    depth = np.linalg.norm(camera, axis=-1)
    seen = camera / np.maximum(depth, 1e-300)[:, None]
    away, nearest = cKDTree(seen).query(sets.bearings)
    matched = np.unique(nearest[away < NEAR * scale])
    if len(matched) < FEWEST:
        return none
    tolerance = NEAR * scale * float(np.median(depth[matched]))
    own = points[matched]
    own = own[np.argsort(np.linalg.norm(own - np.median(own, 0), axis=-1), kind="stable")]
    own = np.concatenate([own[:REFERENCES], own[np.linspace(REFERENCES, len(own) - 1, MOST).astype(int)]])
    own = own[np.sort(np.unique(own, axis=0, return_index=True)[1])]
    tree = cKDTree(points)
    found = [(share, np.eye(3), shift) for share, shift in _shifts(tree, own, np.eye(3), tolerance)]
    for turn in _turns(own, found[0][2] if found else None):
        found += [(share, turn, shift) for share, shift in _shifts(tree, own, turn, tolerance)]
    found = sorted(found, key=lambda motion: -motion[0])[:WEIGHED]
    if not found:
        return none
    rotations = np.array([rotation @ turn.T for _, turn, _ in found])
    translations = np.array([translation - rotation @ turn.T @ shift for _, turn, shift in found])
    alarms = alarms_of(sets, rotations, translations, np.full(len(found), scale)).own
    best = np.argsort(alarms, kind="stable")[:KEPT]
    return rotations[best], translations[best]


def _turns(points: Array, shift: Array | None) -> list[Array]:
    """Half turns about the principal axes of points (k, 3); if a shift (3,) repeats them, also those about its
    direction and across it, and quarter turns about the normal."""
    axes = np.linalg.eigh(np.cov(points.T))[1].T
    turns = [2 * np.outer(axis, axis) - np.eye(3) for axis in axes]
    if shift is not None:
        along = shift - (shift @ axes[0]) * axes[0]
        length = float(np.linalg.norm(along))
        if length > 0.5 * float(np.linalg.norm(shift)):
            along /= length
            across = np.cross(axes[0], along)
            turns += [2 * np.outer(axis, axis) - np.eye(3) for axis in (along, across)]
            quarter = np.outer(across, along) - np.outer(along, across) + np.outer(axes[0], axes[0])
            turns += [quarter, quarter.T]
    return turns


def _shifts(tree: "cKDTree[None]", points: Array, turn: Array, tolerance: float) -> list[tuple[float, Array]]:
    """Shifts (3,) that take the turned points (k, 3) onto points of the tree, and the share that comes to lie on one;
    those with the largest share first."""
    turned = points @ turn.T
    _, around = tree.query(points[0], min(AROUND, tree.n))
    shifts = (tree.data[around] - turned[:REFERENCES, None]).reshape(-1, 3)
    if np.array_equal(turn, np.eye(3)):
        shifts = shifts[np.linalg.norm(shifts, axis=-1) > 2 * tolerance]
    some = turned[np.linspace(0, len(turned) - 1, FIRST).astype(int)]
    share = _lying_on(tree, some, shifts, tolerance)
    shifts = shifts[np.argsort(-share, kind="stable")[: min(CONFIRMED, int((share >= SHARE).sum()))]]
    shifts = _apart(shifts, tolerance)
    share = _lying_on(tree, turned, shifts, tolerance)
    return [(float(share[k]), shifts[k]) for k in np.argsort(-share, kind="stable") if share[k] >= SHARE]


def _lying_on(tree: "cKDTree[None]", points: Array, shifts: Array, tolerance: float) -> Array:
    """Share (s,) of the points (k, 3) that each shift (s, 3) takes to within the tolerance of one in the tree."""
    if not len(shifts):
        return np.empty(0)
    distance, _ = tree.query(points + shifts[:, None], distance_upper_bound=tolerance)
    return np.asarray(np.isfinite(distance).mean(-1))


def _apart(shifts: Array, tolerance: float) -> Array:
    """Of shifts (s, 3) that agree to within the tolerance the first."""
    cells = np.round(shifts / (2 * tolerance))
    return shifts[np.sort(np.unique(cells, axis=0, return_index=True)[1])]
