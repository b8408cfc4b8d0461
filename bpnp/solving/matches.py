"""One-to-one matches of two point sets in the image, and the pose that fits them best."""

from collections.abc import Callable

import numpy as np
import numpy.typing as npt
from scipy.optimize import least_squares
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
    pairs, distance = _near(image, projected, radius, allowed)
    if not len(pairs):
        return pairs
    # Only points of a near pair take part. Column `count + i` stands for leaving row i out.
    rows, row = np.unique(pairs[:, 0], return_inverse=True)
    columns, column = np.unique(pairs[:, 1], return_inverse=True)
    if len(rows) == len(pairs) == len(columns):
        return pairs  # no point has a choice
    count, every = len(columns), np.arange(len(rows))
    cost = (distance / radius) ** 2 + 1e-9  # zero would be no edge
    out = np.full(len(rows), float(min(len(rows), count) + 2))
    graph = csr_array((np.r_[cost, out], (np.r_[row, every], np.r_[column, count + every])))
    i, j = min_weight_full_bipartite_matching(graph)
    real = j < count
    return np.stack([rows[i[real]], columns[j[real]]], -1)


def count_one_to_one(image: Array, projected: Array, radius: float, allowed: Allowed = anyone) -> int:
    """How many pairs `one_to_one` has: a maximum matching, faster than one of least cost."""
    pairs, _ = _near(image, projected, radius, allowed)
    if all(np.bincount(side).max(initial=0) <= 1 for side in pairs.T):
        return len(pairs)  # no point has a choice
    graph = csr_array((np.ones(len(pairs)), tuple(pairs.T)), shape=(len(image), len(projected)))
    return int((maximum_bipartite_matching(graph, perm_type="column") >= 0).sum())


def mutual_nearest(image: Array, projected: Array, radius: float, allowed: Allowed = anyone) -> Matches:
    """Pairs within `radius` in which each is the other's nearest: fewer than `one_to_one`, and fewer wrong ones."""
    pairs, distance = _near(image, projected, radius, allowed)
    nearest = np.ones(len(pairs), np.bool_)
    for side, size in enumerate((len(image), len(projected))):
        least = np.full(size, np.inf)
        np.minimum.at(least, pairs[:, side], distance)
        nearest &= distance == least[pairs[:, side]]
    return pairs[nearest]


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


def _near(image: Array, projected: Array, radius: float, allowed: Allowed) -> tuple[Matches, Array]:
    """Allowed pairs (e, 2) within `radius`, ordered, and their distances; of many points, among the nearest of each."""
    seen = np.flatnonzero(np.isfinite(projected).all(-1))
    if len(image) * len(seen) <= DENSE:
        distance = np.sqrt(((image[:, None] - projected[seen]) ** 2).sum(-1))
        pairs = np.argwhere(distance <= radius)
    else:
        forward, backward = _neighbours(image, projected[seen], radius), _neighbours(projected[seen], image, radius)
        both = np.concatenate([forward, backward[:, ::-1]])
        # One number a pair: unique rows would be sorted as records, ten times as long.
        pairs = np.stack(np.divmod(np.unique(both[:, 0] * len(seen) + both[:, 1]), len(seen)), -1)
    pairs[:, 1] = seen[pairs[:, 1]]
    pairs = pairs[allowed(*pairs.T)]
    return pairs, np.linalg.norm(image[pairs[:, 0]] - projected[pairs[:, 1]], axis=-1)


def _neighbours(points: Array, others: Array, radius: float) -> Matches:
    """Pairs of each point with the nearest others within `radius`."""
    count = min(NEIGHBOURS, len(others))
    distance, index = cKDTree(others).query(points, range(1, count + 1), distance_upper_bound=radius)
    own, nth = np.nonzero(np.isfinite(distance))
    return np.stack([own, index[own, nth]], -1)
