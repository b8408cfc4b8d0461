"""Poses that a repeated structure confuses: a facade moved by a window, a lattice by a cell, a plane by half a turn."""

import math

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError, cKDTree

from bpnp.search.evidence.false_alarms import SHARES, alarms_of, directions_of, point_evidence
from bpnp.search.evidence.settings import Evidence, Repetitions
from bpnp.search.kernels.neighbours import HashedPoints, hashed
from bpnp.search.point_sets import PointSets

Array = NDArray[np.float64]
Pose = tuple[Array, Array]
DEFAULT = Repetitions()


def repeated_poses(
    sets: PointSets, rotation: Array, translation: Array, scale: float, rule: Evidence
) -> tuple[Pose, bool]:
    """Poses (c, 3, 3), (c, 3) that see other scene points where this one sees those that have a partner in the image.

    If a motion p -> Q p + d takes these points onto other scene points, the pose (R Q^T, t - R Q^T d) sees the latter
    in the same directions. Q: none and, unless a prior excludes them, half turns about the axes of the points, and
    quarter turns where they repeat. d: from one of three points in their middle to any of the scene points nearest to
    them. scale: of the residuals, radians. Only poses that a verdict takes for different from this one
    (`Evidence.other_deg`), the few with the fewest false alarms; and whether there are so few motions that these stand
    for all.

    >>> import numpy as np
    >>> motif = np.random.default_rng(0).uniform(0, 1, (12, 3))
    >>> scene = np.concatenate([motif + [2 * k, 0, 6] for k in range(3)])
    >>> image = motif + [0, 0, 6]  # the first of three equal things
    >>> sets = PointSets(image / np.linalg.norm(image, axis=1, keepdims=True), scene)
    >>> (_, translations), _ = repeated_poses(sets, np.eye(3), np.zeros(3), 1e-3, Evidence())
    >>> sorted(translations[:, 0].round(6).tolist())
    [-4.0, -2.0]
    """
    none, limits = ((np.empty((0, 3, 3)), np.empty((0, 3))), True), rule.repetitions
    points = sets.points3d
    camera = points @ rotation.T + translation
    depth = np.linalg.norm(camera, axis=-1)
    seen = camera / np.maximum(depth, 1e-300)[:, None]
    away, nearest = cKDTree(seen).query(sets.bearings)
    matched = np.unique(nearest[away < limits.near * scale])
    if len(matched) < limits.fewest:
        return none
    tolerance = limits.near * scale * float(np.median(depth[matched]))
    own = points[matched]
    own = own[np.argsort(np.linalg.norm(own - np.median(own, 0), axis=-1), kind="stable")]
    some = np.linspace(limits.references, len(own) - 1, limits.most).astype(int)
    own = own[np.unique(np.r_[: limits.references, some])]
    around = points[np.argsort(np.linalg.norm(points - own[0], axis=-1), kind="stable")[: limits.around]]
    scene = hashed(points, tolerance)
    found = [(share, np.eye(3), shift) for share, shift in _shifts(scene, around, own, np.eye(3), limits)]
    turns = [] if sets.knows_rotation else _turns(own, found[0][2] if found else None)
    for turn in turns:
        found += [(share, turn, shift) for share, shift in _shifts(scene, around, own, turn, limits)]
    found = sorted(found, key=lambda motion: -motion[0])
    if not found:
        return none
    rotations = np.array([rotation, *(rotation @ turn.T for _, turn, _ in found)])
    translations = np.array([translation, *(translation - rotation @ turn.T @ shift for _, turn, shift in found)])
    other = np.flatnonzero(~sets.same_pose(rotations, translations, rule.other_deg, rule.other_shift))
    rotations, translations = rotations[other[: limits.weighed]], translations[other[: limits.weighed]]
    alarms = alarms_of(sets, rotations, translations, np.full(len(rotations), scale)).own
    best = np.argsort(alarms, kind="stable")[: limits.kept]
    return (rotations[best], translations[best]), len(other) <= limits.compared


