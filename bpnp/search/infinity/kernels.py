"""Look-up tables of a catalogue of directions, and the compiled loops over them.

The tables hold the nearest neighbours of each direction, and the directions near a point of the sphere. One loop scores
directions whose neighbours match those of an image point; the other fits rotations. With labels, only points with equal
labels match; -1 matches any.
"""

import math
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from bpnp.search.config import SKY
from bpnp.search.enumeration.matching import fits
from bpnp.search.kernels.neighbours import HashedPoints, entry
from bpnp.search.kernels.vectors import F, compiled, cross, part, rotated, turn

Array = NDArray[np.float64]
Labels = NDArray[np.int64]
LOG_MATCHED = math.log(SKY.matched)  # log probability of a match under the true rotation
TURN = 1 << 16  # steps of an azimuth in a full circle


class Sky(NamedTuple):
    """Directions for look-up within a chord.

    Attributes:
        table: Hash table of unit directions (n, 3).
        density: (2, n) density around each direction, per steradian: of all directions, and of those whose label fits.
        labels: (n,) labels; (0,) without labels.
    """

    table: HashedPoints
    density: Array
    labels: Labels


class Neighbours(NamedTuple):
    """Nearest neighbours of each direction, by ascending distance.

    Attributes:
        place: (n, k) indices of the neighbours.
        chord: (n, k) chords to them.
        azimuth: (n, k) azimuths in `TURN` steps per circle, from a zero of each direction.
    """

    place: NDArray[np.int32]
    chord: NDArray[np.float32]
    azimuth: NDArray[np.int32]


class Catalogue(NamedTuple):
    """Catalogue of directions.

    Attributes:
        directions: (n, 3) unit vectors.
        density: (2, n) density around each, per steradian: of all directions, and of those whose label fits.
        neighbours: Nearest neighbours of each.
    """

    directions: Array
    density: Array
    neighbours: Neighbours


def catalogue_of(directions: Array, labels: Labels | None = None) -> Catalogue:
    """Build the catalogue of unit directions (n, 3) with labels (n,); the last `SKY.catalogues` ones are cached."""
    return _catalogue(directions.tobytes(), None if labels is None else labels.tobytes())


