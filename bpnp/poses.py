"""Comparison of poses that are NumPy arrays."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

AT_ONCE = 16  # poses compared with all others in one matrix product
MIN_POINTS = 4  # matches that fix a pose; three fit up to four poses exactly
Array = NDArray[np.floating[Any]]


def turned_by(one: Array, other: Array) -> float:
    """Return the angle between two rotations (3, 3), radians, in [0, pi]."""
    cosine = (float((one * other).sum()) - 1) / 2
    return math.acos(min(max(cosine, -1.0), 1.0))


def same_pose(
    rotation: Array, translation: Array, i: int | NDArray[np.int64], degrees: float, shift: float
) -> NDArray[np.bool_]:
    """Find the poses that are close to pose i.

    Args:
        rotation: Rotations (c, 3, 3).
        translation: Translations (c, 3), or whatever else `shift` limits.
        i: Index of the reference pose, or several indices (k,).
        degrees: Largest rotation angle between two equal poses, degrees.
        shift: Largest distance of their translations, in the units of `translation`. `math.inf` ignores the
            translations.

    Returns:
        Mask (c,), or (k, c) for several indices. Pose i is close to itself; NaN is close to nothing.
    """
    flat = rotation.reshape(-1, 9)
    alike = flat[i] @ flat.T >= 1 + 2 * math.cos(math.radians(degrees))
    if shift == math.inf:
        return np.asarray(alike)
    return alike & (np.linalg.norm(translation - translation[i][..., None, :], axis=-1) <= shift)


def distinct(
    rotation: Array, translation: Array, score: Array, count: int, degrees: float, shift: float
) -> NDArray[np.int64]:
    """Select the best poses of which no two are closer than both limits.

    Args:
        rotation: Rotations (c, 3, 3).
        translation: Translations (c, 3).
        score: Score (c,), larger is better. Poses with NaN or -inf are left out.
        count: Largest number of poses.
        degrees: Angle limit, as in `same_pose`, degrees.
        shift: Distance limit, as in `same_pose`.

    Returns:
        Indices of at most `count` poses, best first.
    """
    kept: list[int] = []
    free = np.isfinite(score)
    order = np.argsort(-np.where(free, score, -np.inf), kind="stable")
    for first in range(0, len(order), AT_ONCE):
        several = order[first : first + AT_ONCE]
        for i, same in zip(several.tolist(), same_pose(rotation, translation, several, degrees, shift), strict=True):
            if len(kept) == count:
                return np.array(kept, dtype=np.int64)
            if free[i]:
                kept.append(i)
                free &= ~same
    return np.array(kept, dtype=np.int64)
