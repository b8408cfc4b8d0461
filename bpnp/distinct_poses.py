"""Picking the best of many poses of which no two are nearly the same."""

import math

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float32]
SAME_DEG, SAME_SHIFT = 3.0, 0.05  # poses closer than this, in degrees and in extents of the scene, are one


def near(rotation: Array, translation: Array, i: int, degrees: float, shift: float) -> NDArray[np.bool_]:
    """Which poses are within both limits of pose i."""
    flat = rotation.reshape(-1, 9)
    turned = flat @ flat[i] < 1 + 2 * math.cos(math.radians(degrees))
    return ~turned & (np.linalg.norm(translation - translation[i], axis=-1) <= shift)


def distinct(
    rotation: Array, translation: Array, score: Array, count: int, degrees: float, shift: float
) -> NDArray[np.int64]:
    """The best `count` poses of which no two are closer than both limits, best first; NaN and -inf are left out."""
    kept: list[int] = []
    free = np.isfinite(score)
    for i in np.argsort(-np.where(free, score, -np.inf), kind="stable").tolist():
        if len(kept) == count:
            break
        if free[i]:
            kept.append(i)
            free &= ~near(rotation, translation, i, degrees, shift)
    return np.array(kept, dtype=np.int64)
