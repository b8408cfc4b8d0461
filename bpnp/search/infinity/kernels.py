"""A catalogue of directions as it is looked up, each one's neighbours and those near a place of the sphere; and the
compiled loops over it: directions whose neighbours lie as those of an image point do, and rotations that are fitted."""

import math
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from bpnp.loops.vectors import F, compiled, cross, part, rotated, turn
from bpnp.search.kernels.neighbours import HashedPoints, entry

Array = NDArray[np.float64]
LOG_HALF = math.log(0.5)  # of a point that the true rotation explains
TURN = 1 << 16  # steps of an azimuth
CROWDED = 0.45  # probability that chance puts a direction within reach of a point; beyond, a match says nothing
DENSITIES = (8, 32)  # neighbours from whose distance the density around a direction is taken; the larger one counts
KEPT = 4  # catalogues that are remembered: a camera looks at one sky again and again
MOST = 600_000  # neighbours of all directions, 7 megabytes


class Sky(NamedTuple):
    """Directions (n, 3) in a table to be looked up within a chord, and how many there are around each (n,), a
    steradian."""

    table: HashedPoints
    density: Array


class Neighbours(NamedTuple):
    """The nearest directions of each, by ascending distance: place (n, k), chord (n, k), and azimuth (n, k) in `TURN`
    steps a turn, from a zero of each."""

    place: NDArray[np.int32]
    chord: NDArray[np.float32]
    azimuth: NDArray[np.int32]


class Catalogue(NamedTuple):
    """Unit directions (n, 3), their density (n,) a steradian, and the nearest neighbours of each."""

    directions: Array
    density: Array
    neighbours: Neighbours


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


class Rays(NamedTuple):
    """The image points around one, by ascending distance: between which chords each may lie (k,), its azimuth (k,), and
    the nats by which a neighbour there is likelier under the true rotation than by chance (k,)."""

    low: NDArray[np.float32]
    high: NDArray[np.float32]
    azimuth: NDArray[np.int32]
    nats: NDArray[np.float32]


class Image(NamedTuple):
    """Image points: unit bearings (m, 3), and the angle of a pixel at each (m,), radians."""

    bearings: Array
    pixel: Array


class Fit(NamedTuple):
    """A rotation (3, 3), normal matrix (3, 3) and matches of the m points: place of the direction, -1 for none, and
    squared chord in squared pixels."""

    rotation: Array
    normal: Array
    match: NDArray[np.int64]
    squared: Array


@part
def _nearest(sky: Any, x: Any, y: Any, z: Any, squared: Any) -> Any:
    """Place of the direction nearest to (x, y, z) within the squared chord, -1 for none, and its squared chord."""
    directions, reach, heads, links = sky.table
    place, least = -1, squared
    e = heads[entry(heads, x, y, z, 2 * reach)]
    while e >= 0:
        j = e >> 3
        dx, dy, dz = directions[j, 0] - x, directions[j, 1] - y, directions[j, 2] - z
        distance = dx * dx + dy * dy + dz * dz
        if distance < least:
            place, least = j, distance
        e = links[e]
    return place, least


@compiled
def vote(neighbours: Any, places: Any, rays: Any, shift: int, bins: Any, value: Any, bin_of: Any) -> None:
    """How well an image point agrees with directions: each ray votes for the turns that take it to a neighbour.

    places (p,): of the directions. shift: of an azimuth to its place in bins (2^s,), of which two that lie side by side
    count together. value, bin_of (p,): the most nats, and the second of the bins that have them.
    """
    count, mask = neighbours.chord.shape[1], len(bins) - 1
    for p in range(len(places)):
        a = places[p]
        for c in range(len(bins)):
            bins[c] = 0
        first, best, where = 0, F(0), 0
        for k in range(len(rays.low)):
            while first < count and neighbours.chord[a, first] < rays.low[k]:
                first += 1
            e = first
            while e < count and neighbours.chord[a, e] <= rays.high[k]:
                turned = ((neighbours.azimuth[a, e] - rays.azimuth[k]) & (TURN - 1)) >> shift
                for c in (turned, (turned + 1) & mask):
                    bins[c] += rays.nats[k]
                    if bins[c] > best:
                        best, where = bins[c], c
                e += 1
        value[p], bin_of[p] = best, where


@part
def _invert(normal: Any, matrix: Any) -> None:
    """matrix (3, 3): the inverse of a positive definite one, a little damped, by Gauss and Jordan."""
    size = len(matrix)
    for r in range(size):
        for c in range(size):
            matrix[r, c] = normal[r, c]
        matrix[r, r] += 1e-9 * matrix[r, r] + 1e-30
    for c in range(size):
        pivot = 1 / matrix[c, c]
        matrix[c, c] = 1.0
        for k in range(size):
            matrix[c, k] *= pivot
        for r in range(size):
            if r != c:
                factor = matrix[r, c]
                matrix[r, c] = 0.0
                for k in range(size):
                    matrix[r, k] -= factor * matrix[c, k]


@compiled
def fit(image: Any, chosen: Any, sky: Any, reach: float, rounds: int, result: Any, scratch: Any) -> float:
    """Gauss-Newton steps on the nearest directions within `reach` pixels, and as much more as the fit is uncertain.

    chosen (k,): the image points that take part. result: `Fit`, in place; its normal matrix is that of what is known
    before. scratch (4, 3). Returns the nats by which the matches are likelier than by chance.

    For the turn w of a direction v seen at f, (I - f f^T) summed is the normal matrix and v x f the gradient.
    """
    covariance, step, turned, normal = scratch[:3], scratch[3], result.rotation, result.normal
    directions, widest, total = sky.table.points, sky.table.tolerance, 0.0
    for _ in range(rounds):
        _invert(normal, covariance)
        for r in range(3):
            for c in range(3):
                normal[r, c] = 0.0
        trace = covariance[0, 0] + covariance[1, 1] + covariance[2, 2]
        total = gx = gy = gz = 0.0
        for c in range(len(chosen)):
            i = chosen[c]
            x, y, z = image.bearings[i, 0], image.bearings[i, 1], image.bearings[i, 2]
            cx, cy, cz = rotated(covariance, x, y, z)
            variance = image.pixel[i] ** 2 + 0.5 * (trace - x * cx - y * cy - z * cz)
            squared = reach * reach * variance
            result.match[i] = -1
            if squared > widest * widest:
                continue
            place, distance = _nearest(
                sky,
                turned[0, 0] * x + turned[1, 0] * y + turned[2, 0] * z,
                turned[0, 1] * x + turned[1, 1] * y + turned[2, 1] * z,
                turned[0, 2] * x + turned[1, 2] * y + turned[2, 2] * z,
                squared,
            )
            if place < 0:
                total += LOG_HALF
                continue
            likely = math.pi * sky.density[place] * squared
            if likely > CROWDED:
                continue
            total += LOG_HALF - math.log(likely)
            result.match[i], result.squared[i] = place, distance / image.pixel[i] ** 2
            vx, vy, vz = rotated(turned, directions[place, 0], directions[place, 1], directions[place, 2])
            sx, sy, sz = cross(vx, vy, vz, x, y, z)
            weight = 1 / variance
            gx, gy, gz = gx + weight * sx, gy + weight * sy, gz + weight * sz
            for r in range(3):
                normal[r, r] += weight
                for e in range(3):
                    normal[r, e] -= weight * image.bearings[i, r] * image.bearings[i, e]
        _invert(normal, covariance)
        step[0], step[1], step[2] = rotated(covariance, gx, gy, gz)
        turn(turned, step)
    return total
