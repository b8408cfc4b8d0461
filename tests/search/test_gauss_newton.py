"""The refiner against planted poses, scipy's least squares, and laws of its damping and schedule."""

import math

import numpy as np
import pytest
from planted import degrees_between, directions
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from bpnp.arrays import Array
from bpnp.cameras import camera_from
from bpnp.search.pose_model import PoseModel, PoseState
from bpnp.search.problem import Problem, UnknownFocal
from bpnp.search.refine.gauss_newton import (
    Iteration,
    image_equations,
    match_equations,
    refine,
    soft_equations,
    steps,
)

RNG = np.random.default_rng(0)
POINTS = RNG.uniform(-1, 1, (40, 3))
ROTATION, TRANSLATION = Rotation.from_rotvec([0.4, -0.3, 0.2]).as_matrix(), np.array([0.1, -0.2, 5.0])
MODEL = PoseModel(POINTS.mean(0))


def near(scale: float, seed: int = 1) -> tuple[Array, Array]:
    """A pose near the planted one."""
    rng = np.random.default_rng(seed)
    return Rotation.from_rotvec(scale * rng.standard_normal(3)).as_matrix() @ ROTATION, TRANSLATION * (1 + scale / 4)


def settled(last: Iteration) -> bool:
    return bool(np.abs(last.step).max() < 1e-10)


def test_a_pose_and_a_pose_with_its_lens_are_found_again() -> None:
    lens = UnknownFocal(2.0, radial_sigma=math.inf)
    for model, zoom, radial in (
        (MODEL, 1.0, 0.0),
        (PoseModel(POINTS.mean(0), UnknownFocal(2.0)), 1.2, 0.0),
        (PoseModel(POINTS.mean(0), lens), 1.2, -0.2),
    ):
        true = model.state(ROTATION, TRANSLATION)._replace(zoom=zoom, radial=radial)
        linearise = match_equations(model, model.directions(true, POINTS), POINTS)
        end = refine(model, model.state(*near(0.1)), linearise, [1.0] * 40, settled=settled)
        assert end.converged
        assert not end.lost
        for found, planted in zip(end.state, true, strict=True):
            np.testing.assert_allclose(found, planted, atol=1e-8)


def test_weighted_matches_have_the_optimum_of_scipy() -> None:
    rng = np.random.default_rng(2)
    bearings = directions(directions(POINTS @ ROTATION.T + TRANSLATION) + 0.02 * rng.standard_normal(POINTS.shape))
    weight = rng.uniform(0, 1, len(POINTS))

    def residuals(step: Array) -> Array:
        turn = Rotation.from_rotvec(step[:3]).as_matrix() @ ROTATION
        off = bearings - directions(POINTS @ turn.T + TRANSLATION + step[3:])
        return np.asarray((np.sqrt(weight)[:, None] * off).ravel())

    expected = least_squares(residuals, np.zeros(6), xtol=1e-14, ftol=1e-14, gtol=1e-14).x
    linearise = match_equations(MODEL, bearings, POINTS, weight)
    end = refine(MODEL, MODEL.state(ROTATION, TRANSLATION), linearise, [1.0] * 50, settled=settled)
    rotation, translation = MODEL.pose(end.state)
    np.testing.assert_allclose(translation, TRANSLATION + expected[3:], atol=1e-6)
    np.testing.assert_allclose(rotation, Rotation.from_rotvec(expected[:3]).as_matrix() @ ROTATION, atol=1e-7)


def test_damped_steps_never_increase_the_cost_and_poses_do_not_affect_each_other() -> None:
    bearings = directions(POINTS @ ROTATION.T + TRANSLATION)
    linearise = match_equations(MODEL, bearings, POINTS)
    poses = [near(scale, seed) for seed in range(4) for scale in (0.3, 1.0, 2.0)]
    together = MODEL.state(*map(np.stack, zip(*poses, strict=True)))
    costs = [linearise(together, 1.0).cost]  # type: ignore[union-attr]
    for last in steps(MODEL, together, linearise, [1.0] * 30, damping=1e-3, adaptive=True):
        costs.append(linearise(last.state, 1.0).cost)  # type: ignore[union-attr]
    assert (np.diff(costs, axis=0) <= 0).all()
    assert (np.diff(costs, axis=0) == 0).any()  # some steps were not taken
    for k, pose in enumerate(poses):
        alone = refine(MODEL, MODEL.state(*pose), linearise, [1.0] * 30, damping=1e-3, adaptive=True)
        np.testing.assert_allclose(last.state.rotation[k], alone.state.rotation, atol=1e-9)
    assert min(degrees_between(one, ROTATION) for one in last.state.rotation) < 1e-6


@pytest.mark.parametrize("name", ["SIMPLE_RADIAL", "OPENCV_FISHEYE", "OPENCV"])
def test_residuals_of_pixels_take_any_camera_model(name: str) -> None:
    params = {
        "SIMPLE_RADIAL": (800.0, 320.0, 240.0, -0.1),
        "OPENCV": (800.0, 780.0, 320.0, 240.0, 0.1, -0.02, 1e-3, 2e-3),
        "OPENCV_FISHEYE": (400.0, 410.0, 320.0, 240.0, 0.02, -0.01, 0.001, 0.0),
    }[name]
    camera = camera_from((name, params))
    target = camera.project(POINTS @ ROTATION.T + TRANSLATION)
    linearise = image_equations(MODEL, camera.project, POINTS, target, lost=1e3)
    end = refine(MODEL, MODEL.state(*near(0.05)), linearise, [1.0] * 30, settled=settled)
    rotation, translation = MODEL.pose(end.state)
    np.testing.assert_allclose(rotation, ROTATION, atol=1e-9)
    np.testing.assert_allclose(translation, TRANSLATION, atol=1e-8)


