"""The compiled loops: rotations from pairs of directions with one angle, tested on their surroundings and fitted."""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bpnp.loops.vectors import compiled, cross, part, rotated, turn
from bpnp.search.kernels.neighbours import entry

Array = NDArray[np.float64]
LOG_HALF = math.log(0.5)  # of a point that the true rotation explains
CROWDED = 0.45  # probability that chance puts a direction within reach of a point; beyond, a match says nothing


class Sky(NamedTuple):
    """Directions (n, 3) in a hash table with cells of twice the `reach` (chord), and how many there are around each
    (n,), a steradian."""

    directions: Array
    density: Array
    heads: NDArray[np.int64]
    links: NDArray[np.int64]
    reach: float


class Pairs(NamedTuple):
    """Pairs of catalogue directions, by ascending angle: its chord, and both places."""

    chord: Array
    first: NDArray[np.int64]
    second: NDArray[np.int64]


class Patch(NamedTuple):
    """Image points around a pair (k, 3) in the frame of its sum and difference, and the squared chord (k,) within which
    each has its match; the focal length of this frame, where it is unknown."""

    points: Array
    squared: Array


class Image(NamedTuple):
    """Image points: rays (m, 3) with a focal length of one, and the angle of a pixel (m,) there, radians."""

    rays: Array
    pixel: Array


class Fit(NamedTuple):
    """A rotation (3, 3), logarithm of the focal length (1,), normal matrix (4, 4) and matches of the m points: place of
    the direction, -1 for none, and squared chord in squared pixels."""

    rotation: Array
    log_focal: Array
    normal: Array
    match: NDArray[np.int64]
    squared: Array


@part
def _nearest(sky: Any, x: Any, y: Any, z: Any, squared: Any) -> Any:
    """Place of the direction nearest to (x, y, z) within the squared chord, -1 for none, and its squared chord."""
    place, least = -1, squared
    e = sky.heads[entry(sky.heads, x, y, z, 2 * sky.reach)]
    while e >= 0:
        j = e >> 3
        dx, dy, dz = sky.directions[j, 0] - x, sky.directions[j, 1] - y, sky.directions[j, 2] - z
        distance = dx * dx + dy * dy + dz * dz
        if distance < least:
            place, least = j, distance
        e = sky.links[e]
    return place, least


@compiled
def propose(sky: Any, pairs: Any, low: int, high: int, patch: Any, abandoned: float, kept: Any, value: Any) -> None:
    """Test the rotations that take the pairs low to high, either way round, to an image pair; keep the best.

    kept (b, 3, 3): axes of the catalogue's pair, as rows; value (b,): nats by which the matches of the patch are
    likelier than by chance, descending; -inf for an empty place.
    """
    last = len(value) - 1
    for t in range(low, high):
        a, b = pairs.first[t], pairs.second[t]
        ax, ay, az = sky.directions[a, 0], sky.directions[a, 1], sky.directions[a, 2]
        bx, by, bz = sky.directions[b, 0], sky.directions[b, 1], sky.directions[b, 2]
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


@part
def _derivative(image: Any, i: int, focal: float, free: bool, jacobian: Any) -> Any:
    """Bearing of point i; its derivative (3, 4) by a turn against the scene's, and by the logarithm of the
    focal length if that is free."""
    x, y, z = image.rays[i, 0], image.rays[i, 1], image.rays[i, 2] * focal
    scale = 1 / math.sqrt(x * x + y * y + z * z)
    x, y, z = scale * x, scale * y, scale * z
    jacobian[0, 0] = jacobian[1, 1] = jacobian[2, 2] = 0.0
    jacobian[0, 1], jacobian[1, 0] = -z, z
    jacobian[0, 2], jacobian[2, 0] = y, -y
    jacobian[1, 2], jacobian[2, 1] = -x, x
    if free:
        jacobian[0, 3], jacobian[1, 3], jacobian[2, 3] = -x * z * z, -y * z * z, z - z * z * z
    return x, y, z


@compiled
def fit(image: Any, chosen: Any, sky: Any, reach: float, rounds: int, free: bool, result: Any, scratch: Any) -> float:
    """Gauss-Newton steps on the nearest directions within `reach` pixels, and as much more as the fit is uncertain.

    chosen (k,): the image points that take part. free: whether the focal length is fitted. result: `Fit`, in place; its
    normal matrix is that of what is known before. scratch (9, 4). Returns the nats by which the matches are likelier
    than by chance.
    """
    covariance, jacobian, gradient = scratch[:4], scratch[4:7], scratch[7]
    for c in range(3):
        jacobian[c, 3] = 0.0
    total = 0.0
    for _ in range(rounds):
        focal = math.exp(result.log_focal[0])
        for r in range(4):
            gradient[r] = 0.0
            for c in range(4):
                covariance[r, c] = result.normal[r, c]
                result.normal[r, c] = 0.0
            covariance[r, r] *= 1 + 1e-9
        _invert(covariance)
        total = 0.0
        for c in range(len(chosen)):
            i = chosen[c]
            x, y, z = _derivative(image, i, focal, free, jacobian)
            variance = 0.0
            for r in range(4):
                for c in range(4):
                    product = 0.0
                    for e in range(3):
                        product += jacobian[e, r] * jacobian[e, c]
                    variance += 0.5 * product * covariance[r, c]
            pixel = image.pixel[i] / focal
            squared = reach * reach * (pixel * pixel + variance)
            result.match[i] = -1
            if squared > sky.reach * sky.reach:
                continue
            turned = result.rotation
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
            result.match[i], result.squared[i] = place, distance / (pixel * pixel)
            vx, vy, vz = rotated(turned, sky.directions[place, 0], sky.directions[place, 1], sky.directions[place, 2])
            weight = 1 / (pixel * pixel + variance)
            for r in range(4):
                gradient[r] += weight * (
                    jacobian[0, r] * (vx - x) + jacobian[1, r] * (vy - y) + jacobian[2, r] * (vz - z)
                )
                for c in range(4):
                    product = 0.0
                    for e in range(3):
                        product += jacobian[e, r] * jacobian[e, c]
                    result.normal[r, c] += weight * product
        if not free:
            result.normal[3, 3] = 1.0
        for r in range(4):
            for c in range(4):
                covariance[r, c] = result.normal[r, c]
            covariance[r, r] = covariance[r, r] * (1 + 1e-9) + 1e-30
        _invert(covariance)
        step = scratch[8]
        for r in range(4):
            step[r] = 0.0
            for c in range(4):
                step[r] += covariance[r, c] * gradient[c]
            step[r] = step[r] if abs(step[r]) < 0.5 else 0.0
        turn(result.rotation, step)
        result.log_focal[0] += step[3]
    return total
