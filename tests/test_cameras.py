"""Pixels and rays of every kind of camera, against pycolmap and OpenCV."""

from typing import Any

import cv2
import numpy as np
import pycolmap
import pytest
import torch

import bpnp
from bpnp.cameras import camera_from, resize_camera

K = np.array([[520.0, 1.5, 405.0], [0.0, 500.0, 290.0], [0.0, 0.0, 1.0]])
OPENCV = ("OPENCV", [520.0, 500.0, 405.0, 290.0, -0.28, 0.09, 0.004, -0.006])
RAYS = np.random.default_rng(0).uniform((-0.6, -0.5, 1), (0.6, 0.5, 1), (50, 3))


@pytest.mark.parametrize(
    "camera_like",
    [
        np.array([[900.0, 0, 320], [0, 400, 240], [0, 0, 1]]),
        ("PINHOLE", [900.0, 400.0, 320.0, 240.0]),
        ("OPENCV_FISHEYE", [900.0, 400.0, 320.0, 240.0, 0.0, 0.0, 0.0, 0.0]),
    ],
)
def test_the_focal_length_is_that_of_pycolmap_for_every_kind_of_camera(camera_like: Any) -> None:
    camera = pycolmap.Camera(model="PINHOLE", width=640, height=480, params=[900.0, 400.0, 320.0, 240.0])
    assert camera_from(camera_like).focal == pytest.approx(camera.mean_focal_length(), rel=1e-12)


@pytest.mark.parametrize("camera_like", [K, K.tolist(), torch.tensor(K), 2 * K, K.astype(np.float32)])
def test_a_matrix_is_the_projection_of_opencv(camera_like: object) -> None:
    camera = camera_from(camera_like)
    expected = (RAYS @ K.T)[:, :2]
    np.testing.assert_allclose(camera.project(3.5 * RAYS), expected, rtol=1e-6)
    np.testing.assert_allclose(camera.normalise(expected), RAYS[:, :2], atol=1e-6)
    assert camera.focal == pytest.approx(510, rel=1e-6)


@pytest.mark.parametrize(
    "camera_like",
    [
        OPENCV,
        ("OPENCV", 800, 600, OPENCV[1]),
        {"model": "OPENCV", "params": OPENCV[1], "width": 800, "height": 600},
        pycolmap.Camera(model="OPENCV", width=800, height=600, params=OPENCV[1]),
    ],
)
def test_distortion_is_removed_and_applied_as_in_opencv(camera_like: object) -> None:
    camera = camera_from(camera_like)
    fx, fy, cx, cy, *distortion = OPENCV[1]
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    expected, _ = cv2.projectPoints(RAYS, np.zeros(3), np.zeros(3), matrix, np.array(distortion))
    np.testing.assert_allclose(camera.project(2 * RAYS), expected[:, 0], atol=1e-6)
    np.testing.assert_allclose(camera.normalise(expected[:, 0]), RAYS[:, :2], atol=1e-6)
    assert camera.focal == pytest.approx(510)


@pytest.mark.parametrize(
    "distortion",
    [
        None,
        np.zeros(4),
        [-0.28, 0.09, 0.004, -0.006],
        np.array([[-0.28, 0.09, 0.004, -0.006, 0.02]]),
        np.array([0.2, -0.1, 0.004, -0.006, 0.02, 0.3, -0.12, 0.01]),
        np.array([0.2, -0.1, 0.004, -0.006, 0.02, 0.3, -0.12, 0.01, 0, 0, 0, 0]),
    ],
)
def test_opencvs_matrix_and_distortion_are_a_camera(distortion: Any) -> None:
    matrix = K * [[1, 0, 1], [1, 1, 1], [1, 1, 1]]  # OpenCV has no skew
    camera = camera_from((matrix, distortion))
    coefficients = np.zeros(5) if distortion is None else np.array(distortion)
    expected, _ = cv2.projectPoints(RAYS, np.zeros(3), np.zeros(3), matrix, coefficients)
    np.testing.assert_allclose(camera.project(2 * RAYS), expected[:, 0], atol=1e-6)
    np.testing.assert_allclose(camera.normalise(expected[:, 0]), RAYS[:, :2], atol=1e-5)
    found = bpnp.solve(expected[:, 0], RAYS * np.linspace(2, 5, 50)[:, None], (matrix, distortion), solver="search")
    np.testing.assert_allclose(found.rotation, np.eye(3), atol=1e-4)


