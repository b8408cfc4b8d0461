"""Focal length and radial distortion fitted to points without matches, against planted cameras of pycolmap."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from planted import degrees_between, directions
from scipy.spatial.transform import Rotation

from bpnp.arrays import Array
from bpnp.cameras import camera_from
from bpnp.search.pose_model import lens_columns, lens_error_columns, log10_lenses
from bpnp.search.problem import Problem, UnknownFocal
from bpnp.search.propose import lens
from bpnp.search.propose.lens import FITTED_BEARINGS, fit_lens, lens_model
from bpnp.search.refine.gauss_newton import soft_equations
from bpnp.search.verdict.uncertainty import linearised, local_covariance

FOCAL = 1000.0


def radial_camera(focal: float, radial: float, centre: tuple[float, float] = (0.0, 0.0)) -> object:
    return camera_from(("SIMPLE_RADIAL", (focal, *centre, radial)))


def planted(radial: float, seed: int, count: int = 200, zoom: float = 1.0) -> tuple[Array, Array]:
    """Points (n, 3) in front of a camera at the origin, and the pixels (n, 2) of a camera that is not quite FOCAL."""
    rng = np.random.default_rng(seed)
    points = rng.uniform([-1.5, -1.5, 3], [1.5, 1.5, 8], (count, 3))
    return points, radial_camera(zoom * FOCAL, radial).project(points)


@pytest.mark.parametrize("radial", [-0.3, 0.0, 0.2])
def test_pose_focal_length_and_distortion_are_fitted_together(radial: float) -> None:
    points, pixels = planted(radial, seed=1, zoom=1.03)
    pixels += np.random.default_rng(2).normal(0, 0.3, pixels.shape)
    problem = Problem(directions(np.c_[pixels / FOCAL, np.ones(len(pixels))]), points)
    turn = Rotation.from_rotvec([0.002, -0.002, 0.003]).as_matrix()
    fit = fit_lens(problem, turn, turn @ problem.centre3d * 0.99, 5e-3, radial=0.0)
    assert fit is not None
    fit = fit_lens(problem, fit.rotation, fit.centre3d, 3e-4, radial=fit.radial)
    assert fit is not None
    assert fit.radial == pytest.approx(radial, abs=0.01)
    assert fit.zoom == pytest.approx(1.03, rel=2e-3)
    assert degrees_between(fit.rotation, np.eye(3)) < 0.05


def test_without_a_radial_coefficient_only_the_focal_length_is_fitted() -> None:
    points, pixels = planted(0.0, seed=3, zoom=0.95)
    problem = Problem(directions(np.c_[pixels / FOCAL, np.ones(len(pixels))]), points)
    fit = fit_lens(problem, np.eye(3), problem.centre3d, 2e-3)
    assert fit is not None
    assert fit.radial is None
    assert fit.zoom == pytest.approx(0.95, rel=1e-5)
    assert lens_model(problem, bends=False).size == 7


@pytest.mark.parametrize("count", [300, 401, 799, 801])
def test_first_steps_use_at_most_the_stated_number_of_bearings(count: int, monkeypatch: pytest.MonkeyPatch) -> None:
    used: list[int] = []

    def counted(*args: Any, chosen: Any = None, **options: Any) -> Any:
        used.extend([] if chosen is None else [len(chosen)])
        return soft_equations(*args, chosen=chosen, **options)

    monkeypatch.setattr(lens, "soft_equations", counted)
    points, pixels = planted(0.0, seed=3, count=count, zoom=0.97)
    problem = Problem(directions(np.c_[pixels / FOCAL, np.ones(count)]), points)
    fit = fit_lens(problem, np.eye(3), problem.centre3d, 2e-3)
    assert fit is not None
    assert fit.zoom == pytest.approx(0.97, rel=1e-3)
    assert len(used) == 1
    assert FITTED_BEARINGS / 2 <= used[0] <= FITTED_BEARINGS


@pytest.mark.parametrize("radial", [-0.2, 0.0, 0.3])
def test_derivatives_by_camera_parameters_are_finite_differences_of_undistorted_pixels(radial: float) -> None:
    points, pixels = planted(radial, seed=4, count=20)
    step = 1e-5

    def seen(log_zoom: float = 0.0, change: float = 0.0, errors: Array | None = None) -> Array:
        """Where points that the changed camera sees are, as the first camera undistorts them."""
        focal, (x, y, p1, p2, k2) = FOCAL * math.exp(log_zoom), np.zeros(5) if errors is None else errors
        lens = camera_from(("OPENCV", [focal, focal, FOCAL * x, FOCAL * y, radial + change, k2, p1, p2]))
        moved = lens.project(points)
        return directions(np.c_[radial_camera(FOCAL, radial).normalise(moved), np.ones(len(points))])

    columns = lens_columns(directions(points), radial)
    np.testing.assert_allclose(columns[..., 0], (seen(step) - seen(-step)) / (2 * step), atol=1e-5)
    np.testing.assert_allclose(columns[..., 1], (seen(change=step) - seen(change=-step)) / (2 * step), atol=1e-5)
    for k, axis in enumerate(np.eye(5)):
        ends = (seen(errors=sign * step * axis) for sign in (1, -1))
        column = lens_error_columns(directions(points), radial)[..., k]
        np.testing.assert_allclose(column, np.subtract(*ends) / (2 * step), atol=1e-5)


def test_the_nfa_counts_each_unknown_of_the_camera_model() -> None:
    points, pixels = planted(0.0, seed=5)
    problem = Problem(directions(np.c_[pixels / FOCAL, np.ones(len(pixels))]), points)
    known, focal, bent = (
        log10_lenses(lens, problem.image.spread, problem.image.scales)[0]
        for lens in (None, UnknownFocal(1.0), UnknownFocal(1.0, radial_sigma=math.inf, radial_range=4.0))
    )
    assert known == 0
    steps = problem.image.spread / problem.image.scales[0]
    assert focal == pytest.approx(math.log10(steps))
    assert bent - focal == pytest.approx(math.log10(4.0 * problem.image.spread**2 * steps))


def focal_sigmas(problem: Problem, lens: UnknownFocal, scale: float) -> tuple[float, float]:
    """Error of log f of a fit with distortion that starts at the truth (f = 1), and its standard deviation."""
    fit = fit_lens(problem, np.eye(3), problem.centre3d, scale, radial=0.0)
    assert fit is not None
    fitted = replace(problem, focal=lens._replace(radial_sigma=math.inf))
    linear = linearised(fitted, fit.rotation, fit.centre3d - fit.rotation @ problem.centre3d, scale)
    covariance = local_covariance(linear)
    assert covariance is not None
    return math.log(fit.zoom), math.sqrt(covariance[6, 6])


def test_the_covariance_of_the_focal_length_allows_for_correlated_residuals() -> None:
    """Errors of a map are alike for neighbouring points: smooth fields of one pixel move 400 points. As independent
    residuals of one pixel they would leave half the standard deviation of the focal length."""
    off = []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        points, pixels = planted(0.0, seed, count=400)
        waves = rng.normal(0, 1 / 150, (12, 2))
        field = np.cos(pixels @ waves.T + rng.uniform(0, 2 * math.pi, 12)) @ rng.normal(0, 12**-0.5, (12, 2))
        pixels = pixels + field + rng.normal(0, 0.3, pixels.shape)
        problem = Problem(directions(np.c_[pixels / FOCAL, np.ones(len(pixels))]), points)
        off.append(focal_sigmas(problem, UnknownFocal(2.0), 8e-4))
    ratio = np.array([abs(error) / sigma for error, sigma in off])
    assert (ratio < 3).mean() >= 0.95
    assert np.median([sigma for _, sigma in off]) < 0.01  # a bound that says something


SIGMAS = {"centre_sigma": 0.004, "tangential_sigma": 0.004, "quartic_sigma": 0.05}


@pytest.mark.parametrize("name", SIGMAS)
def test_a_lens_parameter_that_is_not_fitted_widens_the_covariance(name: str) -> None:
    """A camera that is off by one standard deviation. Residuals show that the first one is not."""
    points, pixels = planted(0.0, seed=6)
    off = {"centre_sigma": (1, 1, 0, 0, 0), "tangential_sigma": (0, 0, 1, 1, 0), "quartic_sigma": (0, 0, 0, 0, 1)}[name]
    x, y, p1, p2, k2 = SIGMAS[name] * np.array(off)
    lens = camera_from(("OPENCV", [FOCAL, FOCAL, FOCAL * x, FOCAL * y, 0.0, k2, p1, p2]))
    noise = np.random.default_rng(7).normal(0, 0.3, pixels.shape)
    right, moved = (
        Problem(directions(np.c_[(image + noise) / FOCAL, np.ones(len(points))]), points)
        for image in (pixels, lens.project(points))
    )
    prior = UnknownFocal(2.0, **{name: SIGMAS[name]})
    (alone, fixed), (_, loose) = (focal_sigmas(right, each, 3e-4) for each in (UnknownFocal(2.0), prior))
    error, sigma = focal_sigmas(moved, prior, 3e-4)
    assert loose > 1.003 * fixed
    assert abs(error) < 3 * sigma
    if name == "centre_sigma":
        assert math.sqrt(loose**2 - fixed**2) < abs(error - alone)
