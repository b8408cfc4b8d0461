"""How loose a pose is: against the spread of repeated fits, and the curvature of the likelihood by differences."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray
from planted import directions
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from scipy.stats import t as student

from bpnp import solve
from bpnp.search.evidence.uncertainty import OUTLIERS, linearised, rotation_bound, rotation_sigma, systematic_misfit
from bpnp.search.point_sets import PointSets
from bpnp.search.starts import GravityPrior, PosePrior
from bpnp.solving.matches import fit_pose

Array = NDArray[np.float64]
SHIFT = np.array([0.1, -0.2, 6.0])
NOISE = 1e-3


def noisy(rays: Array, rng: np.random.Generator, noise: float = NOISE) -> Array:
    return directions(rays + noise * rng.standard_normal(rays.shape))


def sigma_of(sets: PointSets, rotation: Array, translation: Array) -> float:
    return rotation_sigma(sets, linearised(sets, rotation, translation, NOISE))


@pytest.mark.parametrize("count", [6, 20])
def test_it_is_the_spread_of_fits_to_repeated_noise(count: int) -> None:
    rng = np.random.default_rng(count)
    points, rotation = rng.uniform(-1, 1, (count, 3)), Rotation.random(random_state=count).as_matrix()
    rays = directions(points @ rotation.T + SHIFT)
    turns = []
    for _ in range(60):
        found, _ = fit_pose(lambda r, t: directions(points @ r.T + t), noisy(rays, rng), rotation, SHIFT, scale=NOISE)
        turns.append(Rotation.from_matrix(found @ rotation.T).as_rotvec())
    spread = math.sqrt(np.linalg.eigvalsh(np.cov(np.array(turns).T))[-1])
    sigmas = [sigma_of(PointSets(noisy(rays, rng), points), rotation, SHIFT) for _ in range(20)]
    assert np.median(sigmas) == pytest.approx(spread, rel=0.35)
    assert min(sigmas) > 0.7 * spread


def log_likelihood(rays: Array, points: Array, rotation: Array, translation: Array, area: float) -> float:
    """Of the mixture that the assignment comes from, all scene points within 4 NOISE."""
    distance2 = ((rays[:, None] - directions(points @ rotation.T + translation)) ** 2).sum(-1)
    density = np.exp(-distance2 / (2 * NOISE**2)) * (distance2 < (4 * NOISE) ** 2)
    density = density.sum(1) * (1 - OUTLIERS) / (len(points) * 2 * math.pi * NOISE**2)
    return float(np.log(density + OUTLIERS / area).sum())


def test_points_as_dense_as_their_residuals_fix_less_than_their_number_says() -> None:
    """400 points with 15 others within 4 standard deviations of each: a tenth of their information is left."""
    rng = np.random.default_rng(3)
    points = 0.1 * rng.uniform(-1, 1, (400, 3))
    rays = noisy(directions(points + SHIFT), rng)
    sets = PointSets(rays, points)
    middle = np.median(points, 0)

    def loss(step: Array) -> float:
        turn = Rotation.from_rotvec(1e-2 * step[:3]).as_matrix()
        shift = SHIFT + middle - turn @ middle + 1e-2 * step[3:]
        return -log_likelihood(rays, points, turn, shift, sets.image.solid_angle)

    step, hessian = 0.2 * np.eye(6), np.empty((6, 6))
    for a in range(6):
        for b in range(6):
            corners = [loss(s * step[a] + q * step[b]) * s * q for s in (1, -1) for q in (1, -1)]
            hessian[a, b] = sum(corners) / (4 * 0.2**2)
    by_differences = 1e-2 * math.sqrt(np.linalg.eigvalsh(np.linalg.inv(hessian)[:3, :3])[-1])
    sigma = sigma_of(sets, np.eye(3), SHIFT)
    assert sigma == pytest.approx(by_differences, rel=0.2)


def test_a_bound_is_exceeded_once_in_a_thousand_by_students_law() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform(-1, 1, (8, 3))
    sets = PointSets(noisy(directions(points + SHIFT), rng), points)
    pairs = linearised(sets, np.eye(3), SHIFT, NOISE)
    sigma = rotation_sigma(sets, pairs)
    for count, free in ((4, 2), (8, 10), (500, 994)):
        bound = rotation_bound(sets, pairs, float(count))
        assert 2 * student.sf(bound / sigma, free) == pytest.approx(1e-3, rel=1e-6)
    assert rotation_bound(sets, pairs, 3.0) == math.inf


def test_a_prior_bounds_what_the_points_leave_loose() -> None:
    rng = np.random.default_rng(1)
    points = np.column_stack([1e-4 * rng.standard_normal((5, 2)), rng.uniform(-1, 1, 5)])  # nearly on one line
    rays = noisy(directions(points + [0, 0, 6.0]), rng)
    free = sigma_of(PointSets(rays, points), np.eye(3), np.array([0, 0, 6.0]))
    known = PointSets(rays, points, prior=PosePrior(np.eye(3), None, 2.0))
    assert free > math.radians(60)
    assert sigma_of(known, np.eye(3), np.array([0, 0, 6.0])) < math.radians(2.001)
    up = np.array([0.0, 1, 0])
    upright = PointSets(rays, points, prior=GravityPrior(up, up, 1.0))  # the turn about the line tilts the vertical
    assert sigma_of(upright, np.eye(3), np.array([0, 0, 6.0])) == pytest.approx(math.radians(1), rel=0.1)


def test_points_that_are_not_seen_fix_nothing() -> None:
    rng = np.random.default_rng(2)
    points = rng.uniform(-1, 1, (8, 3))
    rays = directions(points + SHIFT)
    away = directions(points + SHIFT)  # normals away from the camera
    assert sigma_of(PointSets(rays, points, away), np.eye(3), SHIFT) == math.inf
    assert sigma_of(PointSets(-rays, points), np.eye(3), SHIFT) == math.inf


CAMERA = np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]])
RNG = np.random.default_rng(11)
POINTS = RNG.uniform(-1, 1, (40, 3))
TURN, MOVED = Rotation.from_rotvec([0.2, -0.3, 0.1]), np.array([0.1, 0.05, 5.0])
RESIDUALS = 3e-4 * RNG.standard_normal((40, 3))


def fitted(image: Array) -> tuple[Rotation, Array, float]:
    """The pose of known pairs by a general solver, and the scale of its residuals."""

    def residuals(pose: Array) -> Array:
        moved = (TURN * Rotation.from_rotvec(pose[:3])).apply(POINTS) + MOVED + pose[3:]
        return (image - directions(moved)).ravel()

    end = least_squares(residuals, np.zeros(6), xtol=1e-12)
    return TURN * Rotation.from_rotvec(end.x[:3]), MOVED + end.x[3:], float(np.sqrt(2 * end.cost / (2 * 40 - 6)))


@pytest.mark.parametrize("wrong", ["focal length", "proportions", "nothing"])
def test_the_misfit_says_how_far_off_the_pose_is(wrong: str) -> None:
    scene = POINTS * (1.06**-0.5, 1.06**-0.5, 1.06) if wrong == "proportions" else POINTS
    camera = TURN.apply(scene) + MOVED
    if wrong == "focal length":
        camera = camera * (1.04, 1.04, 1)
    image = directions(camera + RESIDUALS)
    turn, shift, scale = fitted(image)
    misfit = systematic_misfit(linearised(PointSets(image, POINTS), turn.as_matrix(), shift, scale), 40.0)
    if wrong == "nothing":
        assert misfit == (0.0, 0.0)
        return
    moved = np.linalg.norm(turn.apply(np.median(POINTS, 0)) + shift - TURN.apply(np.median(POINTS, 0)) - MOVED)
    off = (TURN.inv() * turn).magnitude(), moved / np.linalg.norm(MOVED)
    if wrong == "focal length":
        assert misfit == pytest.approx(off, rel=0.3, abs=2e-3)
    else:  # another focal length is a worse explanation, by which the pose were farther off
        assert misfit.turn > 0.7 * off[0]
        assert misfit.shift > 0.7 * off[1]


@pytest.mark.parametrize("focal", [0.6, 1.5])
def test_points_seen_by_another_camera_are_not_confident(focal: float) -> None:
    camera = TURN.apply(POINTS) + MOVED
    pixels = camera[:, :2] / camera[:, 2:] * 500 * focal + (320, 240) + 0.3 * RNG.standard_normal((40, 2))
    assert solve(pixels, POINTS, CAMERA).verdict != "confident"


def test_a_focal_length_needs_no_more_points_than_its_own_fit() -> None:
    """Seven points leave 7 numbers to test a focal length with, 3 to test it beside five strains: repeated images."""
    rng = np.random.default_rng(3)
    for _ in range(20):
        points = rng.standard_normal((7, 3))
        camera = Rotation.random(rng=rng).apply(points) + (0, 0, 6)
        pixels = camera[:, :2] / camera[:, 2:] * 600 + (320, 240) + 0.5 * rng.standard_normal((7, 2))
        assert solve(pixels, points, CAMERA).verdict != "confident"
