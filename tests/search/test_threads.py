"""The number of threads changes no solution."""

import math
from collections.abc import Iterator

import numpy as np
import pytest
import torch

import bpnp
from bpnp.examples import load

pytestmark = pytest.mark.slow


@pytest.fixture
def two_threads() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(before)


def alike(one: bpnp.Solution, other: bpnp.Solution) -> bool:
    same = np.array_equal(one.rotation, other.rotation) and np.array_equal(one.translation, other.translation)
    return same and np.array_equal(one.matches, other.matches) and one.reason == other.reason


def test_solve_many_equals_single_calls_for_any_number_of_threads(two_threads: None) -> None:
    examples = [load("photo", seed=seed) for seed in range(6)]
    sets = [e.points2d for e in examples], [e.points3d for e in examples], [e.camera for e in examples]
    shared = bpnp.solve_many(*sets, time_limit=math.inf)
    torch.set_num_threads(1)
    single = [bpnp.solve(*pair, time_limit=math.inf) for pair in zip(*sets, strict=True)]
    assert all(map(alike, shared, single))
    for example, solution in zip(examples, shared, strict=True):
        assert example.rotation_error_deg(solution.rotation) < 0.5
