"""Pose models against finite differences, COLMAP's camera models, and laws of their information and tests."""

import math
from dataclasses import replace

import numpy as np
import pytest
from planted import directions
from scipy.spatial.transform import Rotation

from bpnp.cameras import camera_from
from bpnp.search.pose_model import PoseModel, PoseState, undistort
from bpnp.search.problem import Problem, UnknownFocal
from bpnp.search.starts import GravityPrior, PosePrior

FOCAL = 1000.0
STEP = 1e-6
RNG = np.random.default_rng(0)
POINTS = RNG.uniform([-1.5, -1.5, 3], [1.5, 1.5, 8], (30, 3))
MOUNTS = [(Rotation.from_rotvec(0.2 * RNG.standard_normal(3)).as_matrix(), RNG.uniform(-0.4, 0.4, 3)) for _ in range(2)]
LENSES = {
    "given": None,
    "focal": UnknownFocal(2.0),
    "focal and radial": UnknownFocal(2.0, radial_sigma=0.1),
    "focal, bent bearings": UnknownFocal(2.0, radial=-0.1),
    "focal and radial, bent bearings": UnknownFocal(2.0, radial=-0.1, radial_sigma=math.inf),
}


def state_of(model: PoseModel, *, bent: bool) -> PoseState:
    """A state near the identity; with another focal length and radial coefficient if they are unknown."""
    rotation = Rotation.from_rotvec([0.1, -0.2, 0.05]).as_matrix()
    radial = 0.0 if model.lens is None else model.lens.radial
    return PoseState(
        rotation,
        rotation @ model.centre + [0.1, 0.05, 0.2],
        zoom=1.07 if bent and model.lens is not None else 1.0,
        radial=radial + 0.06 * (bent and "radial" in model.columns),
        unit=1.3 if model.mounts is not None else 1.0,
    )


@pytest.mark.parametrize("lens", LENSES)
@pytest.mark.parametrize(("rig", "scale"), [(0, 0), (1, 0), (1, 1)])
@pytest.mark.parametrize("bent", [False, True])
def test_the_jacobian_is_that_of_finite_differences(lens: str, rig: int, scale: int, bent: bool) -> None:
    model = PoseModel(POINTS.mean(0), LENSES[lens], scale=bool(scale), mounts=MOUNTS if rig else None)
    state = state_of(model, bent=bent)
    assert model.size == 6 + scale + (lens != "given") + ("radial" in lens)
    for k in range(2 if rig else 1):
        sight = model.sight(state, POINTS, k)
        jacobian = model.jacobian(state, sight, k)
        assert jacobian.shape == (len(POINTS), 3, model.size)
        for column, step in enumerate(STEP * np.eye(model.size)):
            ends = (model.directions(model.moved(state, sign * step), POINTS, k) for sign in (1, -1))
            expected = np.subtract(*ends) / (2 * STEP)
            assert np.isfinite(expected).all()
            np.testing.assert_allclose(jacobian[..., column], expected, atol=2e-9, err_msg=str(model.columns))


@pytest.mark.parametrize("reference", [0.0, -0.1, 0.2])
@pytest.mark.parametrize("radial", [-0.15, 0.0, 0.1])
def test_directions_are_those_of_pixels_that_the_reference_camera_undistorts(reference: float, radial: float) -> None:
    """COLMAP's SIMPLE_RADIAL camera with another focal length and coefficient takes the picture."""
    model = PoseModel(np.zeros(3), UnknownFocal(2.0, radial=reference, radial_sigma=1.0))
    seen = model.directions(PoseState(np.eye(3), np.zeros(3), 1.1, radial), POINTS)
    pixels = camera_from(("SIMPLE_RADIAL", (1.1 * FOCAL, 0.0, 0.0, radial))).project(POINTS)
    reference_camera = camera_from(("SIMPLE_RADIAL", (FOCAL, 0.0, 0.0, reference)))
    normalised = reference_camera.normalise(pixels)
    expected = directions(np.c_[normalised, np.ones(len(normalised))])
    visible = np.isfinite(seen).all(-1)
    assert visible.mean() > 0.9
    np.testing.assert_allclose(seen[visible], expected[visible], atol=1e-7)
    if reference == 0:
        back = undistort(seen[visible], 1.1, radial)
        np.testing.assert_allclose(back, directions(POINTS[visible]), atol=1e-9)


