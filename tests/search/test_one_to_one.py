"""One-to-one matches against brute force and scipy's dense assignment; fits against planted poses."""

import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment
from scipy.spatial.distance import cdist

from bpnp.search.matching import count_one_to_one, one_to_one


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
