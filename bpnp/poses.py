"""Comparison of poses that are NumPy arrays."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

AT_ONCE = 16  # poses that are compared with all others in one product
MIN_POINTS = 4  # that fix a pose: three matches fit up to four poses exactly
Array = NDArray[np.floating[Any]]


def turned_by(one: Array, other: Array) -> float:
    """Angle between two rotations (3, 3), radians, in [0, pi]."""
    cosine = (float((one * other).sum()) - 1) / 2
    return math.acos(min(max(cosine, -1.0), 1.0))


def same_pose(
    rotation: Array, translation: Array, i: int | NDArray[np.int64], degrees: float, shift: float
) -> NDArray[np.bool_]:
    """Which poses (c, 3, 3), (c, 3) are within `degrees` and `shift` of pose i, itself among them; NaN is not.

    Of several poses i (k,): (k, c).
    """
    flat = rotation.reshape(-1, 9)
    alike = flat[i] @ flat.T >= 1 + 2 * math.cos(math.radians(degrees))
    if shift == math.inf:
        return np.asarray(alike)
    return alike & (np.linalg.norm(translation - translation[i][..., None, :], axis=-1) <= shift)


def distinct(
    rotation: Array, translation: Array, score: Array, count: int, degrees: float, shift: float
) -> NDArray[np.int64]:
    """The best `count` poses of which no two are closer than both limits, best first; NaN and -inf are left out."""
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
