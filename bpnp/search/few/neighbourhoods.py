"""Triples of near points in order of promise, and from which sides a triple of points with normals can be seen."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bpnp.compilation import compiler

compiled = compiler(error_model="numpy", boundscheck=False)
SLACK = math.cos(math.radians(95.0))  # the lines of sight to three points are not quite parallel
EDGE_ON = 0.15  # sine of an angle to the triangle's plane, below which either orientation is possible


@compiled
def list_triples(order: Any, rank: Any, first: int, last: int, triples: Any) -> int:
    """Triples of a point, one of its `first` to `last` nearest (counted from 1), and a nearer one.

    Every set of three comes once, from the point to which the farther one of the other two is nearest in rank, and
    nearer triples come first. order: (n, k) each point's nearest. rank: (n, n) the place of one among another's.
    triples: (t, 3), written up to its length. Returns how many there are.
    """
    count = 0
    for farther in range(max(first - 1, 1), min(last, order.shape[1])):
        for nearer in range(farther):
            for i in range(len(order)):
                a, b = order[i, nearer], order[i, farther]
                from_a, from_b = max(rank[a, i], rank[a, b]), max(rank[b, i], rank[b, a])
                if from_a < farther or from_b < farther:
                    continue
                if (from_a == farther and a < i) or (from_b == farther and b < i):
                    continue
                if count < len(triples):
                    triples[count, 0], triples[count, 1], triples[count, 2] = i, a, b
                count += 1
    return count


def sphere(count: int) -> NDArray[np.float64]:
    """Unit vectors (count, 3) spread evenly: the golden spiral."""
    z = 1 - (2 * np.arange(count) + 1) / count
    angle = math.pi * (3 - math.sqrt(5)) * np.arange(count)
    radius = np.sqrt(1 - z * z)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z], -1)


@compiled
def orientations(triples: Any, frames: Any, normals: Any, directions: Any, usable: Any, sides: Any) -> None:
    """sides (t,): 1 where a camera can face all three points and see them in the order of their triangle's normal,
    2 in the other order, 3 either; 0 if none can, or the triangle is flat. normals: (n, 3) or (0, 3)."""
    for t in range(len(triples)):
        sides[t] = 3 if usable[t] else 0
        if not usable[t] or not len(normals):
            continue
        i, j, k = triples[t, 0], triples[t, 1], triples[t, 2]
        seen = 0
        for v in range(len(directions)):
            x, y, z = directions[v, 0], directions[v, 1], directions[v, 2]
            if (
                normals[i, 0] * x + normals[i, 1] * y + normals[i, 2] * z > SLACK
                and normals[j, 0] * x + normals[j, 1] * y + normals[j, 2] * z > SLACK
                and normals[k, 0] * x + normals[k, 1] * y + normals[k, 2] * z > SLACK
            ):
                height = frames[t, 2, 0] * x + frames[t, 2, 1] * y + frames[t, 2, 2] * z
                seen |= (height > -EDGE_ON) + 2 * (height < EDGE_ON)
                if seen == 3:
                    break
        sides[t] = seen
