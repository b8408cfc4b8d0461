"""Uncertainty of a pose, against repeated fits and finite differences of the likelihood."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray
from planted import directions
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from scipy.stats import chi2, norm, t

from bpnp import solve
from bpnp.arrays import Array
from bpnp.search.problem import Problem
from bpnp.search.starts import GravityPrior, PosePrior
from bpnp.search.verdict import uncertainty
from bpnp.search.verdict.uncertainty import error_bounds, linearised, local_covariance, pose_covariance

SHIFT = np.array([0.1, -0.2, 6.0])
NOISE = 1e-3


def noisy(rays: Array, rng: np.random.Generator, noise: float = NOISE) -> Array:
    return directions(rays + noise * rng.standard_normal(rays.shape))


def sigma_of(problem: Problem, rotation: Array, translation: Array) -> float:
    """Standard deviation about the least certain axis, radians."""
    covariance = local_covariance(linearised(problem, rotation, translation, NOISE))
    return math.inf if covariance is None else math.sqrt(np.linalg.eigvalsh(covariance[:3, :3])[-1])


def test_the_bound_of_a_scale_factor_can_be_infinite() -> None:
    """With 80 degrees of freedom, Student's t is beyond 3.416 standard deviations once in a thousand."""
    bounds = [uncertainty.share_bound(np.array([[variance]]), 80.0) for variance in (1e-4, 1e9)]
    assert bounds == pytest.approx([math.expm1(0.03416), math.inf], rel=1e-3)


def test_bounds_are_exceeded_once_in_a_thousand() -> None:
    """The errors are normal with the covariance, over a scale with the given degrees of freedom."""
    rng = np.random.default_rng(0)
    points = rng.uniform(-1, 1, (8, 3))
    problem = Problem(noisy(directions(points + SHIFT), rng), points)
    linear = linearised(problem, np.eye(3), SHIFT, NOISE)
    covariance = local_covariance(linear)
    assert covariance is not None
    for count, free in ((5, 4), (8, 10), (500, 994)):
        errors = rng.multivariate_normal(np.zeros(6), covariance, 300_000)
        errors /= np.sqrt(chi2.rvs(free, size=(300_000, 1), random_state=rng) / free)
        exceeded = np.mean(np.linalg.norm(errors[:, :3], axis=1) > error_bounds(problem, linear, float(count))[0])
        assert 0.75e-3 < exceeded < 1.25e-3
    assert error_bounds(problem, linear, 3.0)[0] == math.inf


def test_errors_exceed_the_bound_of_a_covariance_once_in_a_thousand() -> None:
    """Drawn as before, of a covariance that was widened by Student's t."""
    rng = np.random.default_rng(1)
    root = rng.standard_normal((4, 4)) * [1e-2, 1e-2, 1e-2, 0.3]
    for free in (5, 13, 400):
        shrunk = np.sqrt(chi2.rvs(free, size=(100_000, 1), random_state=rng) / free)
        errors = rng.standard_normal((100_000, 4)) @ root.T / shrunk
        widened = float(t.ppf(norm.cdf(1), free)) ** 2 * root @ root.T
        beyond = np.linalg.norm(errors @ np.linalg.inv(root).T, axis=1)
        some = np.argsort(beyond)[-200:]
        claimed = [uncertainty.is_within(error, widened, free) for error in errors[some]]
        assert 70 <= len(some) - sum(claimed) <= 130
    assert not uncertainty.is_within(np.zeros(4), np.full((4, 4), math.nan), 10)


