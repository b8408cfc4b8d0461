"""Cameras of ROS's camera_info and of OpenCV's calibration, against OpenCV's own projection."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from bpnp.cameras import camera_from, image_size
from bpnp.commands.point_files import read_camera

K = np.array([[901.94, 0, 635.75], [0, 889.3, 370.6], [0, 0, 1]])
POINTS = np.random.default_rng(0).uniform([-1, -0.6, 2], [1, 0.6, 4], (30, 3))
DISTORTION = {
    "plumb_bob": [0.08154, -0.15252, 0.000834, 0.000368, 0.02],
    "rational_polynomial": [0.2, -0.1, 0.001, -0.0005, 0.03, 0.25, -0.05, 0.02],
    "equidistant": [0.05, -0.01, 0.003, -0.001],
}


def project(model: str) -> np.ndarray:
    """Project by OpenCV, whose first pixel has its centre at 0."""
    distortion, none = np.array(DISTORTION[model]), np.zeros(3)
    if model == "equidistant":
        return cv2.fisheye.projectPoints(POINTS[:, None], none, none, K, distortion)[0][:, 0]
    return cv2.projectPoints(POINTS, none, none, K, distortion)[0][:, 0]


def flow(values: object) -> str:
    return str(np.ravel(values).tolist())


def saved(model: str) -> str:
    """Return the file of ROS's camera_calibration."""
    return (
        f"image_width: 1280\nimage_height: 720\ncamera_matrix:\n  rows: 3\n  cols: 3\n  data: {flow(K)}\n"
        f"distortion_model: {model}\ndistortion_coefficients:\n  rows: 1\n  cols: {len(DISTORTION[model])}\n"
        f"  data: {flow(DISTORTION[model])}\n"
    )


def ros1(model: str) -> str:
    header = "header: \n  seq: 7\n  frame_id: cam\n"
    matrices = f"D: {flow(DISTORTION[model])}\nK: {flow(K)}\nR: {flow(np.eye(3))}\n"
    cropping = "binning_x: 0\nroi: \n  x_offset: 0\n  y_offset: 0\n  do_rectify: False\n"
    return f'{header}height: 720\nwidth: 1280\ndistortion_model: "{model}"\n{matrices}{cropping}---\n'


def ros2(model: str) -> str:
    def block(values: object) -> str:
        return "".join(f"- {value!r}\n" for value in np.ravel(values).tolist())

    other = block(np.eye(3, 4)) + "binning_x: 0\nbinning_y: 0\n---\n"
    once = (
        f"height: 720\nwidth: 1280\ndistortion_model: {model}\nd:\n{block(DISTORTION[model])}k:\n{block(K)}p:\n{other}"
    )
    return 2 * once


@pytest.mark.parametrize("form", [saved, ros1, ros2])
@pytest.mark.parametrize("model", DISTORTION)
def test_camera_info_projects_as_opencv(model: str, form: Callable[[str], str], tmp_path: Path) -> None:
    path = tmp_path / "camera.yaml"
    path.write_text(form(model))
    camera = camera_from(read_camera(str(path)))
    np.testing.assert_allclose(camera.project(POINTS), project(model), atol=1e-6)
    assert image_size(camera) == (1280, 720)
    np.testing.assert_allclose(camera.normalise(project(model)), POINTS[:, :2] / POINTS[:, 2:], atol=1e-5)
    in_colmap = camera_from(read_camera(str(path), centre=0.5))
    np.testing.assert_allclose(in_colmap.project(POINTS), project(model) + 0.5, atol=1e-6)


@pytest.mark.parametrize("suffix", [".yml", ".json", ".xml.yml"])
def test_a_calibration_of_opencv_is_read(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"out_camera_data{suffix}"
    file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    file.write("image_width", 1280)
    file.write("image_height", 720)
    file.write("camera_matrix", K)
    file.write("distortion_coefficients", np.array(DISTORTION["plumb_bob"]))
    file.release()
    camera = camera_from(read_camera(str(path)))
    np.testing.assert_allclose(camera.project(POINTS), project("plumb_bob"), atol=1e-6)


def test_a_camera_without_distortion_is_a_pinhole(tmp_path: Path) -> None:
    path = tmp_path / "camera.txt"  # found by its key, not by its suffix
    for more in ("", "d: [0, 0, 0, 0, 0]\n", "d: []\ndistortion_model: ''\n"):
        path.write_text(f"K: {K.tolist()}\n{more}")
        assert read_camera(str(path)) == ("PINHOLE", 0, 0, [901.94, 889.3, 635.75, 370.6])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("K: [0, 0, 0, 0, 0, 0, 0, 0, 0]", "its camera is not calibrated: the matrix is 0"),
        ("K: [1, 2, 3]", "its camera matrix has 3 numbers instead of 9"),
        (f"K: {flow(K)}\nD: [1, 0, 0, 0]", "its 4 distortion coefficients need a distortion_model, one of plumb_bob"),
        (f"K: {flow(K)}\nD: [1, 0]\ndistortion_model: omni", "its distortion_model 'omni' is not known; the models"),
        (f"K: {flow(K)}\ndist_coeff: [0.1]", "it has the key dist_coeff, which is not read; call it"),
        (f"K: {flow(K)}\nbinning_x: 2", "its image is binned or cropped"),
        (f"K: {flow(K)}\nroi: {{x_offset: 8}}", "its image is binned or cropped"),
        ("K: [a, 0, 0, 0, 0, 0, 0, 0, 0]", "its K is .*numbers are needed"),
        ("cam0: {intrinsics: [1, 2, 3, 4]}", "it has none of the keys camera_matrix, K, k"),
        ("k: &k [*k]", "the alias .* stands for itself"),
    ],
)
def test_a_calibration_that_would_be_misread_is_refused(text: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "a.yaml").write_text(text)
    with pytest.raises(ValueError, match=f"--camera .*a.yaml: {message}"):
        read_camera(str(tmp_path / "a.yaml"))
