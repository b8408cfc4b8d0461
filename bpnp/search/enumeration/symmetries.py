"""Rigid motions that take a constellation nearly onto itself: from one pose they give its twins."""

import functools
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
REMEMBERED = 64  # constellations


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
    return _remembered(points.tobytes())


@functools.lru_cache(maxsize=REMEMBERED)
def _remembered(packed: bytes) -> list[Motion]:
    points = np.frombuffer(packed).reshape(-1, 3)
    middle = points.mean(0)
    size = float(np.sqrt(((points - middle) ** 2).sum(-1).mean()))
    if not size > 0:
        return []
    unit = (points - middle) / size
    found: list[tuple[int, Motion]] = []
    for reference in _wide_triples(unit):
        for motion in _laid_onto(unit, reference):
            distance = np.linalg.norm((unit @ motion[0].T + motion[1])[:, None] - unit, axis=-1)
            near = distance.min(1) < TOLERANCE
            if near.sum() < SHARE * len(unit):
                continue
            turn, shift = _fitted(unit[near], unit[distance.argmin(1)[near]])
            found.append((int(near.sum()), (turn, shift)))
    kept: list[Motion] = [(np.eye(3), np.zeros(3))]
    least = 1 + 2 * math.cos(math.radians(APART_DEG))
    for _, motion in sorted(found, key=lambda entry: -entry[0]):
        if len(kept) <= MOST_MOTIONS and all(float((motion[0] * other).sum()) < least for other, _ in kept):
            kept.append(motion)
    return [(turn, size * shift + middle - turn @ middle) for turn, shift in kept[1:]]


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


def _laid_onto(points: Array, reference: tuple[int, int, int]) -> list[Motion]:
    """The motions that take the reference triple to each ordered triple with nearly the same sides."""
    distance = np.linalg.norm(points[:, None] - points, axis=-1)
    a, b, c = reference
    ab, ac, bc = (np.abs(distance - distance[i, j]) < 2 * TOLERANCE for i, j in ((a, b), (a, c), (b, c)))
    images = np.argwhere(ab[:, :, None] & ac[:, None, :] & bc[None])[:MOST_TRIPLES]
    return [_fitted(points[list(reference)], points[image]) for image in images]


def _fitted(source: Array, target: Array) -> Motion:
    """The least-squares motion that takes `source` (k, 3) to `target` (Kabsch)."""
    from_middle, to_middle = source.mean(0), target.mean(0)
    left, _, right = np.linalg.svd((target - to_middle).T @ (source - from_middle))
    turn = left @ np.diag([1.0, 1.0, np.sign(np.linalg.det(left @ right))]) @ right
    return turn, to_middle - turn @ from_middle
