"""Density-map searches around a rough pose, or of all rotations.

They find a planted pose among more outliers than the annealing on clusters does.
"""

import math

import numpy as np
import pytest
from planted import degrees_between, view_with_outliers
from scipy.spatial.transform import Rotation
from scipy.stats import kstest, truncnorm

from bpnp.arrays import Array
from bpnp.search.find import search_poses
from bpnp.search.problem import Problem
from bpnp.search.propose.density_map import draw_around, search_near
from bpnp.search.search_frame import SearchFrame
from bpnp.search.settings import DEFAULT
from bpnp.search.starts import PosePrior


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
    centroid = points.mean(0)
    moved = rotation @ centroid + translation + 0.04 * 5 * shift - turned @ centroid
    return PosePrior(turned, moved, 4.0, 0.2)


@pytest.mark.slow
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


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("translation_sigma", "degrees", "code"),
    [(0.3, 6.0, "contradicts_prior"), (30.0, 120.0, "confident"), (math.inf, 6.0, "contradicts_prior")],
    ids=["wrong", "uninformative", "wrong rotation alone"],
)  # fmt: skip
def test_a_prior_that_does_not_help_hides_no_pose_that_is_found_without(
    translation_sigma: float, degrees: float, code: str
) -> None:
    bearings, points, rotation, translation = cluttered(0, outliers=80)
    assert search_poses(Problem.of(bearings, points)).verdict == "confident"
    wrong = Rotation.from_rotvec([0, 2, 0]).as_matrix() @ rotation
    where = None if math.isinf(translation_sigma) else translation
    found = search_poses(Problem.of(bearings, points, prior=PosePrior(wrong, where, degrees, translation_sigma)))
    assert found.code == code
    assert degrees_between(found.best[0], rotation) < 0.3


def test_a_pose_among_six_outliers_a_match_is_found_without_a_prior() -> None:
    bearings, points, rotation, translation = view_with_outliers(np.random.default_rng(0), 150, 900)
    problem = Problem.of(bearings, points)
    found = search_poses(problem)
    assert found.verdict == "confident"
    best = problem.to_user(*found.best)
    np.testing.assert_allclose(best[0], rotation, atol=5e-3)
    np.testing.assert_allclose(best[1], translation, atol=0.05)


def telephoto(rng: np.random.Generator) -> tuple[Problem, Array]:
    """A facade in a view of 5 degrees, with a prior from another photo of it, and its true rotation."""
    size, true, outliers = 5.0, 80, 320
    half = np.array([0.04, 0.03])
    plane = rng.uniform(-half, half, (true + 2 * outliers, 2))
    depth = size * rng.uniform(0.98, 1.02, (len(plane), 1))
    seen = np.column_stack([plane, np.ones(len(plane))])
    rotation, translation = Rotation.random(rng=rng).as_matrix(), np.array([0.0, 0.0, size])
    points = (seen * depth - translation) @ rotation
    noise = 1e-4 * rng.standard_normal(plane.shape)
    bearings = seen + np.column_stack([noise, np.zeros(len(plane))])
    bearings /= np.linalg.norm(bearings, axis=-1, keepdims=True)
    image, scene = np.r_[:true, true : true + outliers], np.r_[:true, true + outliers : len(points)]
    off = Rotation.from_rotvec(np.radians(4) * rng.standard_normal(3)).as_matrix() @ rotation
    shift = translation + size * np.array([0.01, 0.01, 0.1]) * rng.standard_normal(3)
    prior = PosePrior(off, shift, 15.0, 0.2 * size)
    return Problem.of(rng.permutation(bearings[image]), rng.permutation(points[scene]), prior=prior), rotation


@pytest.mark.slow
def test_one_search_near_a_prior_finds_a_telephoto_view() -> None:
    """The prior is as wide as for an ordinary lens, many times the view: from most of its poses no point is in view."""
    for seed in range(10):
        problem, rotation = telephoto(np.random.default_rng(seed))
        scene = SearchFrame(problem, seed, DEFAULT)
        found = search_near(scene, scene.enter_prior(problem.prior))
        ends, _ = scene.leave(found.rotation, found.translation)
        assert min(degrees_between(end, rotation) for end in ends) < 0.5, seed


@pytest.mark.parametrize("reach", [2.0, math.inf])
def test_poses_drawn_from_a_prior_are_normal_and_cut_to_the_view(reach: float) -> None:
    """The position of the centroid across the view is distributed like `scipy.stats.truncnorm`."""
    problem, _ = telephoto(np.random.default_rng(3))
    scene = SearchFrame(problem, 0, DEFAULT)
    prior = scene.enter_prior(problem.prior)
    assert isinstance(prior, PosePrior)
    drawn = draw_around(scene, prior, 4000, reach)
    centroid, sigma = scene.bulk3d.mean(0), prior.translation_sigma
    centroids = (drawn.rotation @ centroid + drawn.translation)[1:]
    mean = np.asarray(prior.rotation) @ centroid + np.asarray(prior.translation)
    for k, bound in enumerate((reach, reach, math.inf)):
        expected = truncnorm((-bound - mean[k]) / sigma, (bound - mean[k]) / sigma, loc=mean[k], scale=sigma)
        assert kstest(centroids[:, k], expected.cdf).pvalue > 1e-3
