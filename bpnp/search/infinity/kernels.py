"""The compiled loops: rotations from pairs of directions with one angle, tested on their surroundings and fitted."""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bpnp.loops.vectors import compiled, cross, part, rotated, turn
from bpnp.search.kernels.neighbours import HashedPoints, entry

Array = NDArray[np.float64]
LOG_HALF = math.log(0.5)  # of a point that the true rotation explains
CROWDED = 0.45  # probability that chance puts a direction within reach of a point; beyond, a match says nothing


class Sky(NamedTuple):
    """Directions (n, 3) in a table to be looked up within a chord, and how many there are around each (n,), a
    steradian."""

    table: HashedPoints
    density: Array


class Pairs(NamedTuple):
    """Pairs of catalogue directions, by ascending angle: its chord, and both places."""

    chord: Array
    first: NDArray[np.int64]
    second: NDArray[np.int64]


class Patch(NamedTuple):
    """Image points around a pair (k, 3) in the frame of its sum and difference, and the squared chord (k,) within which
    each has its match."""

    points: Array
    squared: Array


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
def propose(sky: Any, pairs: Any, low: int, high: int, patch: Any, abandoned: float, kept: Any, value: Any) -> None:
    """Test the rotations that take the pairs low to high, either way round, to an image pair; keep the best.

    kept (b, 3, 3): axes of the catalogue's pair, as rows; value (b,): nats by which the matches of the patch are
    likelier than by chance, descending; -inf for an empty place.
    """
    last, directions = len(value) - 1, sky.table.points
    for t in range(low, high):
        a, b = pairs.first[t], pairs.second[t]
        ax, ay, az = directions[a, 0], directions[a, 1], directions[a, 2]
        bx, by, bz = directions[b, 0], directions[b, 1], directions[b, 2]
        sx, sy, sz = ax + bx, ay + by, az + bz
        scale = 1 / math.sqrt(sx * sx + sy * sy + sz * sz)
        sx, sy, sz = scale * sx, scale * sy, scale * sz
        scale = 1 / pairs.chord[t]
        dx, dy, dz = scale * (ax - bx), scale * (ay - by), scale * (az - bz)
        nx, ny, nz = cross(sx, sy, sz, dx, dy, dz)
        chance = math.pi * max(sky.density[a], sky.density[b])
        for sign in (1.0, -1.0):
            total = 0.0
            for k in range(len(patch.squared)):
                p, q, r = patch.points[k, 0], sign * patch.points[k, 1], sign * patch.points[k, 2]
                x, y, z = p * sx + q * dx + r * nx, p * sy + q * dy + r * ny, p * sz + q * dz + r * nz
                place, _ = _nearest(sky, x, y, z, patch.squared[k])
                likely = min(CROWDED, chance * patch.squared[k])
                total += LOG_HALF - math.log(1 - likely if place < 0 else likely)
                if total < -abandoned:
                    break
            if total > value[last]:
                c = last
                while c > 0 and value[c - 1] < total:
                    value[c] = value[c - 1]
                    for e in range(9):
                        kept[c, e // 3, e % 3] = kept[c - 1, e // 3, e % 3]
                    c -= 1
                value[c] = total
                kept[c, 0, 0], kept[c, 0, 1], kept[c, 0, 2] = sx, sy, sz
                kept[c, 1, 0], kept[c, 1, 1], kept[c, 1, 2] = sign * dx, sign * dy, sign * dz
                kept[c, 2, 0], kept[c, 2, 1], kept[c, 2, 2] = sign * nx, sign * ny, sign * nz


@part
def _invert(matrix: Any) -> None:
    """A positive definite matrix in place, by Gauss and Jordan."""
    size = len(matrix)
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
        for r in range(3):
            step[r] = 0.0
            for c in range(3):
                covariance[r, c] = normal[r, c]
                normal[r, c] = 0.0
            covariance[r, r] += 1e-9 * covariance[r, r] + 1e-30
        _invert(covariance)
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
        for r in range(3):
            for c in range(3):
                covariance[r, c] = normal[r, c]
            covariance[r, r] += 1e-9 * covariance[r, r] + 1e-30
        _invert(covariance)
        step[0], step[1], step[2] = rotated(covariance, gx, gy, gz)
        turn(turned, step)
    return total
