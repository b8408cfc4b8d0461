"""Poses scored by looking up where each point falls in a raster of the view: one addition a point.

Arrays are float32 and coordinate-major. A direction u has the coordinates 2 (u_x, u_y) / (1 + u_z) in the raster, the
stereographic projection around (0, 0, 1), which keeps small shapes and covers every field of view.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from bpnp.loops.vectors import F, compiled, part, rotated
from bpnp.search.kernels.sides import Array, visible_weights


class Raster(NamedTuple):
    """What a point adds to the score of a pose by where it falls.

    values: (g, g), rows are y; the outermost ones are 0. The first cell begins at -half in both coordinates. per_cell:
    cells a unit.
    """

    values: Array
    half: np.float32
    per_cell: np.float32


@part
def place(half: Any, per_cell: Any, p: Any, j: Any, turn: Any, t: Any) -> Any:
    """Column and row, as fractions, of the raster where the point p[:, j] is seen from the pose (3, 3), (3,)."""
    x, y, z = rotated(turn, p[0, j], p[1, j], p[2, j])
    x, y, z = x + t[0], y + t[1], z + t[2]
    shrink = F(2) / (math.sqrt(x * x + y * y + z * z) + z + F(1e-9))
    return (x * shrink + half) * per_cell, (y * shrink + half) * per_cell


@compiled
def add_up(raster: Any, points: Any, rotation: Any, translation: Any, score: Any, weight: Any, cell: Any) -> None:
    """score (S,): the sum of the points' weights times the raster's values where pose k sees them, 0 outside it.

    raster, points: a `Raster` and a `WeightedPoints`, whose labels are ignored. rotation (S, 3, 3), translation (S, 3).
    weight (n,), cell (n,) int32: overwritten.
    """
    cells, values = np.int32(len(raster.values)), raster.values.reshape(-1)
    half, per_cell = raster.half, raster.per_cell
    last = F(cells - 1)
    for k in range(len(rotation)):
        visible_weights(points, rotation[k], translation[k], weight)
        for j in range(len(cell)):  # in a loop of its own, without a branch: several points at once
            column, row = place(half, per_cell, points.p, j, rotation[k], translation[k])
            column = column if column > F(0) else F(0)  # NaN too
            row = row if row > F(0) else F(0)
            cell[j] = np.int32(min(row, last)) * cells + np.int32(min(column, last))
        total = F(0)
        for j in range(len(cell)):
            total += weight[j] * values[np.uintp(cell[j])]
        score[k] = total
