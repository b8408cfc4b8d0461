"""Scene points in cells of a hash table: how many of other points, shifted by many shifts, come to lie on one."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bpnp.search.kernels.vectors import compiled, part

Array = NDArray[np.float64]


class HashedPoints:
    """Points (n, 3) in cells of twice a tolerance: each in those of the corners of the cube around it.

    heads (2^k,): the last slot of a cell, or -1. links (8 n,): the slot before it; slot e is of point e // 8.
    """

    def __init__(self, points: Array, tolerance: float) -> None:
        slots = 8 * len(points)
        self.points, self.tolerance = np.ascontiguousarray(points), tolerance
        self.heads, self.links = np.full(1 << slots.bit_length(), -1), np.empty(slots, np.int64)
        _enter(self.points, tolerance, self.heads, self.links)

    def count_on(self, moved: Array, shifts: Array, least: int) -> NDArray[np.int64]:
        """(s,) how many of `moved` (k, 3) each shift (s, 3) takes to within the tolerance of a point; of a shift with
        fewer than `least` any number below it."""
        counts = np.empty(len(shifts), np.int64)
        _count_on(self.points, self.tolerance, self.heads, self.links, moved, shifts, least, counts)
        return counts


@part
def _entry(heads: Any, x: Any, y: Any, z: Any, cell: Any) -> Any:
    """Place in the table `heads`, 2^k long, of the cell with the point (x, y, z): Teschner et al., VMV 2003."""
    i, j, k = math.floor(x / cell), math.floor(y / cell), math.floor(z / cell)
    return (73856093 * i ^ 19349663 * j ^ 83492791 * k) & (len(heads) - 1)


@compiled
def _enter(points: Any, tolerance: float, heads: Any, links: Any) -> None:
    """Fill links, and heads that are -1."""
    for e in range(len(links)):
        x, y, z = points[e >> 3, 0], points[e >> 3, 1], points[e >> 3, 2]
        x, y, z = x + tolerance * (2 * (e & 1) - 1), y + tolerance * ((e & 2) - 1), z + tolerance * ((e & 4) / 2 - 1)
        h = _entry(heads, x, y, z, 2 * tolerance)
        links[e], heads[h] = heads[h], e


@compiled
def _count_on(points: Any, tolerance: float, heads: Any, links: Any, moved: Any, shifts: Any, least: int,
              counts: Any) -> None:  # fmt: skip
    for s in range(len(shifts)):
        counts[s] = 0
        for k in range(len(moved)):
            if counts[s] + len(moved) - k < least:
                break
            x, y, z = moved[k, 0] + shifts[s, 0], moved[k, 1] + shifts[s, 1], moved[k, 2] + shifts[s, 2]
            e = heads[_entry(heads, x, y, z, 2 * tolerance)]
            while e >= 0:
                dx, dy, dz = points[e >> 3, 0] - x, points[e >> 3, 1] - y, points[e >> 3, 2] - z
                if dx * dx + dy * dy + dz * dz < tolerance * tolerance:
                    counts[s] += 1
                    break
                e = links[e]
