"""Poses scored by looking up where each point falls in a raster of the view: one addition a point; or these places.

Arrays are float32 and coordinate-major. A direction u has the coordinates 2 (u_x, u_y) / (1 + u_z) in the raster, the
stereographic projection around (0, 0, 1), which keeps small shapes and covers every field of view.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from bpnp.search.kernels.vectors import F, compiled, part, rotated
from bpnp.search.kernels.weighted import visible_weights


class Raster(NamedTuple):
    """What a point adds to the score of a pose by where it falls: the arguments of `add_up`."""

    values: Any
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
def add_up(raster: Any, half: Any, per_cell: Any, points: Any, rotation: Any, translation: Any, score: Any,
           weight: Any) -> None:  # fmt: skip
    """score (S,): the sum of the points' weights times the raster's values where pose k sees them, 0 outside it.

    points: a `WeightedPoints` as a tuple, whose labels are ignored.
    raster (g, g), rows are y. Its first cell begins at -half in both coordinates; per_cell cells a unit.
    rotation (S, 3, 3), translation (S, 3). weight (n,): overwritten.
    """
    cells, visible = raster.shape[0], points[1]
    for k in range(len(rotation)):
        if points[5].shape[1]:
            visible_weights(points, rotation[k], translation[k], weight)
            visible = weight
        total = F(0)
        for j in range(len(visible)):
            column, row = place(half, per_cell, points[0], j, rotation[k], translation[k])
            if column >= 0 and row >= 0 and column < cells and row < cells:
                total += visible[j] * raster[int(row), int(column)]
        score[k] = total


@compiled
def count_places(counts: Any, half: Any, per_cell: Any, points: Any, rotation: Any, translation: Any,
                 weight: Any) -> None:  # fmt: skip
    """counts (S, g, g): the points' weights are added to the cells where pose k sees them; the rest as in `add_up`."""
    cells = counts.shape[1]
    for k in range(len(rotation)):
        visible_weights(points, rotation[k], translation[k], weight)
        for j in range(len(weight)):
            column, row = place(half, per_cell, points[0], j, rotation[k], translation[k])
            if column >= 0 and row >= 0 and column < cells and row < cells:
                counts[k, int(row), int(column)] += weight[j]
