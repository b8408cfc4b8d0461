"""Rigid motions that take a constellation nearly onto itself: from one pose they give its twins."""

import math

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Motion = tuple[Array, Array]
TOLERANCE = 0.06  # distance of a moved point to the nearest one, in root mean square radii of the constellation
SHARE = 0.6  # of the points that must come to lie near one
APART_DEG = 10.0  # between two motions, and from no motion at all
MOST_POINTS, MOST_TRIPLES, MOST_MOTIONS = 64, 1500, 32
REFERENCES = 3  # wide triples of which the images are looked for; a motion may leave a point of one of them alone


def near_symmetries(points3d: Array) -> list[Motion]:
    """Motions (S, s) with S p + s near a point for most points p (n, 3), without the identity; best first.

    Each wide triple of points is laid onto every triple with nearly the same sides. None for more than 64 points.

    >>> import numpy as np
    >>> square = np.array([[1.0, 1, 0], [1, -1, 0], [-1, -1, 0], [-1, 1, 0]])
    >>> len(near_symmetries(square))  # three turns, and four half turns about an axis in the plane
    7
    """
    points = np.ascontiguousarray(points3d, np.float64)
    if not 4 <= len(points) <= MOST_POINTS:
        return []
    middle = points.mean(0)
    size = float(np.sqrt(((points - middle) ** 2).sum(-1).mean()))
    if not size > 0:
        return []
    unit = (points - middle) / size
    motions: list[tuple[int, Motion]] = []
    for reference in _wide_triples(unit):
        turns, shifts = _fitted(unit[list(reference)], unit[_images(unit, reference)])
        moved = unit @ turns.transpose(0, 2, 1) + shifts[:, None]
        squared = (moved**2).sum(-1)[..., None] - 2 * moved @ unit.T + (unit**2).sum(-1)
        near = squared.min(-1) < TOLERANCE**2
        for k in np.flatnonzero(near.sum(-1) >= SHARE * len(unit)):
            onto = squared[k].argmin(-1)[near[k]]
            motions.append((int(near[k].sum()), _fitted(unit[near[k]], unit[onto])))
    distinct: list[Motion] = [(np.eye(3), np.zeros(3))]
    least = 1 + 2 * math.cos(math.radians(APART_DEG))
    for _, motion in sorted(motions, key=lambda entry: -entry[0]):
        if len(distinct) <= MOST_MOTIONS and all(float((motion[0] * turn).sum()) < least for turn, _ in distinct):
            distinct.append(motion)
    return [(turn, size * shift + middle - turn @ middle) for turn, shift in distinct[1:]]


def _wide_triples(points: Array) -> list[tuple[int, int, int]]:
    """The farthest pair and the point that spans the largest triangle with it, each time of other points."""
    distance = np.linalg.norm(points[:, None] - points, axis=-1)
    triples: list[tuple[int, int, int]] = []
    free = np.arange(len(points))
    while len(free) >= 3 and len(triples) < REFERENCES:
        first, second = free[list(np.unravel_index(distance[np.ix_(free, free)].argmax(), (len(free), len(free))))]
        area = np.linalg.norm(np.cross(points[free] - points[first], points[second] - points[first]), axis=-1)
        triples.append((int(first), int(second), int(free[area.argmax()])))
        free = np.setdiff1d(free, triples[-1])
    return triples


def _images(points: Array, reference: tuple[int, int, int]) -> NDArray[np.int64]:
    """Ordered triples (t, 3) with nearly the same sides as the reference."""
    distance = np.linalg.norm(points[:, None] - points, axis=-1)
    a, b, c = reference
    ab, ac, bc = (np.abs(distance - distance[i, j]) < 2 * TOLERANCE for i, j in ((a, b), (a, c), (b, c)))
    return np.argwhere(ab[:, :, None] & ac[:, None, :] & bc[None])[:MOST_TRIPLES]


def _fitted(source: Array, target: Array) -> Motion:
    """The least-squares motion that takes `source` (k, 3) to `target` (k, 3), or to each of (t, k, 3) (Kabsch)."""
    from_middle, to_middle = source.mean(0), target.mean(-2)
    left, _, right = np.linalg.svd((target - to_middle[..., None, :]).swapaxes(-1, -2) @ (source - from_middle))
    left[..., 2] *= np.sign(np.linalg.det(left @ right))[..., None]
    turn = left @ right
    return turn, to_middle - turn @ from_middle
