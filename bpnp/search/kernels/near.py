"""Sums over the directions that are near to each image point, at several scales in one pass."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bpnp.search.kernels.vectors import compiled

Array = NDArray[np.float64]
CELLS = 64  # along a side of the grid, at most


def sums_near(bearings: Array, directions: Array, axes: Array, radii: Array, sharpness: Array) -> Array:
    """sum_j exp(-sharpness_s |f_i - u_j|^2) over the directions u_j (n, 3) nearer than radii_s to bearing f_i: (k, S).

    axes: (3, 2) orthonormal, along which the bearings spread most; they are sorted into a grid over these. radii (S,):
    ascending. sharpness (S,): 0 counts the directions.
    """
    at = bearings @ axes
    low, extent = at.min(0), float(np.ptp(at, 0).max())
    cell = max(float(radii[-1]), extent / CELLS)
    side = int(extent / cell) + 1
    key = ((at - low) / cell).astype(np.int64) @ [side, 1]
    order = np.argsort(key, kind="stable")
    start = np.searchsorted(key[order], np.arange(side * side + 1))
    place = np.floor((directions @ axes - low) / cell).astype(np.int64)
    sums, result = np.zeros((len(radii), len(bearings))), np.empty((len(bearings), len(radii)))
    _add_up(np.ascontiguousarray(bearings[order].T), start, side, directions, place, radii**2, sharpness, sums)
    result[order] = sums.T
    return result


@compiled
def _add_up(bearings: Any, start: Any, side: int, directions: Any, place: Any, squares: Any, sharpness: Any,
            sums: Any) -> None:  # fmt: skip
    """bearings (3, k), sorted by cell: those of (x, y) begin at start[x * side + y]. place (n, 2): the cell of each
    direction (n, 3), which may lie beyond the grid. sums (S, k): added to."""
    for j in range(len(directions)):
        x, y, z = directions[j, 0], directions[j, 1], directions[j, 2]
        first = min(max(place[j, 1] - 1, 0), side)
        last = max(min(place[j, 1] + 2, side), first)
        for row in range(max(place[j, 0] - 1, 0), min(place[j, 0] + 2, side)):
            for i in range(start[row * side + first], start[row * side + last]):
                dx, dy, dz = bearings[0, i] - x, bearings[1, i] - y, bearings[2, i] - z
                squared = dx * dx + dy * dy + dz * dz
                for s in range(len(squares) - 1, -1, -1):
                    if squared >= squares[s]:
                        break
                    sums[s, i] += math.exp(-sharpness[s] * squared)
