"""Directions as a search for a rotation looks them up: each one's neighbours, and those near a place of the sphere."""

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from bpnp.search.infinity.kernels import TURN, Neighbours, Sky
from bpnp.search.kernels.neighbours import hashed

Array = NDArray[np.float64]
DENSITIES = (8, 32)  # neighbours from whose distance the density around a direction is taken; the larger one counts
KEPT = 4  # catalogues that are remembered: a camera looks at one sky again and again
MOST = 600_000  # neighbours of all directions, 7 megabytes


class Catalogue(NamedTuple):
    """Unit directions (n, 3), their density (n,) a steradian, and the nearest neighbours of each."""

    directions: Array
    density: Array
    neighbours: Neighbours

    def sky(self, reach: float) -> Sky:
        """The directions in cells, to be looked up within a chord of `reach`."""
        # A copy may be written to, as the points that are looked up elsewhere: the loops are compiled once.
        return Sky(hashed(self.directions.copy(), reach), self.density)


def catalogue_of(directions: Array) -> Catalogue:
    """What is looked up of unit directions (n, 3); the last ones are remembered."""
    return _catalogue(directions.tobytes())


@lru_cache(KEPT)
def _catalogue(content: bytes) -> Catalogue:
    """Of n directions k - 1 more lie within the chord d of one: their density is k / (pi d^2), for a cap of the sphere
    has the area pi d^2. With the direction itself among the k the mean of its inverse is that of an even spread."""
    directions = np.frombuffer(content).reshape(-1, 3)
    count = len(directions)
    nearest = min(max(MOST // count, DENSITIES[-1]), count - 1)
    chord, place = (x[:, 1:] for x in cKDTree(directions).query(directions, nearest + 1))
    density = np.full(count, count / (4 * math.pi))
    for k in DENSITIES:
        k = min(k, nearest)
        density = np.maximum(density, k / (math.pi * np.maximum(chord[:, k - 1], 1e-9) ** 2))
    azimuth = azimuths(directions, directions[place])
    return Catalogue(directions, density, Neighbours(place.astype(np.int32), chord.astype(np.float32), azimuth))


def azimuths(centres: Array, others: Array) -> NDArray[np.int32]:
    """Directions (c, k) in which unit vectors (c, k, 3) lie from others (c, 3), in `TURN` steps a turn, from a zero of
    each centre."""
    across = np.cross(centres, np.eye(3)[np.abs(centres).argmin(-1)])
    across /= np.linalg.norm(across, axis=-1, keepdims=True)
    x, y = (np.einsum("cka,ca->ck", others, axis) for axis in (across, np.cross(centres, across)))
    return np.asarray(np.arctan2(y, x) * (TURN / (2 * math.pi)), np.int32) & (TURN - 1)