def decades_behind(
    sets: PointSets, best: Pose, repeated: Pose, rivals: Pose, scale: float, limits: Repetitions = DEFAULT
) -> Array:
    """Decades (c,) by which the poses `rivals` (c, 3, 3), (c, 3) explain the image points worse than the best one.

    All at one scale of the residuals, radians, and against scene points that are evenly spread: their density does not
    say which of equal things is seen. An image point does not count against a rival if the map may end there: if it
    lies beyond the rival's projected points, and its scene point is one of those that the motions of the `repeated`
    poses take onto others. Any point may be missing in the map, as is the share q of the image points that the best
    pose does not explain: none counts for more than (1 - q) / q.
    """
    seen = [directions_of(sets, *best), *(directions_of(sets, r, t) for r, t in zip(*rivals, strict=True))]
    logs = np.stack([point_evidence(sets, one, np.array([scale]), SHARES[-1:], even=True)[:, 0, 0] for one in seen])
    missing = min((int((logs[0] < 0).sum()) + 1) / (logs.shape[1] + 2), limits.most_missing)
    most = math.log((1 - missing) / missing)
    is_repeated = _is_repeated(sets, best, repeated, limits.near * scale)
    counted = np.stack([_among(sets, one) for one in seen[1:]]) | ~is_repeated
    return np.asarray(np.where(counted, np.clip(logs[0] - logs[1:], -most, most), 0).sum(-1) / math.log(10))


def _is_repeated(sets: PointSets, best: Pose, repeated: Pose, reach: float) -> NDArray[np.bool_]:
    """Of which of the chosen image points (k,) a motion p -> Q p + d, or its inverse, takes the scene point onto
    another one; Q p + d is the point that a repeated pose sees where the best one sees p."""
    points, (rotation, translation) = sets.points3d, best
    camera = points @ rotation.T + translation
    depth = np.linalg.norm(camera, axis=-1)
    _, nearest = cKDTree(camera / np.maximum(depth, 1e-300)[:, None]).query(sets.bearings[sets.image.chosen])
    own, reach = points[nearest], reach * float(np.median(depth[nearest]))
    moved = [
        target
        for r, t in zip(*repeated, strict=True)
        for target in ((own @ rotation.T + translation - t) @ r, (own @ r.T + t - translation) @ rotation)
    ]
    return np.asarray(np.isfinite(cKDTree(points).query(moved, distance_upper_bound=reach)[0]).any(0))


def _among(sets: PointSets, seen: Array) -> NDArray[np.bool_]:
    """Which of the chosen image points lie in the convex hull of the directions (n, 3) that a pose sees."""
    image = sets.image
    ahead = seen[seen @ image.centre > 0]  # none that is NaN
    plane, points = (x @ image.axes / (x @ image.centre)[:, None] for x in (ahead, sets.bearings[image.chosen]))
    try:
        sides = ConvexHull(plane).equations
    except (QhullError, ValueError):  # on a line, or too few
        return np.zeros(len(points), bool)
    return np.asarray((points @ sides[:, :2].T + sides[:, 2] <= 0).all(-1))


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


def _shifts(
    scene: HashedPoints, around: Array, points: Array, turn: Array, limits: Repetitions
) -> list[tuple[float, Array]]:
    """Shifts (3,) that take the turned points (k, 3) onto points of the scene, and the share that comes to lie on one;
    those with the largest share first. around: scene points that the first ones are laid onto."""
    turned = points @ turn.T
    shifts = (around - turned[: limits.references, None]).reshape(-1, 3)
    if np.array_equal(turn, np.eye(3)):
        shifts = shifts[np.linalg.norm(shifts, axis=-1) > 2 * scene.tolerance]
    first = turned[np.linspace(0, len(turned) - 1, limits.first).astype(int)]
    shifts, _ = _lying_on(scene, first, shifts, limits.share)
    if not len(shifts):
        return []
    shifts, share = _lying_on(scene, turned, _apart(shifts[: limits.confirmed], scene.tolerance), limits.share)
    return list(zip(share.tolist(), shifts, strict=True))


def _lying_on(scene: HashedPoints, points: Array, shifts: Array, share: float) -> tuple[Array, Array]:
    """The shifts (s, 3) that take such a share of the points (k, 3) or more to within the tolerance of one of the
    scene, and these shares (s,); the largest first."""
    least = math.ceil(share * len(points))
    counts = scene.count_on(points, shifts, least)
    best = np.argsort(-counts, kind="stable")[: int((counts >= least).sum())]
    return shifts[best], counts[best] / len(points)


def _apart(shifts: Array, tolerance: float) -> Array:
    """Of shifts (s, 3) that agree to within the tolerance the first."""
    cells = np.round(shifts / (2 * tolerance))
    return shifts[np.sort(np.unique(cells, axis=0, return_index=True)[1])]