def test_a_pose_is_refined_without_matches_at_decreasing_scales() -> None:
    order = RNG.permutation(len(POINTS))
    problem = Problem(directions(POINTS @ ROTATION.T + TRANSLATION)[order][:30], POINTS)
    linearise = soft_equations(MODEL, [problem], fewest=3)
    scales = np.geomspace(0.03, 1e-4, 20).tolist()
    end = refine(MODEL, MODEL.state(*near(0.02)), linearise, scales)
    assert not end.lost
    assert end.iterations == len(scales)
    np.testing.assert_allclose(MODEL.pose(end.state)[0], ROTATION, atol=1e-6)
    far = MODEL.state(ROTATION, TRANSLATION + [50.0, 0, 0])
    end = refine(MODEL, far, linearise, scales)
    assert (end.lost, end.iterations, end.converged) == (True, 0, False)


def test_a_rig_finds_its_pose_and_the_scale_of_the_scene() -> None:
    mounts = [
        (np.eye(3), np.zeros(3)),
        (Rotation.from_rotvec([0, 0.3, 0]).as_matrix(), np.array([-0.8, 0.1, 0.2])),
    ]
    model = PoseModel(POINTS.mean(0), mounts=mounts, scale=True)
    true = model.state(ROTATION, np.r_[TRANSLATION, 1.6])
    problems = [Problem(model.directions(true, POINTS, k), POINTS) for k in range(2)]
    start = model.moved(true, np.array([0.02, -0.01, 0.01, 0.02, 0.01, 0.03, 0.1]))
    assert start.unit == pytest.approx(1.6 * math.exp(-0.1))
    end = refine(model, start, soft_equations(model, problems), np.geomspace(0.03, 1e-4, 20).tolist())
    assert end.state.unit == pytest.approx(1.6, rel=1e-6)
    np.testing.assert_allclose(end.state.rotation, ROTATION, atol=1e-6)


def test_a_rig_finds_the_focal_length_of_its_cameras_without_matches() -> None:
    """The cameras have 1.05 times the focal length with which the bearings were computed, in another order."""
    mounts = [(np.eye(3), np.zeros(3)), (Rotation.from_rotvec([0, 0.3, 0]).as_matrix(), np.array([-0.8, 0.1, 0.2]))]
    model = PoseModel(POINTS.mean(0), UnknownFocal(2.0), mounts=mounts)
    true = model.state(ROTATION, np.r_[TRANSLATION, 1.0])._replace(zoom=1.05)
    seen = [model.directions(true, POINTS, k)[RNG.permutation(len(POINTS))] for k in range(2)]
    start = model.moved(true, np.array([0.01, -0.01, 0.01, 0.02, 0.01, 0.03, -math.log(1.05)]))
    linearise = soft_equations(model, [Problem(each, POINTS) for each in seen], fewest=3)
    end = refine(model, start, linearise, np.geomspace(0.03, 1e-4, 20).tolist())
    assert start.zoom == pytest.approx(1.0)
    assert end.state.zoom == pytest.approx(1.05, rel=1e-6)
    np.testing.assert_allclose(end.state.rotation, ROTATION, atol=1e-6)


def test_a_prior_of_the_focal_length_decides_what_the_points_leave_open() -> None:
    """Points of a plane that faces the camera: focal length and distance cannot be told apart."""
    flat = np.c_[POINTS[:, :2], np.zeros(len(POINTS))]
    bearings = directions(flat + [0, 0, 5.0])
    problem = Problem(bearings, flat)
    model = PoseModel(flat.mean(0), UnknownFocal(2.0, sigma=0.05, offset=-math.log(1.1)))  # 1.1 times is expected
    start = PoseState(np.eye(3), flat.mean(0) + [0, 0, 5.0])
    end = refine(model, start, soft_equations(model, [problem]), [1e-3] * 40)
    assert end.state.zoom == pytest.approx(1.1, rel=1e-3)
    assert end.state.centroid[2] == pytest.approx(5.5, rel=1e-3)


def test_no_step_is_larger_than_allowed() -> None:
    bearings = directions(POINTS @ ROTATION.T + TRANSLATION)
    linearise, largest = match_equations(MODEL, bearings, POINTS), np.full(6, 0.05)
    taken = list(steps(MODEL, MODEL.state(*near(0.5)), linearise, [1.0] * 40, largest=largest))
    assert max(np.abs(each.step).max() for each in taken) == pytest.approx(0.05)
    np.testing.assert_allclose(taken[-1].state.rotation, ROTATION, atol=1e-6)


@pytest.mark.parametrize("unit", [1e-9, 1e9])
def test_steps_do_not_depend_on_the_unit_of_length(unit: float) -> None:
    bearings = directions(POINTS @ ROTATION.T + TRANSLATION)
    ends = []
    for u in (1.0, unit):
        model, (rotation, translation) = PoseModel(u * POINTS.mean(0)), near(0.3)
        linearise = match_equations(model, bearings, u * POINTS)
        end = refine(model, model.state(rotation, u * translation), linearise, [1.0] * 3)
        ends.append((end.state.rotation, end.state.centroid / u))
    for one, other in zip(*ends, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-12)