def test_pixels_that_no_ray_reaches_are_none() -> None:
    """A fisheye pixel 600 from the centre at 300 pixels a radian looks backwards."""
    camera = camera_from(("OPENCV_FISHEYE", [300.0, 300.0, 400.0, 300.0, 0.0, 0.0, 0.0, 0.0]))
    found = camera.normalise(np.array([[400.0, 300.0], [1000.0, 300.0]]))
    assert np.isfinite(found).all(-1).tolist() == [True, False]


@pytest.mark.parametrize(
    ("camera_like", "message"),
    [
        (np.diag([500.0, 0.0, 1.0]), "`camera` matrix is singular"),
        (np.ones((3, 3)), r"last row of the `camera` matrix .* instead of \(0, 0, 1\)"),
        (np.array([[500.0, 0, 0], [0, np.nan, 0], [0, 0, 1]]), "`camera` matrix holds NaN or infinity"),
        (np.eye(4), r"shape \(3, 3\)"),
        ("PINHOLE", "`camera` is a 3x3 matrix, .*, not "),
        (object(), "`camera` is a 3x3 matrix, .*, not "),
        ((K, [0.1]), "distortion has 4, 5 or 8 coefficients, not"),
        ((K, [0.1, 0, 0, 0]), "a `camera` with distortion cannot have skew"),
        ((np.diag([500.0, 0.0, 1.0]), None), "`camera` matrix is singular"),
        (("PINHOL", [1.0]), "'PINHOL' is no COLMAP camera model; the models are .*OPENCV"),
        (("PINHOLE", [500.0, 500.0, 320.0]), "a PINHOLE camera has 4 parameters, not"),
        (("PINHOLE", [500.0, 500.0, np.inf, 240.0]), "parameters of a PINHOLE camera hold NaN or infinity"),
        (("PINHOLE", [0.0, 0.0, 320.0, 240.0]), "focal length of a camera has to be positive"),
        (("PINHOLE", 640, [1.0]), "`camera` has 3 values; give"),
        (("PINHOLE", -640, 480, [500.0, 500.0, 320.0, 240.0]), r"width and height of a PINHOLE camera .*\(-640, 480\)"),
        (("PINHOLE", np.nan, 480, [500.0, 500.0, 320.0, 240.0]), "width and height of a PINHOLE camera"),
        (("PINHOLE", "wide"), "parameters of a PINHOLE camera are not numbers"),
        ({"model": "PINHOLE"}, "`model` and `params`"),
    ],
)
def test_a_broken_camera_is_refused(camera_like: object, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        camera_from(camera_like)


@pytest.mark.parametrize("params", [(-800, 800, 320, 240), (800, -800, 320, 240), (800, 0, 320, 240)])
def test_each_focal_length_is_positive(params: tuple[float, ...]) -> None:
    with pytest.raises(ValueError, match="focal length of a camera has to be positive"):
        camera_from(("PINHOLE", params))


def test_a_scaled_camera_sees_the_same_rays_at_scaled_pixels() -> None:
    camera = camera_from(("OPENCV", 800, 600, OPENCV[1]))
    smaller = resize_camera(camera, (400, 300))
    np.testing.assert_allclose(smaller.project(RAYS), camera.project(RAYS) / 2, atol=1e-9)
    assert resize_camera(camera, (800, 600)) is camera
    for size in ((400, 225), (300, 400)):
        with pytest.raises(
            ValueError, match=f"800 x 600 pixels cannot be scaled to {size[0]} x {size[1]}, another aspect ratio"
        ):
            resize_camera(camera, size)
    with pytest.raises(ValueError, match="a camera without an image size cannot be scaled"):
        resize_camera(camera_from(K), (800, 600))


@pytest.mark.parametrize(
    ("model", "params"),
    [
        ("SIMPLE_FISHEYE", [600.0, 1000, 1000]),
        ("FISHEYE", [600.0, 610, 1000, 990]),
        ("SIMPLE_RADIAL_FISHEYE", [600.0, 1000, 1000, 0.02]),
        ("RADIAL_FISHEYE", [600.0, 1000, 1000, 0.02, -0.004]),
        ("OPENCV_FISHEYE", [600.0, 610, 1000, 990, 0.02, -0.01, 0.003, -0.0002]),
        ("OPENCV", [900.0, 910, 1000, 990, -0.1, 0.01, 0.001, 0]),
        ("PINHOLE", [900.0, 910, 1000, 990]),
    ],
)
def test_points_are_projected_as_by_pycolmap(model: str, params: list[float]) -> None:
    rays = RAYS / np.linalg.norm(RAYS, axis=-1, keepdims=True)
    camera = pycolmap.Camera(model=model, width=2000, height=2000, params=params)
    np.testing.assert_allclose(camera_from(camera).project(3 * rays), camera.img_from_cam(rays), atol=1e-9)


def test_a_fisheye_sees_behind_itself() -> None:
    """The radius of OpenCV's fisheye at the angle t is f (t + k1 t^3 + ...), also beyond 90 degrees."""
    angle, around = np.radians([0, 60, 89.9, 90, 91, 110, 120]), np.linspace(0, 6, 7)
    radius = 500 * (angle - 0.02 * angle**3 + 0.002 * angle**5)
    pixels = 1000 + radius[:, None] * np.stack([np.cos(around), np.sin(around)], -1)
    camera = camera_from(("OPENCV_FISHEYE", [500, 500, 1000, 1000, -0.02, 0.002, 0, 0]))
    expected = np.stack([np.sin(angle) * np.cos(around), np.sin(angle) * np.sin(around), np.cos(angle)], -1)
    np.testing.assert_allclose(camera.project(3 * expected), pixels, atol=1e-9)
    assert np.isnan(camera.project(np.array([[0.0, 0, -1], [0, 0, 0], [np.nan, 0, 1]]))).all()
    turning = camera_from(
        ("OPENCV_FISHEYE", [500, 500, 1000, 1000, -0.1, 0, 0, 0])
    )  # its radius falls from 105 degrees
    beyond = np.radians([104.0, 106.0])
    seen = turning.project(np.stack([np.sin(beyond), np.zeros(2), np.cos(beyond)], -1))
    assert np.isfinite(seen).all(-1).tolist() == [True, False]


@pytest.mark.parametrize(
    ("model", "params"),
    [
        ("SIMPLE_RADIAL", [500.0, 500, 400, -0.3]),
        ("RADIAL", [500.0, 500, 400, -0.3, 0.02]),
        ("OPENCV", [500.0, 510, 500, 400, -0.3, 0.02, 0.0, 0.0]),
        ("FULL_OPENCV", [500.0, 510, 500, 400, 0.1, 0.01, 0.0, 0.0, 0.0, 0.3, 0.2, 0.1]),
        ("THIN_PRISM_FISHEYE", [500.0, 510, 500, 400, -0.3, 0.02, 0.0, 0.0, 0.001, 0.001, 0.0, 0.0]),
        ("RAD_TAN_THIN_PRISM_FISHEYE", [500.0, 510, 500, 400, -0.3, 0.02, 0.001, *[0.0] * 9]),
    ],
)
def test_a_point_beyond_the_field_of_view_does_not_fold_back_into_the_image(model: str, params: list[float]) -> None:
    """pycolmap projects a point far off the axis near the centre, where another ray is seen."""
    slopes = np.linspace(0, 6, 601)
    points = np.column_stack([slopes, np.zeros_like(slopes), np.ones_like(slopes)])
    given = pycolmap.Camera(model=model, width=1000, height=800, params=params)
    pixels = given.img_from_cam(points)
    rising = np.flatnonzero(np.diff(pixels[:, 0]) <= 0)[0]  # the last pixel before the radius falls
    seen = camera_from(given).project(2 * points)
    np.testing.assert_allclose(seen[:rising], pixels[:rising], atol=1e-9)
    assert np.isnan(seen[rising + 1 :]).all()


@pytest.mark.parametrize(
    ("model", "params"),
    [
        ("SIMPLE_RADIAL", [500.0, 500, 400, 0.3]),
        ("SIMPLE_RADIAL", [500.0, 500, 400, 0.0]),
        ("THIN_PRISM_FISHEYE", [500.0, 500, 500, 400, *[0.0] * 8]),
        ("THIN_PRISM_FISHEYE", [500.0, 500, 500, 400, -0.1, *[0.0] * 7]),  # falls only from 105 degrees
    ],
)
def test_a_radius_that_rises_everywhere_has_no_limit(model: str, params: list[float]) -> None:
    camera = pycolmap.Camera(model=model, width=1000, height=800, params=params)
    points = np.array([[50.0, 0, 1], [-1e6, 3, 1]])
    np.testing.assert_allclose(camera_from(camera).project(points), camera.img_from_cam(points), rtol=1e-12)
