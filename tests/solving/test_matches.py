"""One-to-one matches against brute force and scipy's dense assignment; fits against planted poses."""

import itertools

import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation

from bpnp.solving.matches import count_one_to_one, fit_pose, mutual_nearest, one_to_one


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


def test_points_that_are_nowhere_match_nothing() -> None:
    image = np.array([[0.0, 0.0], [1.0, 1.0]])
    projected = np.array([[np.nan, np.nan], [1.0, 1.0]])
    assert one_to_one(image, projected, 0.5).tolist() == [[1, 1]]
    assert mutual_nearest(image, projected, 0.5).tolist() == [[1, 1]]
    for function in (one_to_one, mutual_nearest):
        assert function(image, projected[:1], 0.5).shape == (0, 2)
        assert function(image, projected + 9, 0.5).shape == (0, 2)
    assert count_one_to_one(image, projected[:1], 0.5) == 0


def test_mutual_nearest_is_what_it_says() -> None:
    rng = np.random.default_rng(1)
    image, projected = rng.uniform(size=(60, 2)), rng.uniform(size=(80, 2))
    distance = cdist(image, projected)
    expected = {
        (i, j) for i, j in enumerate(distance.argmin(1)) if distance[:, j].argmin() == i and distance[i, j] <= 0.05
    }
    assert {tuple(pair) for pair in mutual_nearest(image, projected, 0.05).tolist()} == expected


def test_a_fit_finds_the_planted_pose() -> None:
    rng = np.random.default_rng(0)
    points = rng.normal(size=(40, 3))
    rotation, translation = Rotation.random(rng=rng).as_matrix(), np.array([0.3, -0.2, 6.0])

    def project(r: np.ndarray, t: np.ndarray) -> np.ndarray:
        camera = points @ r.T + t
        return camera[:, :2] / camera[:, 2:]

    start = Rotation.from_rotvec([0.05, -0.04, 0.03]).as_matrix() @ rotation
    found = fit_pose(project, project(rotation, translation), start, translation + 0.2, scale=0.01)
    np.testing.assert_allclose(found[0], rotation, atol=1e-8)
    np.testing.assert_allclose(found[1], translation, atol=1e-7)