def test_points_beyond_the_largest_radius_of_the_camera_model_are_not_seen() -> None:
    model = PoseModel(np.zeros(3), UnknownFocal(2.0, radial_sigma=1.0))
    points = np.array([[0.5, 0, 1], [1.2, 0, 1], [0.1, 0, -1]])
    seen = model.directions(PoseState(np.eye(3), np.zeros(3), 1.0, -0.3), points)
    assert np.isfinite(seen).all(1).tolist() == [True, False, False]  # 1 - 0.9 r^2 is negative at 1.2


def test_many_poses_have_the_derivatives_of_each_alone() -> None:
    model = PoseModel(POINTS.mean(0))
    rotations = Rotation.from_rotvec(0.1 * RNG.standard_normal((4, 3))).as_matrix()
    translations = RNG.uniform(-0.1, 0.1, (4, 3))
    together = model.state(rotations, translations)
    step = 0.01 * RNG.standard_normal((4, 6))
    for k in range(4):
        alone = model.state(rotations[k], translations[k])
        np.testing.assert_allclose(
            model.jacobian(together, model.sight(together, POINTS))[k],
            model.jacobian(alone, model.sight(alone, POINTS)),
            atol=1e-14,
        )
        both = model.pose(model.moved(together, step)), model.pose(model.moved(alone, step[k]))
        for every, one in zip(*both, strict=True):
            np.testing.assert_allclose(every[k], one, atol=1e-14)


def test_a_pose_and_its_state_are_the_same() -> None:
    rotation = Rotation.from_rotvec([0.3, 0.1, -0.2]).as_matrix()
    for mounts, translation in ((None, np.array([0.1, 0.2, 5.0])), (MOUNTS, np.array([0.1, 0.2, 5.0, 0.7]))):
        model = PoseModel(POINTS.mean(0), mounts=mounts)
        turn, shift = model.pose(model.state(rotation, translation))
        np.testing.assert_allclose(turn, rotation)
        np.testing.assert_allclose(shift, translation, atol=1e-15)


def test_a_rig_sees_what_each_of_its_cameras_sees() -> None:
    rotation, translation = Rotation.from_rotvec([0.3, 0.1, -0.2]).as_matrix(), np.array([0.1, 0.2, 5.0])
    model = PoseModel(POINTS.mean(0), mounts=MOUNTS)
    state = model.state(rotation, np.r_[translation, 0.7])
    for k, (turn, shift) in enumerate(MOUNTS):
        expected = directions((POINTS @ rotation.T + translation) @ turn.T + 0.7 * shift)
        np.testing.assert_allclose(model.directions(state, POINTS, k), expected, atol=1e-14)


def test_a_gravity_prior_has_no_information_on_the_rotation_about_the_vertical() -> None:
    up = np.array([1.0, 2, -2])
    model = PoseModel(POINTS.mean(0), UnknownFocal(2.0, sigma=0.1), prior=GravityPrior(up, [0, 0, 1], 2.0))
    information = model.information(model.state(np.eye(3), np.zeros(3)))
    assert information.shape == (7, 7)
    np.testing.assert_allclose(information[:3, :3] @ up, 0, atol=1e-9)
    other = np.cross(up, [1.0, 0, 0]) / np.linalg.norm(np.cross(up, [1.0, 0, 0]))
    assert other @ information[:3, :3] @ other == pytest.approx(math.radians(2.0) ** -2)
    assert information[6, 6] == pytest.approx(100.0)
    assert not information[3:6].any()


