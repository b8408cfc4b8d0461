"""Random numbers that are a function of a key and a place, in torch: the same on every device and in every batch.

SplitMix64 (Steele, Lea, Flood, OOPSLA 2014) as a hash of (key, place): nothing is kept between calls, so a batch can be
drawn in parallel and each of its rows depends on its own key alone. torch's int64 wraps around as the hash wants it.
"""

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor

GOLDEN, FIRST, SECOND = (value - 2**64 for value in (0x9E3779B97F4A7C15, 0xBF58476D1CE4E5B9, 0x94D049BB133111EB))


def row_keys(seed: int, epoch: int, index: Int[Tensor, " b"], stream: int) -> Int[Tensor, " b"]:
    """A key for each row, of the seed, the epoch, its index and what the numbers are for."""
    key = torch.zeros_like(index)
    for part in (seed, epoch, stream):
        key = _mixed(key + part * _odd(key))
    return _mixed(key + index * _odd(key))


def random_bits(keys: Int[Tensor, " b"], count: int) -> Int[Tensor, "b count"]:
    """`count` numbers a row, uniform over all int64."""
    places = torch.arange(1, count + 1, device=keys.device)
    return _mixed(keys[:, None] + places * GOLDEN)


def uniform(keys: Int[Tensor, " b"], count: int) -> Float[Tensor, "b count"]:
    """`count` numbers a row, uniform in (0, 1), float64."""
    return (_shifted(random_bits(keys, count), 11).double() + 0.5) * 2.0**-53


def normal(keys: Int[Tensor, " b"], count: int) -> Float[Tensor, "b count"]:
    """`count` standard normal numbers a row by the Box-Muller transform, float64."""
    radius, angle = uniform(keys, 2 * count).unflatten(-1, (2, count)).unbind(1)
    return (-2 * radius.log()).sqrt() * (2 * math.pi * angle).cos()


def permutations(keys: Int[Tensor, " b"], count: int) -> Int[Tensor, "b count"]:
    """A random order of range(count) for each row."""
    return random_bits(keys, count).argsort(-1)


def _odd(like: Tensor) -> Tensor:
    return torch.full_like(like, GOLDEN)


def _shifted(value: Tensor, bits: int) -> Tensor:
    """Shift right and fill with zeros; torch fills with the sign."""
    return (value >> bits) & ((1 << (64 - bits)) - 1)


def _mixed(value: Tensor) -> Tensor:
    value = (value ^ _shifted(value, 30)) * FIRST
    value = (value ^ _shifted(value, 27)) * SECOND
    return value ^ _shifted(value, 31)
