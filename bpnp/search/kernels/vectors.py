"""Vectors and rotations in the compiled loops, component by component, and the decorators that compile the loops."""

import math
from typing import Any

import numpy as np

from bpnp.runtime import FAST, compiler

LARGEST_TURN = 0.5  # largest rotation of one step [radians; not tuned]

F = np.float32
compiled = compiler(fastmath=FAST | {"afn"})
# For functions that only compiled functions call. They are inlined: the calling loops would not vectorise otherwise,
# and take twice the time.
part = compiler(fastmath=FAST | {"afn"}, part=True, forceinline=True)


@part
def sum_of(values: Any) -> Any:
    """Return the sum of float32 values (k,); numba's own sum takes longer to compile."""
    total = F(0)
    for i in range(len(values)):
        total += values[i]
    return total


@part
def copy_pose(rotation: Any, translation: Any, to_rotation: Any, to_translation: Any) -> None:
    """Copy a pose element by element: numba compiles an assignment of arrays for 3 s, mostly for an error message."""
    for r in range(3):
        for c in range(3):
            to_rotation[r, c] = rotation[r, c]
        to_translation[r] = translation[r]


@part
def cross(x: Any, y: Any, z: Any, a: Any, b: Any, c: Any) -> Any:
    """Return the cross product (x, y, z) x (a, b, c)."""
    return y * c - z * b, z * a - x * c, x * b - y * a


@part
def rotated(rotation: Any, x: Any, y: Any, z: Any) -> Any:
    """Return R (x, y, z)."""
    return (
        rotation[0, 0] * x + rotation[0, 1] * y + rotation[0, 2] * z,
        rotation[1, 0] * x + rotation[1, 1] * y + rotation[1, 2] * z,
        rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2] * z,
    )


@part
def direction(x: Any, y: Any, z: Any) -> Any:
    """Return the unit vector of (x, y, z) as the offset from (0, 0, 1), and 1 / |(x, y, z)|."""
    inverse = F(1) / math.sqrt(x * x + y * y + z * z + F(1e-12))
    x, y, z = x * inverse, y * inverse, z * inverse
    return x, y, -(x * x + y * y) / (F(1) + z) if z > F(0) else z - F(1), inverse


@part
def turn(rotation: Any, vector: Any) -> None:
    """Apply R <- exp([w]x) R in place through a unit quaternion; w = vector[:3], clipped to length `LARGEST_TURN`."""
    x, y, z = vector[0], vector[1], vector[2]
    angle: Any = math.sqrt(x * x + y * y + z * z)
    shrink = F(LARGEST_TURN) / angle if angle > F(LARGEST_TURN) else F(1)
    angle *= shrink
    half = F(0.5) * angle
    factor = shrink * (F(0.5) if angle < F(1e-4) else math.sin(half) / angle)
    w = math.cos(half)
    x *= factor
    y *= factor
    z *= factor
    d00, d01, d02 = 1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)
    d10, d11, d12 = 2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)
    d20, d21, d22 = 2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)
    for c in range(3):
        r0, r1, r2 = rotation[0, c], rotation[1, c], rotation[2, c]
        rotation[0, c] = d00 * r0 + d01 * r1 + d02 * r2
        rotation[1, c] = d10 * r0 + d11 * r1 + d12 * r2
        rotation[2, c] = d20 * r0 + d21 * r1 + d22 * r2
