"""Points near others: weighted sums over the directions near each image point, and a hash table of scene points."""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bpnp.arrays import Array
from bpnp.search.kernels.vectors import compiled, part

NEIGHBOUR_CELLS = 64  # largest number of cells along a side of the grid of neighbours [cells; cost]


def sums_near(
    bearings: Array, directions: Array, axes: Array, radii: Array, sharpness: Array, weights: Array | None = None
) -> Array:
    """Return the sums (m, S) of w_j exp(-sharpness_s |f_i - u_j|^2) over the u_j nearer than radii_s to each f_i.

    f (m, 3) and u (n, 3) are unit vectors, the radii (S,) ascend, and a sharpness of 0 counts the directions; without
    `weights` all w are 1. The orthonormal `axes` (3, 2) of the grid are those along which the bearings spread most.
    """
    at = bearings @ axes
    low, extent = at.min(0), float(np.ptp(at, 0).max())
    cell = max(float(radii[-1]), extent / NEIGHBOUR_CELLS)
    side = int(extent / cell) + 1
    key = ((at - low) / cell).astype(np.int64) @ [side, 1]
    order = np.argsort(key, kind="stable")
    start = np.searchsorted(key[order], np.arange(side * side + 1))
    place = np.floor((directions @ axes - low) / cell).astype(np.int64)
    cells = np.clip(np.stack([place - 1, place + 2], -1), 0, side)
    sums, result = np.zeros((len(radii), len(bearings))), np.empty((len(bearings), len(radii)))
    weights = np.ones(len(directions)) if weights is None else weights
    sorted_bearings = np.ascontiguousarray(bearings[order].T)
    _add_up(sorted_bearings, start, side, directions, weights, cells, radii**2, sharpness, sums)
    result[order] = sums.T
    return result


@compiled
def _add_up(
    bearings: Any,
    start: Any,
    side: int,
    directions: Any,
    weights: Any,
    cells: Any,
    squares: Any,
    sharpness: Any,
    sums: Any,
) -> None:
    """Add to the sums (S, k) of `sums_near`, of bearings (3, k) sorted by cell.

    The first bearing of cell (x, y) is start[x * side + y]. `cells` (n, 2, 2) are the first cells in x and y around
    each direction (n, 3), and those after the last; no cell beyond the grid. `squares` (S,) are the squared radii.
    """
    for j in range(len(directions)):
        x, y, z = directions[j, 0], directions[j, 1], directions[j, 2]
        for row in range(cells[j, 0, 0], cells[j, 0, 1]):
            for i in range(start[row * side + cells[j, 1, 0]], start[row * side + cells[j, 1, 1]]):
                dx, dy, dz = bearings[0, i] - x, bearings[1, i] - y, bearings[2, i] - z
                squared = dx * dx + dy * dy + dz * dz
                for s in range(len(squares) - 1, -1, -1):
                    if squared >= squares[s]:
                        break
                    sums[s, i] += weights[j] * math.exp(-sharpness[s] * squared)


class HashedPoints(NamedTuple):
    """Points in cells of twice a tolerance, each in the cells of the corners of the cube around it."""

    points: Array  # (n, 3)
    tolerance: float  # distance within which a location lies on a point
    heads: NDArray[np.int64]  # (2^k,) last slot of a cell, or -1
    links: NDArray[np.int64]  # (8 n,) previous slot of the same cell; slot e belongs to point e // 8


def hashed(points: Array, tolerance: float) -> HashedPoints:
    """Build the hash table of points (n, 3) for `lies_on`."""
    slots = 8 * len(points)
    heads, links = np.full(1 << slots.bit_length(), -1), np.empty(slots, np.int64)
    table = HashedPoints(np.ascontiguousarray(points), tolerance, heads, links)
    _enter(table)
    return table


@part
def entry(heads: Any, x: Any, y: Any, z: Any, cell: Any) -> Any:
    """Return the index in `heads` (2^k,) of the cell that contains (x, y, z) (Teschner et al., VMV 2003)."""
    i, j, k = math.floor(x / cell), math.floor(y / cell), math.floor(z / cell)
    return (73856093 * i ^ 19349663 * j ^ 83492791 * k) & (len(heads) - 1)


@compiled
def _enter(table: HashedPoints) -> None:
    """Fill the links, and the heads, which are -1 before."""
    points, tolerance, heads, links = table
    for e in range(len(links)):
        x, y, z = points[e >> 3, 0], points[e >> 3, 1], points[e >> 3, 2]
        x, y, z = x + tolerance * (2 * (e & 1) - 1), y + tolerance * ((e & 2) - 1), z + tolerance * ((e & 4) / 2 - 1)
        h = entry(heads, x, y, z, 2 * tolerance)
        links[e], heads[h] = heads[h], e


@part
def lies_on(table: HashedPoints, x: Any, y: Any, z: Any, reach: Any) -> Any:
    """Return whether (x, y, z) is within `reach`, at most the tolerance, of a point of the table."""
    points, tolerance, heads, links = table
    e = heads[entry(heads, x, y, z, 2 * tolerance)]
    while e >= 0:
        dx, dy, dz = points[e >> 3, 0] - x, points[e >> 3, 1] - y, points[e >> 3, 2] - z
        if dx * dx + dy * dy + dz * dz < reach * reach:
            return True
        e = links[e]
    return False
