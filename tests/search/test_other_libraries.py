"""Cameras and poses as users of OpenCV and pycolmap write them, against projections of these libraries."""

import math
from collections.abc import Callable
from functools import partial
from typing import Any

import cv2
import numpy as np
import pycolmap
import pytest
import torch
from planted import degrees_between
from scipy.spatial.transform import Rotation

import bpnp
from bpnp import Solution
from bpnp.search.arguments import cameras_from

solve, solve_many, verify = (
    partial(function, time_limit=math.inf) for function in (bpnp.solve, bpnp.solve_many, bpnp.verify)
)
RNG = np.random.default_rng(2)
SCENE = RNG.normal(size=(40, 3))
RVEC, TVEC = np.array([[0.1], [-0.2], [0.3]]), np.array([[0.2], [-0.1], [6.0]])
ROTATION = cv2.Rodrigues(RVEC)[0]
FOUR = [800.0, 790.0, 320.0, 240.0]
K = np.array([[800.0, 0, 320], [0, 790, 240], [0, 0, 1]])
BENT = np.array([0.3, -0.1, 0.004, 0.003, 0.0])


def image(coefficients: Any = None) -> np.ndarray:
    """Return OpenCV's projections (40, 1, 2), in another order than the scene."""
    return RNG.permutation(cv2.projectPoints(SCENE, RVEC, TVEC, K, coefficients)[0])


def is_planted(solution: Solution) -> bool:
    near = np.allclose(solution.translation, TVEC[:, 0], atol=1e-5)
    return solution.verdict == "confident" and near and degrees_between(solution.rotation, ROTATION) < 1e-4


@pytest.mark.parametrize(
    "coefficients",
    [
        BENT,
        BENT[None],
        BENT[:, None],
        BENT[:4],
        BENT.astype(np.float32),
        BENT.tolist(),
        torch.from_numpy(BENT),
        np.r_[BENT, 0.02, 0.01, 0],
    ],
    ids=["5", "1 x 5", "5 x 1", "4", "float32", "list", "tensor", "8"],
)
def test_the_fourth_argument_holds_the_coefficients_of_opencv(coefficients: Any) -> None:
    seen = image(np.asarray(coefficients, np.float64))
    assert is_planted(solve(seen, SCENE, K, coefficients))
    assert is_planted(verify(seen, SCENE, RVEC, TVEC, K, coefficients))
    assert is_planted(solve_many([seen, seen], SCENE, FOUR, coefficients)[0])
    assert not is_planted(solve(seen, SCENE, K))  # they count


@pytest.mark.parametrize("none", [None, np.zeros(5), np.zeros((0,))], ids=["None", "zeros", "empty"])
def test_a_camera_of_opencv_without_distortion(none: Any) -> None:
    assert is_planted(solve(image(), SCENE, K, none))
    assert is_planted(verify(image(), SCENE, RVEC, TVEC, K, none))


def test_a_focal_length_is_estimated_with_the_coefficients_of_opencv() -> None:
    solution = solve(image(BENT), SCENE, 1.03 * K / [1, 1, 1.03], BENT, focal_error=0.1)
    assert solution.focal_length == pytest.approx(795, rel=0.01)


