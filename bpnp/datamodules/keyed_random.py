"""Random numbers that depend only on a problem's key, so that they are the same in every batch.

There is a numpy Generator for each problem and purpose, seeded by (seeds, index, purpose). The first numbers of a
generator do not depend on how many are drawn, so padding changes nothing.
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
Generators = Sequence[np.random.Generator]  # one for each problem

# Purposes of random numbers; see `generators`.
Purpose = IntEnum("Purpose", "SUBSET POSE NOISE AMOUNTS CHOICE OUTLIERS2D OUTLIERS3D TURN ORDER2D ORDER3D", start=0)


def row_keys(index: Int[Tensor, " b"], *seeds: int) -> list[Key]:
    """Return a key for each index: all `seeds` in their order, then the index."""
    return [(*seeds, i) for i in index.tolist()]


def generators(keys: Sequence[Key], purpose: Purpose) -> list[np.random.Generator]:
    """Return a generator for each key; each purpose has its own random numbers."""
    return [np.random.default_rng([*key, purpose]) for key in keys]


def rotations(generators: Generators) -> Float[Tensor, "b 3 3"]:
    """Draw one uniformly random rotation from each generator, float64; a normal 4-vector has a uniform direction."""
    return quaternion_rotation(normal(generators, 4))


def uniform(generators: Generators, count: int) -> Float[Tensor, "b count"]:
    """Draw `count` numbers, uniform in [0, 1), from each generator, float64."""
    return torch.from_numpy(_uniform(generators, count))


def normal(generators: Generators, count: int) -> Float[Tensor, "b count"]:
    """Draw `count` standard normal numbers from each generator, float64."""
    return torch.from_numpy(np.stack([generator.standard_normal(count) for generator in generators]))


def permutations(
    generators: Generators, count: int, group: Int[Tensor, "b count"] | None = None
) -> Int[Tensor, "b count"]:
    """Draw a permutation of range(count) from each generator; all indices of group 0 come first, and so on.

    The order within a group does not depend on the indices of later groups, so padding in the last group changes
    nothing. By default there is one group.
    """
    numbers = _uniform(generators, count)
    return torch.from_numpy(np.argsort(numbers if group is None else numbers + group.numpy(), axis=-1))


def _uniform(generators: Generators, count: int) -> NDArray[Any]:
    return np.stack([generator.random(count) for generator in generators])
