"""Fast scores of poses on a density map of the view: one lookup and one addition a point.

Arrays are float32 and coordinate-major. A direction u has the map coordinates 2 (u_x, u_y) / (1 + u_z), the
stereographic projection around (0, 0, 1), which keeps small shapes and covers every field of view.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from bpnp.arrays import Array32
from bpnp.search.kernels.sides import WeightedPoints, visible_weights
from bpnp.search.kernels.vectors import F, compiled, part, rotated


class DensityMap(NamedTuple):
    """Density map: the score that a point adds by its location in the view."""

    values: Array32  # (g, g), rows are y; the outermost cells are 0
    half: np.float32  # the first cell begins at -half in both coordinates
    per_cell: np.float32  # cells a unit


@part
def place(half: Any, per_cell: Any, p: Any, j: Any, turn: Any, t: Any) -> Any:
    """Return the fractional column and row of the density map where a pose (3, 3), (3,) sees the point p[:, j]."""
    x, y, z = rotated(turn, p[0, j], p[1, j], p[2, j])
    x, y, z = x + t[0], y + t[1], z + t[2]
    shrink = F(2) / (math.sqrt(x * x + y * y + z * z) + z + F(1e-9))
    return (x * shrink + half) * per_cell, (y * shrink + half) * per_cell


@compiled
def add_up(
    density_map: DensityMap, points: WeightedPoints, rotation: Any, translation: Any, score: Any, weight: Any, cell: Any
) -> None:
    """Score poses (S, 3, 3), (S, 3) by the sum of the map's weighted values where they see the points, 0 outside.

    The result is `score` (S,). Labels are ignored; weight (n,) and cell (n,) int32 are buffers.
    """
    cells, values = np.int32(len(density_map.values)), density_map.values.reshape(-1)
    half, per_cell = density_map.half, density_map.per_cell
    last = F(cells - 1)
    for k in range(len(rotation)):
        visible_weights(points, rotation[k], translation[k], weight)
        for j in range(len(cell)):  # a separate loop without a branch, so that it vectorises
            column, row = place(half, per_cell, points.p, j, rotation[k], translation[k])
            column = column if column > F(0) else F(0)  # NaN too
            row = row if row > F(0) else F(0)
            cell[j] = np.int32(min(row, last)) * cells + np.int32(min(column, last))
        total = F(0)
        for j in range(len(cell)):
            total += weight[j] * values[np.uintp(cell[j])]
        score[k] = total
