"""Draws against the laws they must follow: uniform triples, growing pools, frequencies in proportion to a weight."""

import itertools

import torch
from scipy.stats import chisquare, kstest
from torch import Tensor

from bpnp.robust.consensus import distinct_triples, growing_pool, hashed_uniform, take, weighted_draws

CPU = torch.device("cpu")


def counts(indices: Tensor, size: int) -> Tensor:
    return torch.bincount(indices.flatten(), minlength=size)


def test_hashed_numbers_are_uniform_and_independent_from_one_to_the_next() -> None:
    for seed in (0, 1, 2**31):
        numbers = hashed_uniform(200_000, seed, CPU)
        assert ((numbers > 0) & (numbers < 1)).all()
        assert kstest(numbers.numpy(), "uniform").pvalue > 1e-3
        pairs = (numbers[:-1] * 8).long() * 8 + (numbers[1:] * 8).long()
        assert chisquare(counts(pairs[::2], 64).numpy()).pvalue > 1e-3


def test_hashed_numbers_continue_after_those_skipped_and_differ_between_seeds() -> None:
    whole = hashed_uniform(100, 5, CPU)
    assert torch.equal(hashed_uniform(60, 5, CPU, skip=40), whole[40:])
    assert not torch.equal(hashed_uniform(100, 6, CPU), whole)


def test_triples_are_uniform_over_all_ordered_triples() -> None:
    triples = distinct_triples(torch.full((1, 120_000), 5.0).double(), 3)[0]
    places = {triple: i for i, triple in enumerate(itertools.permutations(range(5), 3))}
    drawn = torch.tensor([places[tuple(triple)] for triple in triples.tolist()])  # KeyError if two are the same
    assert chisquare(counts(drawn, 60).numpy()).pvalue > 1e-3


def test_later_triples_of_a_seed_are_new_ones() -> None:
    pool = torch.full((1, 1000), 50.0).double()
    first, second = distinct_triples(pool, 0), distinct_triples(pool, 0, skip=1000)
    assert (first == second).all(-1).double().mean() < 0.01


def test_the_pool_grows_from_the_heaviest_pairs_to_all_and_bounds_the_triples() -> None:
    pool = growing_pool(torch.tensor([1000, 10, 2]), 500)
    assert (pool.diff(dim=-1) >= 0).all()
    assert pool[:, 0].tolist() == [17, 10, 3]
    assert pool[:, -1].tolist() == [996, 10, 3]
    triples = distinct_triples(pool, 1)
    assert (triples < pool.unsqueeze(-1)).all()
    assert (triples >= 0).all()


def test_weighted_draws_follow_the_weights_and_never_take_what_weighs_nothing() -> None:
    weights = torch.tensor([[0.0, 1.0, 5.0, 0.0, 4.0, 0.0], [1.0, 1.0, 0.0, 0.0, 0.0, 0.0]])
    drawn = weighted_draws(weights, 50_000, 2)
    for row, weight in zip(drawn, weights, strict=True):
        assert set(row.unique().tolist()) == set(weight.nonzero().flatten().tolist())
        expected = 50_000 * weight[weight > 0] / weight.sum()
        assert chisquare(counts(row, 6)[weight > 0].numpy(), expected.double().numpy()).pvalue > 1e-3


def test_draws_do_not_depend_on_the_neighbours_nor_on_padding() -> None:
    weights = torch.rand(3, 40)
    padded = torch.nn.functional.pad(weights, (0, 9))
    expected = weighted_draws(weights, 100, 0)
    assert torch.equal(weighted_draws(padded, 100, 0), expected)
    assert torch.equal(weighted_draws(weights[1:2], 100, 0), expected[1:2])


def test_take_picks_rows_of_each_sample() -> None:
    values, index = torch.rand(2, 5, 3, 4), torch.tensor([[4, 4, 0], [1, 2, 3]])
    assert torch.equal(take(values, index), torch.stack([values[b, index[b]] for b in range(2)]))
