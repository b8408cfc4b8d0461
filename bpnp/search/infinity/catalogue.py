"""Directions as a search for a rotation looks them up: pairs by their angle, and those near a place of the sphere."""

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from bpnp.search.infinity.kernels import Pairs, Sky
from bpnp.search.kernels.neighbours import hashed

Array = NDArray[np.float64]
DENSITIES = (8, 32)  # neighbours from whose distance the density around a direction is taken; the larger one counts
KEPT = 4  # catalogues whose pairs are remembered: a camera looks at one sky again and again
SAMPLED = 200  # directions from which it is estimated up to which angle there are so many pairs


class Catalogue(NamedTuple):
    """Unit directions (n, 3), their density (n,) a steradian, and all pairs of them up to the chord `widest`."""

    directions: Array
    density: Array
    pairs: Pairs
    widest: float

    def sky(self, reach: float) -> Sky:
        """The directions in cells, to be looked up within a chord of `reach`."""
        # A copy may be written to, as the points that are looked up elsewhere: the loops are compiled once.
        return Sky(hashed(self.directions.copy(), reach), self.density)


def catalogue_of(directions: Array, most_pairs: int) -> Catalogue:
    """What is looked up of unit directions (n, 3); the last ones are remembered."""
    return _catalogue(directions.tobytes(), most_pairs)


@lru_cache(KEPT)
def _catalogue(content: bytes, most_pairs: int) -> Catalogue:
    """Of n directions k - 1 more lie within the chord d of one: their density is k / (pi d^2), for a cap of the sphere
    has the area pi d^2. With the direction itself among the k the mean of its inverse is that of an even spread."""
    directions = np.frombuffer(content).reshape(-1, 3)
    tree, count = cKDTree(directions), len(directions)
    density = np.full(count, count / (4 * math.pi))
    for k in DENSITIES:
        k = min(k, count - 1)
        distance = np.maximum(tree.query(directions, [k + 1])[0][:, 0], 1e-9)
        density = np.maximum(density, k / (math.pi * distance**2))
    some = directions[:: max(count // SAMPLED, 1)]
    chords = np.sqrt(np.maximum(2 - 2 * some @ directions.T, 0.0))
    widest = float(np.quantile(chords, min(2 * most_pairs / count**2, 1.0)))
    pairs = tree.query_pairs(widest, output_type="ndarray")
    pairs = pairs[np.lexsort(pairs.T[::-1])]
    chord = np.linalg.norm(directions[pairs[:, 0]] - directions[pairs[:, 1]], axis=-1)
    order = np.argsort(chord, kind="stable")
    order = order[chord[order] > 0]
    first, second = np.ascontiguousarray(pairs[order].T.astype(np.int64))
    return Catalogue(directions, density, Pairs(chord[order], first, second), widest)
