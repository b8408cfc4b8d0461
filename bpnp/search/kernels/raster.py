"""Poses scored by looking up where each point falls in a raster of the view: one addition a point.

Arrays are float32 and coordinate-major. A direction u has the coordinates 2 (u_x, u_y) / (1 + u_z) in the raster, the
stereographic projection around (0, 0, 1), which keeps small shapes and covers every field of view.
"""

import math
from typing import Any

import numpy as np

from bpnp.search.kernels.dense import compiled, rotated

F = np.float32


@compiled
def add_up(raster: Any, half: Any, per_cell: Any, p: Any, rotation: Any, translation: Any, score: Any) -> None:
    """score (S,): the sum over the points p (3, n) of the raster's value where pose k sees them, 0 outside it.

    raster (g, g), rows are y. Its first cell begins at -half in both coordinates; per_cell cells a unit.
    rotation (S, 3, 3), translation (S, 3).
    """
    cells = raster.shape[0]
    for k in range(len(rotation)):
        turn, t = rotation[k], translation[k]
        total = F(0)
        for j in range(p.shape[1]):
            x, y, z = rotated(turn, p[0, j], p[1, j], p[2, j])
            x, y, z = x + t[0], y + t[1], z + t[2]
            shrink = F(2) / (math.sqrt(x * x + y * y + z * z) + z + F(1e-9))
            column, row = (x * shrink + half) * per_cell, (y * shrink + half) * per_cell
            if column >= 0 and row >= 0 and column < cells and row < cells:
                total += raster[int(row), int(column)]
        score[k] = total
