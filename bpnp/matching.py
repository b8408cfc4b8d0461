"""One-to-one matches of two sets of points in the image, and their mutual nearest neighbours."""

import math
from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import (
    connected_components,
    maximum_bipartite_matching,
    min_weight_full_bipartite_matching,
)
from scipy.spatial import cKDTree

from bpnp.arrays import Array, Indices
from bpnp.runtime import NEVER, Clock, Deadline

FEW_NEIGHBOURS = 8  # number of nearest neighbours of a point that are tried first [points; cost]
DENSE_MATCHES = 4096  # number of possible matches up to which all distances are computed [matches; cost]
# Number of points whose neighbours are looked up, or that are assigned, between two checks of the deadline.
POINTS_A_CHECK = 5000  # [points; cost]
# Time of an optimal assignment, over the product of its numbers of points and of possible matches. With less time left,
# points get their mutual nearest neighbours.
ASSIGNMENT_SECONDS = 1e-9  # [seconds; cost]
COUNTING_SECONDS = 2e-6  # time of a maximum matching, over its number of possible matches [seconds; cost]
UNFINISHED = "matches"  # stage that a deadline notes if it cuts the matching short

Allowed = Callable[[Indices, Indices], NDArray[np.bool_]]


def one_to_one(
    image: Array, projected: Array, radius: float, allowed: Allowed | None = None, deadline: Deadline = NEVER
) -> Indices:
    """Return a maximum one-to-one matching of image points and projected points within a radius (paper Eq. 1).

    The matches (i, j), indices (k, 2) ordered by i, satisfy |image_i - projected_j| <= radius, and no point is in two
    of them. Among the maximum matchings it has the least sum of squared distances. It is a minimum-weight matching in
    which an unmatched image point costs more than all distances together. Points that share no possible match are
    assigned separately. With many points only the `FEW_NEIGHBOURS` nearest neighbours of each are edges.

    A projected NaN has no match; `allowed` tells which indices i and j may match. Points for whose assignment no time
    is left get their mutual nearest neighbours.
    """
    matches, distance = _near(image, projected, radius, allowed, deadline)
    chosen = [matches[:0]]
    for part in _components(matches, len(image)):
        chosen.append(_assigned(matches[part], distance[part], radius, deadline))
    both = np.concatenate(chosen)
    return np.asarray(both[np.argsort(both[:, 0])])


def count_one_to_one(
    image: Array, projected: Array, radius: float, allowed: Allowed | None = None, deadline: Deadline = NEVER
) -> int:
    """Return the number of matches of `one_to_one`, by a maximum matching, which is faster than one of least cost."""
    if deadline.ended(UNFINISHED):
        return 0
    matches, distance = _near(image, projected, radius, allowed, deadline)
    if all(np.bincount(side).max(initial=0) <= 1 for side in matches.T):
        return len(matches)  # no point has several candidates
    if _is_too_long(COUNTING_SECONDS * len(matches), deadline):
        return len(_mutual(matches, distance))
    graph = csr_array((np.ones(len(matches)), tuple(matches.T)), shape=(len(image), len(projected)))
    return int((maximum_bipartite_matching(graph, perm_type="column") >= 0).sum())


def _components(matches: Indices, count: int) -> Iterator[Indices | slice]:
    """Yield the indices of the possible matches (e, 2) of points that share none with others, in groups.

    A group has one component, or several with together at most `POINTS_A_CHECK` matches. `count` is the number of image
    points.
    """
    if len(matches) <= POINTS_A_CHECK:
        yield slice(None)
        return
    size = count + int(matches[:, 1].max()) + 1
    graph = csr_array((np.ones(len(matches), np.bool_), (matches[:, 0], count + matches[:, 1])), shape=(size, size))
    component = connected_components(graph, directed=False)[1][matches[:, 0]]
    sizes = np.bincount(component)
    order = np.lexsort((component, sizes[component]))  # small ones first: the deadline may cut off the large ones
    ends = np.cumsum(sizes[component[order]][np.r_[True, np.diff(component[order]) != 0]])
    first = 0
    while first < len(order):
        last = int(
            ends[max(np.searchsorted(ends, first + POINTS_A_CHECK, "right") - 1, np.searchsorted(ends, first + 1))]
        )
        yield order[first:last]
        first = last


