"""Density-map searches around a rough pose, or of all rotations.

They find a planted pose among more outliers than the annealing on clusters does.
"""

import math

import numpy as np
import pytest
from numpy.typing import NDArray
from planted import degrees_between, view_with_outliers
from scipy.spatial.transform import Rotation

from bpnp.search.problem import Problem
from bpnp.search.search import search_poses
from bpnp.search.starts import PosePrior

Array = NDArray[np.float64]


def cluttered(seed: int, true: int = 80, outliers: int = 220, **view: float) -> tuple[Array, Array, Array, Array]:
    """Bearings and points in random order and their pose, with outliers that fill the frame of both."""
    rng = np.random.default_rng(seed)
    bearings, points, rotation, translation = view_with_outliers(rng, true, outliers, **view)
    image, scene = rng.permutation(len(bearings)), rng.permutation(len(points))
    return bearings[image], points[scene], rotation, translation


def off(rotation: Array, translation: Array, points: Array, rng: np.random.Generator) -> PosePrior:
    """A prior 4 degrees off, and 4 % of the distance, of that size."""
    axis, shift = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
    turned = Rotation.from_rotvec(np.radians(4) * axis).as_matrix() @ rotation
    middle = points.mean(0)
    moved = rotation @ middle + translation + 0.04 * 5 * shift - turned @ middle
    return PosePrior(turned, moved, 4.0, 0.2)


@pytest.mark.parametrize("seed", range(2))
def test_a_rough_prior_is_certain_among_seven_outliers_a_true_pair(seed: int) -> None:
    """Likelier poses that chance explains come up in every batch annealed around the prior."""
    bearings, points, rotation, translation = cluttered(seed, outliers=600)
    found = search_poses(
        Problem.of(bearings, points, prior=off(rotation, translation, points, np.random.default_rng(seed)))
    )
    assert found.verdict == "confident"
    assert degrees_between(found.best[0], rotation) < 0.3


def test_noise_beyond_the_radius_of_an_enumeration_is_confident_near_a_prior() -> None:
    """A rotation known to 4 degrees lets 200 x 200 points be enumerated, with a radius narrower than this noise."""
    bearings, points, rotation, translation = cluttered(1, true=200, outliers=0, noise=0.01, frame=0.9)
    prior = off(rotation, translation, points, np.random.default_rng(1))
    found = search_poses(Problem.of(bearings, points, prior=prior))
    assert found.verdict == "confident"
    assert degrees_between(found.best[0], rotation) < 0.5


@pytest.mark.parametrize(
    ("translation_sigma", "degrees"), [(0.3, 6.0), (30.0, 120.0), (math.inf, 6.0)],
    ids=["wrong", "uninformative", "wrong rotation alone"],
)  # fmt: skip
def test_a_prior_that_does_not_help_hides_no_pose_that_is_found_without(
    translation_sigma: float, degrees: float
) -> None:
    bearings, points, rotation, translation = cluttered(0, outliers=80)
    assert search_poses(Problem.of(bearings, points)).verdict == "confident"
    wrong = Rotation.from_rotvec([0, 2, 0]).as_matrix() @ rotation
    where = None if math.isinf(translation_sigma) else translation
    found = search_poses(Problem.of(bearings, points, prior=PosePrior(wrong, where, degrees, translation_sigma)))
    assert found.verdict == "confident"
    assert degrees_between(found.best[0], rotation) < 0.3


def test_a_pose_among_six_outliers_a_match_is_found_without_a_prior() -> None:
    bearings, points, rotation, translation = view_with_outliers(np.random.default_rng(0), 150, 900)
    problem = Problem.of(bearings, points)
    found = search_poses(problem)
    assert found.verdict == "confident"
    best = problem.to_user(*found.best)
    np.testing.assert_allclose(best[0], rotation, atol=5e-3)
    np.testing.assert_allclose(best[1], translation, atol=0.05)
