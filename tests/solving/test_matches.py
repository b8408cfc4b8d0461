"""One-to-one matches against brute force and scipy's dense assignment; fits against planted poses."""

import itertools

import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment
from scipy.spatial.distance import cdist

from bpnp.solving.matches import count_one_to_one, one_to_one


def best_by_hand(image: np.ndarray, projected: np.ndarray, radius: float) -> tuple[int, float]:
    """Most pairs, and of these the least squared distances, among all one-to-one maps."""
    squared = cdist(image, projected) ** 2
    best = (0, 0.0)
    for order in itertools.permutations(range(len(projected)), len(image)):
        near = [squared[i, j] for i, j in enumerate(order) if squared[i, j] <= radius**2]
        best = max(best, (len(near), -sum(near)))
    return best[0], -best[1]


@pytest.mark.parametrize("seed", range(20))
def test_matches_are_the_best_there_are(seed: int) -> None:
    rng = np.random.default_rng(seed)
    image, projected = rng.uniform(size=(4, 2)), rng.uniform(size=(6, 2))
    pairs = one_to_one(image, projected, 0.35)
    count, cost = best_by_hand(image, projected, 0.35)
    assert len(pairs) == count == count_one_to_one(image, projected, 0.35)
    assert ((image[pairs[:, 0]] - projected[pairs[:, 1]]) ** 2).sum() == pytest.approx(cost, abs=1e-9)
    assert len(set(pairs[:, 0])) == len(set(pairs[:, 1])) == len(pairs)


def test_many_points_are_matched_as_by_the_dense_assignment() -> None:
    rng = np.random.default_rng(0)
    projected = rng.uniform(0, 100, (400, 2))
    image = projected[rng.permutation(400)[:300]] + rng.normal(0, 0.3, (300, 2))
    squared = cdist(image, projected) ** 2
    rows, columns = linear_sum_assignment(np.where(squared <= 1, squared, 1000.0))
    near = squared[rows, columns] <= 1
    pairs = one_to_one(image, projected, 1.0)
    assert len(pairs) == near.sum() == count_one_to_one(image, projected, 1.0)
    own = ((image[pairs[:, 0]] - projected[pairs[:, 1]]) ** 2).sum()
    assert own == pytest.approx(squared[rows, columns][near].sum(), rel=1e-6)


def test_a_dense_cluster_does_not_lose_its_matches() -> None:
    """Hundreds of points within the radius of each other: more neighbours than are looked at."""
    rng = np.random.default_rng(0)
    image, projected = rng.normal(size=(200, 2)), rng.normal(size=(150, 2))
    assert len(one_to_one(image, projected, 50.0)) == 150