def _assigned(matches: Indices, distance: Array, radius: float, deadline: Deadline) -> Indices:
    """Return the maximum matching with the least squared distances among possible matches (e, 2), in any order."""
    alone = np.logical_and(*(np.bincount(side)[side] == 1 for side in matches.T)) if len(matches) else np.ones(0, bool)
    if alone.all():
        return matches
    # Only points with several candidates take part. Column `count + i` leaves row i unmatched.
    sure, matches, distance = matches[alone], matches[~alone], distance[~alone]
    rows, row = np.unique(matches[:, 0], return_inverse=True)
    columns, column = np.unique(matches[:, 1], return_inverse=True)
    count, every = len(columns), np.arange(len(rows))
    if _is_too_long(ASSIGNMENT_SECONDS * len(matches) * len(rows), deadline):
        return np.concatenate([sure, _mutual(matches, distance)])
    cost = (distance / radius) ** 2 + 1e-9  # a zero would be no edge
    out = np.full(len(rows), float(min(len(rows), count) + 2))
    graph = csr_array((np.r_[cost, out], (np.r_[row, every], np.r_[column, count + every])))
    i, j = min_weight_full_bipartite_matching(graph)
    real = j < count
    return np.concatenate([sure, np.stack([rows[i[real]], columns[j[real]]], -1)])


def _is_too_long(seconds: float, deadline: Deadline) -> bool:
    """Return whether an assignment, which cannot be interrupted, would end after the end of a deadline; note this."""
    if Clock.now() + seconds < deadline.final:
        return False
    deadline.unfinished.add(UNFINISHED)
    return True


def mutual_nearest(
    image: Array, projected: Array, radius: float, allowed: Allowed | None = None, deadline: Deadline = NEVER
) -> Indices:
    """Return the mutual nearest neighbours within `radius`: fewer matches than `one_to_one`, and fewer wrong ones."""
    return _mutual(*_near(image, projected, radius, allowed, deadline))


def _mutual(matches: Indices, distance: Array) -> Indices:
    """Return those of possible matches (e, 2) that are the nearest ones of both points."""
    nearest = np.ones(len(matches), np.bool_)
    for side in matches.T:
        least = np.full(int(side.max(initial=-1)) + 1, np.inf)
        np.minimum.at(least, side, distance)
        nearest &= distance == least[side]
    return matches[nearest]


def _near(
    image: Array, projected: Array, radius: float, allowed: Allowed | None, deadline: Deadline
) -> tuple[Indices, Array]:
    """Return the allowed matches (e, 2) within `radius`, ordered, and their distances; nearest neighbours if many."""
    seen = np.flatnonzero(np.isfinite(projected).all(-1))
    if len(image) * len(seen) <= DENSE_MATCHES:
        distance = np.sqrt(((image[:, None] - projected[seen]) ** 2).sum(-1))
        matches = np.argwhere(distance <= radius)
    else:
        both = _neighbours(image, projected[seen], radius, deadline)
        if np.bincount(both[:, 0]).max(initial=0) == FEW_NEIGHBOURS:  # there may be more
            both = np.concatenate([both, _neighbours(projected[seen], image, radius, deadline)[:, ::-1]])
        # One number per match: sorting unique rows as records takes ten times as long.
        matches = np.stack(np.divmod(np.unique(both[:, 0] * len(seen) + both[:, 1]), len(seen)), -1)
    matches[:, 1] = seen[matches[:, 1]]
    matches = matches if allowed is None else matches[allowed(*matches.T)]
    return matches, np.linalg.norm(image[matches[:, 0]] - projected[matches[:, 1]], axis=-1)


def _neighbours(points: Array, others: Array, radius: float, deadline: Deadline) -> Indices:
    """Return the indices (e, 2) of each point and of its nearest neighbours within `radius`.

    Points that are not looked up before the end of a deadline have none.
    """
    count, tree, found = min(FEW_NEIGHBOURS, len(others)), cKDTree(others), list[Indices]()
    step = len(points) if math.isinf(deadline.final) else POINTS_A_CHECK
    for first in range(0, len(points), step):
        if first and deadline.ended(UNFINISHED):
            break
        distance, index = tree.query(points[first : first + step], range(1, count + 1), distance_upper_bound=radius)
        point, nth = np.nonzero(np.isfinite(distance))
        found.append(np.stack([first + point, index[point, nth]], -1))
    return np.concatenate(found)
