"""One-to-one matches and mutual neighbours, against brute force and the dense assignment of scipy."""

import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment
from scipy.spatial.distance import cdist

from bpnp.matching import count_one_to_one, mutual_nearest, one_to_one


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


@pytest.mark.parametrize("count", [1, 40, 300])  # all distances, and those of a tree
def test_mutual_neighbours_are_the_nearest_of_each_other(count: int) -> None:
    rng = np.random.default_rng(count)
    image, projected = rng.uniform(0, 10, (count, 2)), rng.uniform(0, 10, (count + 5, 2))
    projected[::7] = np.nan  # behind the camera
    distance = np.nan_to_num(cdist(image, projected), nan=np.inf)
    expected = [
        (i, j) for i, j in enumerate(distance.argmin(1)) if distance[i, j] <= 0.4 and distance[:, j].argmin() == i
    ]
    assert sorted(map(tuple, mutual_nearest(image, projected, 0.4).tolist())) == expected


def test_no_points_have_no_matches() -> None:
    assert mutual_nearest(np.empty((0, 2)), np.zeros((3, 2)), 1.0).shape == (0, 2)
    assert one_to_one(np.zeros((3, 2)), np.full((2, 2), np.nan), 1.0).shape == (0, 2)