def test_a_translation_prior_is_that_of_the_origin_of_the_scene() -> None:
    """Rotation about the centroid moves the origin: the information is J^T J / sigma^2 by finite differences."""
    centre, rotation = np.array([1.0, 2, 3]), Rotation.from_rotvec([0.3, 0.1, -0.2]).as_matrix()
    translation = np.array([0.0, 0, 6])
    prior = PosePrior(rotation, translation, math.degrees(0.1), 0.2)
    for mounts in (None, MOUNTS):  # a rig counts its prior once
        model = PoseModel(centre, mounts=mounts, prior=prior)
        state = model.state(rotation, translation if mounts is None else np.r_[translation, 1.0])
        moved = [model.pose(model.moved(state, step))[1][:3] for step in STEP * np.r_[np.eye(6), -np.eye(6)]]
        by_step = np.subtract(moved[:6], moved[6:]).T / (2 * STEP)
        expected = by_step.T @ by_step / 0.2**2 + np.diag([100.0] * 3 + [0] * 3)
        np.testing.assert_allclose(model.information(state), expected, rtol=1e-6, atol=1e-6)


def test_the_prior_of_a_focal_length_draws_to_the_expected_one() -> None:
    """A step from a focal length 1.1 times too large with no other information ends at the expected one."""
    model = PoseModel(np.zeros(3), UnknownFocal(2.0, sigma=0.05, offset=math.log(1.1) - 0.02))
    state = PoseState(np.eye(3), np.zeros(3), zoom=math.exp(0.02))
    information, gradient = model.lens_prior(state)
    end = model.moved(state, gradient / np.maximum(np.diag(information), 1e-300))
    assert end.zoom * 1.1 / math.exp(0.02) == pytest.approx(1.0)


def test_each_unknown_takes_its_matches_and_its_tests() -> None:
    problem = Problem(directions(POINTS), POINTS)
    lens = UnknownFocal(2.0)
    pose, zoomed = PoseModel(np.zeros(3)), PoseModel(np.zeros(3), lens)
    assert (pose.fixing, zoomed.fixing) == (3, 4)  # each match fixes two numbers
    for sigma in (0.1, math.inf):  # a coefficient that is known from elsewhere takes none
        assert replace(pose, lens=lens._replace(radial_sigma=sigma)).fixing == 4
    alone = pose.log10_tests([problem])
    assert pose.log10_tests([problem, problem]) == pytest.approx(alone + math.log10(2))
    rig = PoseModel(np.zeros(3), mounts=MOUNTS, scale=True)
    assert rig.log10_tests([problem, problem]) == pytest.approx(alone + math.log10(2) + math.log10(2 * 30 * 30))
    assert zoomed.log10_tests([replace(problem, focal=lens)]) > alone + 1
    assert rig.fixing_ways(2, [(0, 1)]) == [[3, 1], [1, 3]]
    assert replace(rig, scale=False).fixing_ways(2) == [[3, 0], [0, 3]]


def test_tests_are_choices_of_matches_or_distinguishable_states() -> None:
    problem = Problem(directions(POINTS), POINTS)
    pose, triples = PoseModel(np.zeros(3)), math.comb(30, 3) ** 2 * 6
    assert pose.log10_choices(problem) == pytest.approx(math.log10(2 * triples))
    labelled = replace(problem, labels2d=np.arange(30), labels3d=np.arange(30))
    assert pose.log10_choices(labelled) == pytest.approx(math.log10(2 * math.comb(30, 3)))
    scales = np.array([1e-3, 2e-3])
    for model, power in ((pose, 6), (replace(pose, lens=UnknownFocal(0.5)), 7)):
        cells = model.log10_cells(0.2, scales, 0.1)
        assert cells[0] - cells[1] == pytest.approx(power * math.log10(2))
    few = replace(pose, lens=UnknownFocal(0.5)).log10_cells(0.2, scales) - pose.log10_cells(0.2, scales)
    np.testing.assert_allclose(10**few, 0.5 * 0.2 / scales)