def test_the_bound_allows_for_one_wrong_match_among_few() -> None:
    """One of eight points is seen 2.5 standard deviations off: least squares without it ends elsewhere."""
    rng = np.random.default_rng(3)
    points = rng.uniform(-1, 1, (8, 3))
    rays = noisy(directions(points + SHIFT), rng, 0.3 * NOISE)
    rays[2] = directions(rays[2] + [2.5 * NOISE, 0, 0])
    problem = Problem(rays, points, labels2d=np.arange(8), labels3d=np.arange(8))

    def fitted(kept: NDArray[np.int64]) -> Array:
        def residuals(step: Array) -> Array:
            seen = points[kept] @ Rotation.from_rotvec(step[:3]).as_matrix().T + SHIFT + step[3:]
            return ((directions(seen) - rays[kept]) / NOISE).ravel()

        return np.asarray(least_squares(residuals, np.zeros(6), xtol=1e-12).x)

    every = fitted(np.arange(8))
    rotation, translation = Rotation.from_rotvec(every[:3]).as_matrix(), SHIFT + every[3:]
    covariance = pose_covariance(problem, linearised(problem, rotation, translation, NOISE), 1e9)
    way = fitted(np.delete(np.arange(8), 2)) - every
    assert covariance is not None
    assert 0.5 < way @ np.linalg.solve(covariance, way) < 1.05


def test_a_prior_bounds_what_the_points_do_not_fix() -> None:
    rng = np.random.default_rng(1)
    points = np.column_stack([1e-4 * rng.standard_normal((5, 2)), rng.uniform(-1, 1, 5)])  # nearly on one line
    rays = noisy(directions(points + [0, 0, 6.0]), rng)
    free = sigma_of(Problem(rays, points), np.eye(3), np.array([0, 0, 6.0]))
    unseen = Problem(rays, points, directions(points + [0, 0, 6.0]))  # with normals away from the camera
    assert sigma_of(unseen, np.eye(3), np.array([0, 0, 6.0])) == math.inf
    known = Problem(rays, points, prior=PosePrior(np.eye(3), None, 2.0))
    assert free > math.radians(60)
    assert sigma_of(known, np.eye(3), np.array([0, 0, 6.0])) < math.radians(2.001)
    fixed = Problem(rays, points, prior=PosePrior(np.eye(3), np.array([0, 0, 6.0]), 2.0, 1e-5))
    covariance = pose_covariance(fixed, linearised(fixed, np.eye(3), np.array([0, 0, 6.0]), NOISE), 1e6)
    assert covariance is not None
    np.testing.assert_allclose(np.sqrt(np.diag(covariance[3:, 3:])), 1e-5, rtol=0.01)
    up = np.array([0.0, 1, 0])
    upright = Problem(rays, points, prior=GravityPrior(up, up, 1.0))  # the turn about the line tilts the vertical
    assert sigma_of(upright, np.eye(3), np.array([0, 0, 6.0])) == pytest.approx(math.radians(1), rel=0.1)


CAMERA = np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]])


@pytest.mark.slow
def test_a_focal_length_needs_no_more_points_than_its_own_fit() -> None:
    """Seven points leave 7 numbers to test a focal length, and 3 to test it together with five strains."""
    rng, believed = np.random.default_rng(3), []
    for _ in range(20):
        points, turn = rng.standard_normal((7, 3)), Rotation.random(rng=rng)
        camera = turn.apply(points) + (0, 0, 6)
        pixels = camera[:, :2] / camera[:, 2:] * 600 + (320, 240) + 0.5 * rng.standard_normal((7, 2))
        solution = solve(pixels, points, CAMERA)
        if solution.verdict == "confident":
            believed.append(np.degrees((Rotation.from_matrix(solution.rotation) * turn.inv()).magnitude()))
    assert len(believed) <= 1  # the test is one at a thousandth: seven points cannot tell more
    assert all(error < 3 for error in believed)


def test_points_that_are_given_twice_do_not_make_a_pose_more_certain() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform(-1, 1, (20, 3))
    rays = noisy(directions(points + SHIFT), rng)
    once = local_covariance(linearised(Problem(rays, points), np.eye(3), SHIFT, NOISE))
    for repeated in (Problem(np.repeat(rays, 4, 0), points), Problem(np.repeat(rays, 4, 0), np.repeat(points, 4, 0))):
        several = local_covariance(linearised(repeated, np.eye(3), SHIFT, NOISE))
        assert once is not None
        assert several is not None
        np.testing.assert_allclose(several, once, rtol=0.01, atol=1e-9)
