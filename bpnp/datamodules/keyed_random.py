"""Random numbers of a problem, a function of its key alone: numpy Generators, the same in every batch.

A generator for each problem and purpose, seeded by (seeds, index, purpose). The first numbers of a generator do not
depend on how many are drawn, so padding changes nothing.
"""

from collections.abc import Sequence
from enum import IntEnum
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy.typing import NDArray
from torch import Tensor

from bpnp.geometry import quaternion_rotation

Key = tuple[int, ...]  # seeds and index of a problem
Generators = Sequence[np.random.Generator]  # one a problem

# What random numbers of a problem are for; see `generators`.
Purpose = IntEnum("Purpose", "SUBSET POSE NOISE AMOUNTS CHOICE OUTLIERS2D OUTLIERS3D TURN ORDER2D ORDER3D", start=0)


def row_keys(index: Int[Tensor, " b"], *seeds: int) -> list[Key]:
    """Return a key for each index, of all `seeds` in their order."""
    return [(*seeds, i) for i in index.tolist()]


def generators(keys: Sequence[Key], purpose: Purpose) -> list[np.random.Generator]:
    """Return a generator for each key, with numbers of its own for each purpose."""
    return [np.random.default_rng([*key, purpose]) for key in keys]


def rotations(generators: Generators) -> Float[Tensor, "b 3 3"]:
    """Draw a uniformly random rotation a generator, float64: a normal 4-vector has a uniform direction."""
    return quaternion_rotation(normal(generators, 4))


def uniform(generators: Generators, count: int) -> Float[Tensor, "b count"]:
    """Draw `count` numbers a generator, uniform in [0, 1), float64."""
    return torch.from_numpy(_uniform(generators, count))


def normal(generators: Generators, count: int) -> Float[Tensor, "b count"]:
    """Draw `count` standard normal numbers a generator, float64."""
    return torch.from_numpy(np.stack([generator.standard_normal(count) for generator in generators]))


def permutations(
    generators: Generators, count: int, group: Int[Tensor, "b count"] | None = None
) -> Int[Tensor, "b count"]:
    """Draw an order of range(count) a generator; with `group`, all of group 0 come first, and so on.

    The order of a group does not depend on the indices of later groups, so padding in the last group changes nothing.
    """
    numbers = _uniform(generators, count)
    return torch.from_numpy(np.argsort(numbers if group is None else numbers + group.numpy(), axis=-1))


def _uniform(generators: Generators, count: int) -> NDArray[Any]:
    return np.stack([generator.random(count) for generator in generators])
