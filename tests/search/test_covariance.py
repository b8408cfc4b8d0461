"""The covariance of fitted numbers: against the spread of repeated fits, and laws of normal measurements."""

import numpy as np
import pytest

from bpnp.arrays import Array
from bpnp.search.verdict.covariance import covariance_of, join, of_sure_matches


def rows(seed: int, count: int = 60, size: int = 3) -> Array:
    return np.random.default_rng(seed).normal(size=(count, 2, size))


def inverse_of(jacobian: Array) -> Array:
    flat = jacobian.reshape(-1, jacobian.shape[-1])
    return np.linalg.inv(flat.T @ flat)


@pytest.mark.parametrize("size", [3, 4, 7])
def test_the_covariance_is_the_spread_of_repeated_fits(size: int) -> None:
    jacobian, rng = rows(0, size=size), np.random.default_rng(1)
    flat = jacobian.reshape(-1, size)
    steps, covariances = [], []
    for _ in range(300):
        noise = rng.standard_normal(len(flat))
        step = np.linalg.lstsq(flat, noise, rcond=None)[0]
        left = (noise - flat @ step).reshape(-1, 2)
        covariance = covariance_of(of_sure_matches(left, jacobian), fitted=size)
        assert covariance is not None
        steps.append(step)
        covariances.append(covariance)
    squared = [step @ np.linalg.solve(c, step) for step, c in zip(steps, covariances, strict=True)]
    assert 0.7 * size < np.mean(squared) < 1.1 * size  # never too small; larger where the jackknife counts


def test_independent_cameras_add_their_information() -> None:
    """Without residuals the jackknife is zero, and what counts is the inverse of the information."""
    parts = [of_sure_matches(np.zeros((60, 2)), rows(seed)) for seed in (0, 1)]
    together = covariance_of(join(parts), fitted=3)
    np.testing.assert_allclose(together, inverse_of(np.concatenate([rows(0), rows(1)])), rtol=1e-9)
    prior = [part._replace(known=50 * np.eye(3)) for part in parts]
    sharper = np.linalg.inv(np.linalg.inv(inverse_of(np.concatenate([rows(0), rows(1)]))) + 100 * np.eye(3))
    np.testing.assert_allclose(covariance_of(join(prior), fitted=3), sharper, rtol=1e-9)


def test_an_image_point_that_stands_for_several_counts_as_often() -> None:
    part = of_sure_matches(np.zeros((60, 2)), rows(0))
    twice = part._replace(weight=np.full(60, 2.0))
    np.testing.assert_allclose(covariance_of(twice, fitted=3), inverse_of(rows(0)) / 2, rtol=1e-9)


def test_a_parameter_that_no_residual_shows_adds_all_that_it_moves() -> None:
    """It moves the image points as a step of the fitted numbers does."""
    jacobian, moved = rows(0), np.array([0.3, -0.1, 0.2])
    matches = of_sure_matches(np.zeros((60, 2)), jacobian)
    found = covariance_of(matches, fitted=3, considered=jacobian @ moved[:, None])
    np.testing.assert_allclose(found, inverse_of(jacobian) + np.outer(moved, moved), rtol=1e-9)


def test_a_parameter_that_is_not_fitted_adds_as_much_as_if_it_were() -> None:
    """Without residuals the covariance is that of a fit of all numbers."""
    jacobian, offset = rows(0), np.tile([[[0.3], [0.0]]], (60, 1, 1))
    matches = of_sure_matches(np.zeros((60, 2)), jacobian)
    found = covariance_of(matches, fitted=3, considered=offset)
    both = np.concatenate([jacobian, offset], -1).reshape(-1, 4)
    expected = np.linalg.inv(both.T @ both + np.diag([0.0, 0, 0, 1]))[:3, :3]
    np.testing.assert_allclose(found, expected, rtol=1e-9)


def test_the_covariance_allows_for_the_parameters_that_are_not_fitted() -> None:
    """Fits without two parameters of the measurements, which are drawn anew each time."""
    jacobian, considered, rng = rows(0), 0.3 * rows(1, size=2), np.random.default_rng(2)
    flat, squared, alone = jacobian.reshape(-1, 3), [], []
    for _ in range(300):
        offset = (considered @ rng.standard_normal((2, 1)))[..., 0]
        measured = rng.standard_normal((60, 2)) + offset
        step = np.linalg.lstsq(flat, measured.ravel(), rcond=None)[0]
        matches = of_sure_matches(measured - jacobian @ step, jacobian)
        for found, known in ((squared, considered), (alone, None)):
            covariance = covariance_of(matches, fitted=3, considered=known)
            assert covariance is not None
            found.append(step @ np.linalg.solve(covariance, step))
    assert 0.6 * 3 < np.mean(squared) < 1.1 * 3 < np.mean(alone)


def test_parameters_that_the_matches_do_not_fix_have_no_covariance() -> None:
    jacobian = rows(0) * [1.0, 1.0, 0.0]
    assert covariance_of(of_sure_matches(np.zeros((60, 2)), jacobian), fitted=3) is None


def test_one_wrong_match_widens_the_covariance() -> None:
    """A residual of 30 standard deviations at one image point moves the estimate by far more than the noise does."""
    residual = np.zeros((60, 2))
    residual[0] = 30
    jacobian = rows(0)
    found = covariance_of(of_sure_matches(residual, jacobian), fitted=3)
    with_it = np.linalg.lstsq(jacobian.reshape(-1, 3), residual.ravel(), rcond=None)[0]
    assert found is not None
    assert with_it @ np.linalg.solve(found, with_it) < 1.5 < with_it @ np.linalg.solve(inverse_of(jacobian), with_it)


@pytest.mark.parametrize("residual", [1.2, 2.0, 3.0])
def test_an_image_point_between_two_scene_points_swings_no_covariance(residual: float) -> None:
    """It has the probability 1/2 to match either, and reduces the information of 20 other matches to nearly nothing."""
    rng = np.random.default_rng(0)
    sure = of_sure_matches(rng.normal(size=(20, 1)), rng.normal(size=(20, 1, 2)))
    expected = covariance_of(sure, fitted=2)
    assert expected is not None
    between = np.array([[residual], [-residual]])
    both = sure._replace(
        residual=np.concatenate([sure.residual, between]),
        jacobian=np.concatenate([sure.jacobian, np.array([[[2.0, 1.0]]] * 2)]),
        probability=np.r_[sure.probability, 0.5, 0.5],
        point=np.r_[sure.point, 20, 20],
        weight=np.ones(21),
    )
    found = covariance_of(both, fitted=2)
    assert found is not None
    assert np.trace(found) <= np.trace(expected) * (1 + 1e-9)
