"""Random numbers that are a function of a key and a place, in torch: the same on every device and in every batch.

SplitMix64 (Steele, Lea, Flood, OOPSLA 2014) as a hash of (key, place): nothing is kept between calls, so a batch is
drawn in parallel and each of its rows depends on its own key alone. torch's int64 wraps around as the hash wants it.
"""

import math
from enum import IntEnum

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from bpnp.geometry import quaternion_rotation

GOLDEN, FIRST, SECOND = (value - 2**64 for value in (0x9E3779B97F4A7C15, 0xBF58476D1CE4E5B9, 0x94D049BB133111EB))
PLACE_BITS = 22  # of a number to be sorted: four million points; 39 random bits are left above them


# What random numbers of a problem are for; see `stream`.
Purpose = IntEnum("Purpose", "SUBSET POSE NOISE AMOUNTS CHOICE OUTLIERS2D OUTLIERS3D TURN ORDER2D ORDER3D", start=0)


def row_keys(index: Int[Tensor, " b"], *seeds: int) -> Int[Tensor, " b"]:
    """A key for each row, of its index and of all `seeds`, in their order."""
    key = 0
    for seed in seeds:
        key = int(_mixed(torch.tensor(_wrapped(key + (seed + 1) * GOLDEN))))
    return _mixed(key + index * GOLDEN)


def stream(keys: Int[Tensor, " b"], purpose: Purpose) -> Int[Tensor, " b"]:
    """A key of its own for each purpose."""
    return _mixed(keys + _wrapped((purpose + 1) * FIRST))


def rotations(keys: Int[Tensor, " b"]) -> Float[Tensor, "b 3 3"]:
    """A uniformly random rotation for each row, float64: a normal 4-vector has a uniform direction."""
    return quaternion_rotation(normal(keys, 4))


def random_bits(keys: Int[Tensor, " b"], count: int) -> Int[Tensor, "b count"]:
    """`count` numbers a row, uniform over all int64."""
    places = torch.arange(1, count + 1, device=keys.device).mul_(GOLDEN)
    return _mixed(keys[:, None] + places)


def uniform(keys: Int[Tensor, " b"], count: int) -> Float[Tensor, "b count"]:
    """`count` numbers a row, uniform in (0, 1), float64."""
    return (_shifted(random_bits(keys, count), 11).double() + 0.5) * 2.0**-53


def normal(keys: Int[Tensor, " b"], count: int) -> Float[Tensor, "b count"]:
    """`count` standard normal numbers a row by the Box-Muller transform, float64."""
    half = (count + 1) // 2
    radius, angle = uniform(keys, 2 * half).unflatten(-1, (half, 2)).unbind(-1)
    radius, angle = (-2 * radius.log()).sqrt(), 2 * math.pi * angle
    return torch.stack([radius * angle.cos(), radius * angle.sin()], -1).flatten(1)[:, :count]


def permutations(
    keys: Int[Tensor, " b"], count: int, group: Int[Tensor, "b count"] | None = None
) -> Int[Tensor, "b count"]:
    """A random order of range(count) for each row; with `group` (0 to 3) all of group 0 come first, and so on.

    The order of a group does not depend on the places of later groups, so padding in the last group changes nothing.
    """
    if count >= 1 << PLACE_BITS:
        raise ValueError(f"expected fewer than {1 << PLACE_BITS} points in a set, got {count}; try `max_points`")
    numbers = _shifted(random_bits(keys, count), 3 + PLACE_BITS) << PLACE_BITS
    numbers += torch.arange(count, device=keys.device)
    if group is not None:
        numbers += group << 61
    if numbers.device.type == "cpu":
        numbers = torch.from_numpy(np.sort(numbers.numpy(), axis=-1))  # 15 times faster than torch's
    else:
        numbers = numbers.sort(-1).values
    return numbers & ((1 << PLACE_BITS) - 1)


def _wrapped(value: int) -> int:
    """The int64 that is `value` modulo 2^64."""
    return (value + 2**63) % 2**64 - 2**63


def _shifted(value: Tensor, bits: int) -> Tensor:
    """Shift right and fill with zeros; torch fills with the sign."""
    return (value >> bits).bitwise_and_((1 << (64 - bits)) - 1)


def _mixed(value: Tensor) -> Tensor:
    value = (_shifted(value, 30).bitwise_xor_(value)).mul_(FIRST)
    value = (_shifted(value, 27).bitwise_xor_(value)).mul_(SECOND)
    return _shifted(value, 31).bitwise_xor_(value)