@pytest.mark.parametrize(
    ("camera", "coefficients", "message"),
    [
        (K, (640, 480), r"OpenCV's distortion has 4, 5 or 8 coefficients, not \[640.0, 480.0\]"),
        (K, 0.1, "`distortion` is 0.1; it is True, False, or OpenCV's coefficients k1"),
        (K, "OPENCV", "`distortion` is 'OPENCV'; it is True"),
        (
            K,
            np.zeros((2, 4)),
            r"`distortion` has the shape \(2, 4\); it holds the coefficients of one camera",
        ),
        (K, ["a"] * 4, r"`distortion` is \['a'.*; an array of numbers is needed"),
        (K, [math.nan] * 4, "hold NaN"),
        (None, BENT, "in `distortion` need a 3x3 matrix K as `camera`, which is missing"),
        (("PINHOLE", FOUR), BENT, "in `distortion` need a 3x3 matrix K as `camera`, which is .'PINHOLE'"),
        ([K], BENT, "for several cameras give each as .K, distortion."),
        (K, True, "`distortion=True` needs an `image_size`, or a `focal_error`"),
    ],
)
def test_what_are_no_coefficients_is_refused(camera: Any, coefficients: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        solve(image(), SCENE, camera, coefficients)
    with pytest.raises(ValueError, match="`distortion` is True, but `verify` fits none|" + message):
        verify(image(), SCENE, RVEC, TVEC, camera, coefficients)


@pytest.mark.parametrize(
    "camera",
    [
        FOUR,
        tuple(FOUR),
        np.array(FOUR, np.float32),
        torch.tensor(FOUR),
        (FOUR, None),
        [K, np.zeros(5)],
        [tuple(row) for row in K.tolist()],
    ],
    ids=["list", "tuple", "float32", "tensor", "with distortion", "list of K and distortion", "rows"],
)
def test_a_camera_of_four_numbers_and_lists_in_place_of_tuples(camera: Any) -> None:
    assert is_planted(solve(image(), SCENE, camera))
    assert is_planted(verify(image(), SCENE, RVEC, TVEC, camera))


def test_lists_of_several_cameras_are_not_one_camera() -> None:
    """Four numbers are one camera of four problems; four cameras are four."""
    pinhole = ("PINHOLE", FOUR)
    assert cameras_from(FOUR, 4) == tuple(FOUR)
    assert cameras_from([FOUR] * 4, 4) == [FOUR] * 4
    assert cameras_from([FOUR], 1) == [FOUR]
    assert [one.tolist() for one in cameras_from(np.array([FOUR] * 2), 2)] == [FOUR] * 2
    assert cameras_from([tuple(FOUR)] * 2, 2) == [tuple(FOUR)] * 2
    assert cameras_from([FOUR, pinhole, None], 3) == [FOUR, pinhole, None]
    assert cameras_from([None, FOUR], 2) == [None, FOUR]
    assert cameras_from([K] * 4, 4) == [K] * 4
    assert cameras_from(K.tolist(), 3) == tuple(K.tolist())
    assert len(cameras_from([K, BENT[:4]], 2)) == 2  # the second is a camera too
    assert isinstance(cameras_from([K, BENT[:4]], 2), list)
    lenses = [pycolmap.Camera(model="PINHOLE", width=640, height=480, params=FOUR)] * 4
    assert cameras_from(lenses, 4) == lenses


def test_a_rig_of_four_cameras_has_one_camera_of_four_numbers() -> None:
    mounts = [(np.eye(3), [0.1 * k, 0, 0]) for k in range(4)]
    pixels = [cv2.projectPoints(SCENE, RVEC, TVEC + np.array(mount[1])[:, None], K, None)[0] for mount in mounts]
    rig: list[Any] = [(cv2.Rodrigues(rotation)[0], np.array(shift)[:, None]) for rotation, shift in mounts]
    for camera in (FOUR, [FOUR] * 4, K.tolist()):
        assert is_planted(solve(pixels, SCENE, camera, rig=rig))


@pytest.mark.parametrize("camera", [[800.0, 320, 240], [*FOUR, 0.1], 800.0, np.zeros((3, 4))])
def test_another_number_of_parameters_is_refused(camera: Any) -> None:
    with pytest.raises(ValueError, match=r"the `camera` matrix needs the shape \(3, 3\).*or give \[fx, fy, cx, cy\]"):
        solve(image(), SCENE, camera)


def rigid() -> pycolmap.Rigid3d:
    return pycolmap.Rigid3d(pycolmap.Rotation3d(ROTATION), TVEC[:, 0])


POSES: dict[str, Callable[[], Any]] = {
    "rvec": lambda: (RVEC, TVEC),
    "flat rvec": lambda: (RVEC[:, 0].tolist(), TVEC[:, 0].tolist()),
    "list": lambda: [RVEC, TVEC],
    "tensors": lambda: (torch.from_numpy(RVEC).float(), torch.from_numpy(TVEC).float()),
    "column": lambda: (ROTATION, TVEC),
    "scipy": lambda: (Rotation.from_rotvec(RVEC[:, 0]), TVEC),
    "rotation3d": lambda: (pycolmap.Rotation3d(ROTATION), TVEC[:, 0]),
    "3 x 4": lambda: np.hstack([ROTATION, TVEC]),
    "4 x 4": lambda: np.vstack([np.hstack([ROTATION, TVEC]), [0, 0, 0, 1]]).tolist(),
    "Rigid3d": rigid,
    "solution": lambda: solve(image(), SCENE, K),
    "pose": lambda: solve(image(), SCENE, K).pose,
}


@pytest.mark.parametrize("pose", POSES.values(), ids=POSES)
def test_verify_takes_each_pose_that_a_prior_takes(pose: Callable[[], Any]) -> None:
    seen = image()
    assert is_planted(verify(seen, SCENE, pose(), camera=K))
    assert is_planted(solve(seen, SCENE, K, prior=pose()))
    if isinstance(pose(), (tuple, list)) and len(pose()) == 2:
        assert is_planted(verify(seen, SCENE, *pose(), K))
    other = (Rotation.from_rotvec([0, 2, 0]).as_matrix() @ ROTATION, TVEC)
    assert verify(seen, SCENE, other, camera=K).verdict == "failed"


@pytest.mark.parametrize(
    ("pose", "message"),
    [
        ((ROTATION,), "`translation` is missing; give rotation and translation, or one pose"),
        ((RVEC,), "`translation` is missing"),
        ((K, K), "`rotation` is no rotation matrix"),
        ((rigid(), TVEC), "`rotation` is a whole pose; leave out `translation`, and give the camera as camera="),
        ((rigid(), K), "give the camera as camera="),
        (((ROTATION, None),), "`translation` is missing"),
        (("pose.json",), "`translation` is missing"),
        ((solve(np.zeros((20, 2)), SCENE),), "`rotation` is a solution without a pose; give another"),
        (([0, 0, 0, 1], TVEC), r"`rotation` is \[0.0, 0.0, 0.0, 1.0\]; of a quaternion .x, y, z, w. give scipy"),
        ((RVEC * math.nan, TVEC), r"`rotation` is \[nan, nan, nan\]; finite numbers"),
        ((ROTATION, [1, 2]), r"`translation` is \[1.0, 2.0\]; finite numbers of shape \(3,\)"),
    ],
)
def test_what_is_no_pose_is_refused(pose: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        verify(image(), SCENE, *pose)


def test_a_solution_has_the_pose_in_the_forms_of_other_libraries() -> None:
    solution = solve(image(), SCENE, K)
    found = solution.cam_from_world
    np.testing.assert_allclose(found.matrix(), rigid().matrix(), atol=1e-6)
    np.testing.assert_allclose(solution.pose[:3], rigid().matrix(), atol=1e-6)
    np.testing.assert_array_equal(solution.pose[3], [0, 0, 0, 1])
    np.testing.assert_allclose(solution.quaternion, rigid().rotation.quat, atol=1e-6)
    np.testing.assert_allclose(found.tgt_origin_in_src(), solution.centre, atol=1e-9)


def test_the_pose_of_a_rig_maps_the_scene_in_the_unit_of_the_rig() -> None:
    apart = np.array([[1.0], [0], [0]])
    pixels = [cv2.projectPoints(SCENE, RVEC, TVEC + k * apart, K, None)[0] for k in range(2)]
    solution = solve(pixels, SCENE / 2, K, rig=[(np.eye(3), k * apart) for k in range(2)], scale=True)
    assert solution.scale == pytest.approx(2, rel=1e-6)
    moved = np.c_[SCENE / 2, np.ones(40)] @ solution.pose.T
    np.testing.assert_allclose(moved[:, :3], SCENE @ ROTATION.T + TVEC.T, atol=1e-5)
    with pytest.raises(ValueError, match="a rig of 2 cameras cannot become cam_from_world"):
        _ = solution.cam_from_world


def test_a_solution_without_a_pose_has_none_in_any_form() -> None:
    nothing = solve(np.zeros((20, 2)), SCENE)
    assert (nothing.found, nothing.cam_from_world) == (False, None)
    assert np.isnan(nothing.quaternion).all()
    assert np.isnan(nothing.pose[:3]).all()
