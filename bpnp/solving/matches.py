"""One-to-one matches of two point sets in the image, and the pose that fits them best."""

from collections.abc import Callable

import numpy as np
import numpy.typing as npt
from scipy.optimize import least_squares, linear_sum_assignment
from scipy.sparse import csr_array
from scipy.sparse.csgraph import maximum_bipartite_matching, min_weight_full_bipartite_matching
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

Array = npt.NDArray[np.float64]
Matches = npt.NDArray[np.int64]  # (k, 2): a place in the first set and one in the second
Allowed = Callable[[npt.NDArray[np.int64], npt.NDArray[np.int64]], npt.NDArray[np.bool_]]
DENSE = 4096  # pairs up to which all of them are compared
NEIGHBOURS = 8  # of a point that can be its match; more only where the radius is far too large


def anyone(i: npt.NDArray[np.int64], j: npt.NDArray[np.int64]) -> npt.NDArray[np.bool_]:
    """Every pair of places may be matched."""
    return np.ones(np.shape(i), np.bool_)


def one_to_one(image: Array, projected: Array, radius: float, allowed: Allowed = anyone) -> Matches:
    """As many pairs (i, j) with |image_i - projected_j| <= radius as there can be with no point in two of them (paper
    Eq. 1), and of such sets one with the least sum of squared distances. Ordered by i; NaN is no one's match.

    allowed: which pairs, given as places i and j, may be matched. A minimum-weight matching, in which leaving an image
    point out costs more than all distances together; of many points on the graph of each one's `NEIGHBOURS` nearest.
    """
    if len(image) * len(projected) <= DENSE:
        within = _within(image, projected, radius, allowed)
        cost = np.where(np.isfinite(within), (within / radius) ** 2, min(within.shape) + 2.0)
        i, j = linear_sum_assignment(cost)
        real = np.isfinite(within[i, j])
        return np.stack([i[real], j[real]], -1).astype(np.int64)
    pairs, distance = _edges(image, projected, radius, allowed)
    if not len(pairs):
        return np.empty((0, 2), np.int64)
    # Only points of an edge take part. Column `count + i` stands for leaving row i out.
    rows, row = np.unique(pairs[:, 0], return_inverse=True)
    columns, column = np.unique(pairs[:, 1], return_inverse=True)
    count = len(columns)
    cost = (distance / radius) ** 2 + 1e-9  # zero would be no edge
    out = np.full(len(rows), float(min(len(rows), count) + 2))
    index = (np.r_[row, np.arange(len(rows))], np.r_[column, count + np.arange(len(rows))])
    graph = csr_array((np.r_[cost, out], index), shape=(len(rows), count + len(rows)))
    i, j = min_weight_full_bipartite_matching(graph)
    real = j < count
    return np.stack([rows[i[real]], columns[j[real]]], -1).astype(np.int64)


def count_one_to_one(image: Array, projected: Array, radius: float, allowed: Allowed = anyone) -> int:
    """How many pairs `one_to_one` has: a maximum matching, faster than one of least cost."""
    if len(image) * len(projected) <= DENSE:
        return len(one_to_one(image, projected, radius, allowed))
    pairs, _ = _edges(image, projected, radius, allowed)
    if not len(pairs):
        return 0
    graph = csr_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(image), len(projected)))
    return int((maximum_bipartite_matching(graph, perm_type="column") >= 0).sum())


def mutual_nearest(image: Array, projected: Array, radius: float, allowed: Allowed = anyone) -> Matches:
    """Pairs within `radius` in which each is the other's nearest: fewer than `one_to_one`, and fewer wrong ones."""
    if len(image) * len(projected) <= DENSE:
        within = _within(image, projected, radius, allowed)
        i = np.flatnonzero(np.isfinite(within).any(1))
        j = within[i].argmin(1)
        mutual = within[:, j].argmin(0) == i
        return np.stack([i[mutual], j[mutual]], -1)
    seen = np.flatnonzero(np.isfinite(projected).all(-1))
    if not len(seen):
        return np.empty((0, 2), np.int64)
    distance, forward = cKDTree(projected[seen]).query(image, distance_upper_bound=radius)
    _, backward = cKDTree(image).query(projected[seen])
    i = np.flatnonzero(np.isfinite(distance))
    i = i[backward[forward[i]] == i]
    j = seen[forward[i]]
    return np.stack([i, j], -1)[allowed(i, j)]


def fit_pose(
    project: Callable[[Array, Array], Array], target: Array, rotation: Array, translation: Array, *, scale: float
) -> tuple[Array, Array]:
    """The pose near (rotation, translation) of least squared distance between `target` (k, d) and project(R, t) (k, d).

    By Levenberg-Marquardt with numeric derivatives in (w, s), R = exp([w]x) rotation, t = translation + size s, so
    that it serves every camera. scale: of the residuals; a point that leaves the view counts as far off.
    """
    size = max(float(np.linalg.norm(translation)), 1e-12)

    def pose(step: Array) -> tuple[Array, Array]:
        return Rotation.from_rotvec(step[:3]).as_matrix() @ rotation, translation + size * step[3:]

    def residuals(step: Array) -> Array:
        return np.nan_to_num(project(*pose(step)) - target, nan=1e3 * scale).ravel() / scale

    found = least_squares(residuals, np.zeros(6), method="lm", xtol=1e-12, ftol=1e-12, gtol=1e-12, max_nfev=200)
    return pose(found.x)


def _within(image: Array, projected: Array, radius: float, allowed: Allowed) -> Array:
    """All distances (m, n), infinite beyond `radius` and for pairs that are not allowed."""
    distance = np.sqrt(((image[:, None] - projected[None]) ** 2).sum(-1))
    i, j = np.indices(distance.shape).reshape(2, -1)
    possible = (distance <= radius) & allowed(i, j).reshape(distance.shape)
    return np.where(possible, distance, np.inf)


def _edges(image: Array, projected: Array, radius: float, allowed: Allowed) -> tuple[Matches, Array]:
    """Pairs within `radius` (e, 2) without repetition, among the nearest of either side, and their distances."""
    seen = np.flatnonzero(np.isfinite(projected).all(-1))
    if not len(seen):
        return np.empty((0, 2), np.int64), np.empty(0)
    pairs, distances = [], []
    for points, others, flip in ((image, projected[seen], False), (projected[seen], image, True)):
        k = min(NEIGHBOURS, len(others))
        distance, index = (
            np.reshape(x, (len(points), k)) for x in cKDTree(others).query(points, k, distance_upper_bound=radius)
        )
        own, nth = np.nonzero(np.isfinite(distance))
        edge = np.stack([own, index[own, nth]], -1)
        pairs.append(edge[:, ::-1] if flip else edge)
        distances.append(distance[own, nth])
    joined, first = np.unique(np.concatenate(pairs), axis=0, return_index=True)
    joined[:, 1] = seen[joined[:, 1]]
    possible = allowed(*joined.T)
    return joined[possible].astype(np.int64), np.concatenate(distances)[first][possible]
