"""Keyed random numbers: the published generator, its laws, and independence of batch and padding."""

import numpy as np
import torch
from scipy.stats import kstest

from bpnp.datamodules.keyed_random import (
    normal,
    permutations,
    random_bits,
    rotations,
    row_keys,
    uniform,
)


def test_splitmix64_is_the_published_generator() -> None:
    """The first outputs of SplitMix64 from state 1234567, as its reference implementations print them."""
    published = (6457827717110365317, 3203168211198807973, 9817491932198370423, 4593380528125082431)
    found = random_bits(torch.tensor([1234567]), 4)[0].tolist()
    assert [value % 2**64 for value in found] == list(published)


def test_the_numbers_are_uniform_normal_and_of_their_key_alone() -> None:
    keys = row_keys(torch.arange(200), 1, 2)
    assert kstest(uniform(keys, 50).flatten().numpy(), "uniform").pvalue > 0.01
    assert kstest(normal(keys, 51).flatten().numpy(), "norm").pvalue > 0.01
    for numbers in (uniform(keys, 50), normal(keys, 50)):
        assert abs(np.corrcoef(numbers.T.numpy())[np.triu_indices(50, 1)]).max() < 0.35
    assert torch.equal(uniform(keys[7:9], 50), uniform(keys, 60)[7:9, :50])
    assert torch.equal(normal(keys[7:9], 11), normal(keys, 60)[7:9, :11])
    assert rotations(keys).mean(0).abs().max() < 4 * (1 / 3 / 200) ** 0.5  # entries of variance 1/3 and mean 0


def test_permutations_are_fair_and_keep_their_groups_apart() -> None:
    keys = row_keys(torch.arange(12000), 5)
    order = permutations(keys, 6)
    assert torch.equal(order.sort(-1).values, torch.arange(6).expand(12000, -1))
    code = (order * 6 ** torch.arange(6)).sum(-1).unique(return_counts=True)[1].double()
    assert len(code) == 720  # of 6 places, every order
    assert float(((code - 12000 / 720) ** 2 / (12000 / 720)).sum()) < 840  # chi-square, 719 degrees of freedom: 0.1 %
    group = torch.tensor([[2, 0, 1, 0, 3, 1]]).expand(12000, -1)
    grouped = permutations(keys, 6, group)
    assert torch.equal(group.gather(1, grouped), group.sort(-1).values)
    padded = permutations(keys, 9, torch.nn.functional.pad(group, (0, 3), value=3))
    assert torch.equal(padded[:, :5], grouped[:, :5])