@lru_cache(SKY.catalogues)
def _catalogue(content: bytes, content_of_labels: bytes | None) -> Catalogue:
    """Build the catalogue of the n directions and labels with these bytes."""
    directions = np.frombuffer(content).reshape(-1, 3)
    count = len(directions)
    nearest = min(max(SKY.stored // count, SKY.densities[-1]), count - 1)
    chord, place = (x[:, 1:] for x in cKDTree(directions).query(directions, nearest + 1))
    every = fitting = _densities(chord)
    if content_of_labels is not None:
        fitting = _densities_of_labels(directions, np.frombuffer(content_of_labels, np.int64), every)
    azimuth = azimuths(directions, directions[place])
    neighbours = Neighbours(place.astype(np.int32), chord.astype(np.float32), azimuth)
    return Catalogue(directions, np.stack([every, fitting]), neighbours)


def _densities(chord: Array) -> Array:
    """Return the densities (n,) of directions from the chords (n, k) to their nearest neighbours.

    A cap of the sphere with the chord d has the area pi d^2. If d is the chord to the k-th neighbour, the density is
    k / (pi d^2): k - 1 neighbours lie within d, and the direction itself. The mean of its inverse is that of an even
    spread.
    """
    count, nearest = chord.shape
    density = np.full(count, count / (4 * math.pi))
    for k in SKY.densities:
        k = min(k, nearest)
        if k:
            density = np.maximum(density, k / (math.pi * np.maximum(chord[:, k - 1], 1e-9) ** 2))
    return density


def _densities_of_labels(directions: Array, labels: Labels, every: Array) -> Array:
    """Return the density (n,) around each direction of those that have its label or -1.

    Args:
        directions: (n, 3) unit vectors.
        labels: (n,) labels; a direction with -1 has the density of all directions.
        every: (n,) density of all directions.
    """
    density, values = every.copy(), np.unique(labels[labels >= 0])
    any_label = np.flatnonzero(labels < 0)
    order = np.argsort(labels, kind="stable")
    first, last = (np.searchsorted(labels[order], values, side) for side in ("left", "right"))
    for start, end in zip(first.tolist(), last.tolist(), strict=True):
        members = np.r_[order[start:end], any_label]
        points, nearest = directions[members], min(SKY.densities[-1], len(members) - 1)
        chord = np.empty((1, 0)) if not nearest else cKDTree(points).query(points, nearest + 1)[0][:, 1:]
        density[members[: end - start]] = _densities(chord)[: end - start]
    return density


def azimuths(centres: Array, others: Array) -> NDArray[np.int32]:
    """Return the azimuths of unit vectors around centres.

    Args:
        centres: (c, 3) unit vectors.
        others: (c, k, 3) unit vectors.

    Returns:
        (c, k) azimuths in `TURN` steps per circle, from a zero of each centre.
    """
    across = np.cross(centres, np.eye(3)[np.abs(centres).argmin(-1)])
    across /= np.linalg.norm(across, axis=-1, keepdims=True)
    x, y = (np.einsum("cka,ca->ck", others, axis) for axis in (across, np.cross(centres, across)))
    return np.asarray(np.arctan2(y, x) * (TURN / (2 * math.pi)), np.int32) & (TURN - 1)


class Rays(NamedTuple):
    """Image points around one, by ascending distance.

    Attributes:
        low: (k,) smallest possible chord to the point.
        high: (k,) largest possible chord.
        azimuth: (k,) azimuth in `TURN` steps per circle.
        nats: (k,) log likelihood ratio of a neighbour there under the true rotation and by chance.
        label: (k,) label of the point, -1 for any.
    """

    low: NDArray[np.float32]
    high: NDArray[np.float32]
    azimuth: NDArray[np.int32]
    nats: NDArray[np.float32]
    label: Labels


class Image(NamedTuple):
    """Image points.

    Attributes:
        bearings: (m, 3) unit vectors.
        pixel: (m,) angle of a pixel at each, radians.
        labels: (m,) labels, -1 for any; (0,) without labels.
    """

    bearings: Array
    pixel: Array
    labels: Labels


class Fit(NamedTuple):
    """Rotation that is fitted.

    Attributes:
        rotation: (3, 3).
        normal: (3, 3) normal matrix.
        match: (m,) index of the direction of each image point, -1 for none.
        squared: (m,) squared chord to it, in squared pixels.
    """

    rotation: Array
    normal: Array
    match: NDArray[np.int64]
    squared: Array


@part
def _nearest(sky: Any, x: Any, y: Any, z: Any, squared: Any, label: Any) -> Any:
    """Return the index of the nearest direction within a squared chord, -1 for none, and its squared chord.

    Only directions whose label fits count.
    """
    directions, reach, heads, links = sky.table
    place, least = -1, squared
    e = heads[entry(heads, x, y, z, 2 * reach)]
    while e >= 0:
        j = e >> 3
        dx, dy, dz = directions[j, 0] - x, directions[j, 1] - y, directions[j, 2] - z
        distance = dx * dx + dy * dy + dz * dz
        if distance < least and (len(sky.labels) == 0 or fits(sky.labels[j], label)):
            place, least = j, distance
        e = links[e]
    return place, least


@compiled
def vote(neighbours: Any, labels: Any, places: Any, rays: Any, shift: int, bins: Any, value: Any, bin_of: Any) -> None:
    """Score the agreement of an image point with directions: each ray votes for azimuth shifts to neighbours.

    Args:
        neighbours: `Neighbours` of all directions.
        labels: (n,) labels of the directions; (0,) without labels.
        places: (p,) indices of the directions.
        rays: `Rays` of the image point.
        shift: Right shift of an azimuth that gives its bin.
        bins: (2^s,) working memory for the votes; two adjacent bins count together.
        value: (p,) output, the largest votes, nats.
        bin_of: (p,) output, the second of the two bins with these votes.
    """
    count, mask, labelled = neighbours.chord.shape[1], len(bins) - 1, len(labels) > 0
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
                if labelled and not fits(labels[neighbours.place[a, e]], rays.label[k]):
                    e += 1
                    continue
                turned = ((neighbours.azimuth[a, e] - rays.azimuth[k]) & (TURN - 1)) >> shift
                for c in (turned, (turned + 1) & mask):
                    bins[c] += rays.nats[k]
                    if bins[c] > best:
                        best, where = bins[c], c
                e += 1
        value[p], bin_of[p] = best, where


@part
def _invert(normal: Any, matrix: Any) -> None:
    """Invert a positive definite matrix (3, 3), slightly damped, by Gauss-Jordan elimination; write it to `matrix`."""
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
    """Fit a rotation by Gauss-Newton steps on the nearest directions.

    For the rotation w of a direction v seen at f, the normal matrix is the sum of I - f f^T, and v x f the gradient.

    Args:
        image: `Image` with m points.
        chosen: (k,) indices of the image points that are used.
        sky: `Sky` of the directions.
        reach: Largest distance of a match, pixels; it grows with the uncertainty of the rotation.
        rounds: Number of steps.
        result: `Fit`, updated in place; its normal matrix is the prior information.
        scratch: (4, 3) working memory.

    Returns:
        Log likelihood ratio of the matches under the rotation and by chance, nats.
    """
    covariance, step, turned, normal = scratch[:3], scratch[3], result.rotation, result.normal
    directions, widest, total, labelled = sky.table.points, sky.table.tolerance, 0.0, len(sky.labels) > 0
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
            label = image.labels[i] if labelled else -1
            result.match[i] = -1
            if squared > widest * widest:
                continue
            place, distance = _nearest(
                sky,
                turned[0, 0] * x + turned[1, 0] * y + turned[2, 0] * z,
                turned[0, 1] * x + turned[1, 1] * y + turned[2, 1] * z,
                turned[0, 2] * x + turned[1, 2] * y + turned[2, 2] * z,
                squared,
                label,
            )
            if place < 0:
                total += LOG_MATCHED
                continue
            fitting = 1 if labelled and label >= 0 and sky.labels[place] >= 0 else 0
            likely = math.pi * sky.density[fitting, place] * squared
            if likely > SKY.crowded:
                continue
            total += LOG_MATCHED - math.log(likely)
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
