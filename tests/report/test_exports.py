"""A solution in the files of other programs: pycolmap reads the pose, the matches and the points that were solved."""

import json
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pycolmap
import pytest

import bpnp
from bpnp.examples import load
from bpnp.solving.problem import problem_from
from bpnp.solving.sources import without_pose

EXAMPLE = load("mesh")
SOLUTION = bpnp.solve(EXAMPLE.points2d, EXAMPLE.points3d, EXAMPLE.camera)
OPENCV = ("OPENCV", (800.0, 810.0, 640.0, 480.0, -0.1, 0.02, 0.001, -0.001))


@pytest.mark.parametrize("camera", [EXAMPLE.camera, OPENCV, None])
def test_pycolmap_reads_a_complete_model(camera: Any, tmp_path: Path) -> None:
    points2d = EXAMPLE.points2d
    if camera is OPENCV:
        lens = pycolmap.Camera(model="OPENCV", params=list(OPENCV[1]))
        rays = np.c_[points2d, np.ones(len(points2d))] @ np.linalg.inv(EXAMPLE.camera).T
        points2d = np.asarray(lens.img_from_cam(rays))
    solution = bpnp.solve(points2d, EXAMPLE.points3d, camera) if camera is OPENCV else SOLUTION
    folder = solution.to_colmap(tmp_path / "model", camera=camera, name="photo.jpg", size=(1280, 960))
    model = pycolmap.Reconstruction(str(folder))
    (image,) = model.images.values()
    np.testing.assert_allclose(image.cam_from_world().matrix()[:, :3], solution.rotation, atol=1e-12)
    np.testing.assert_allclose(image.cam_from_world().translation, solution.translation, atol=1e-12)
    assert (image.name, image.num_points3D, model.num_points3D()) == ("photo.jpg", solution.inlier_count, 200)
    matched = {(i, image.points2D[i].point3D_id - 1) for i in range(200) if image.points2D[i].has_point3D()}
    assert matched == set(map(tuple, solution.matches.tolist()))
    if camera is not None:
        np.testing.assert_allclose([p.xy for p in image.points2D], points2d, atol=1e-3)
    for i, j in solution.matches.tolist():
        seen = model.cameras[1].img_from_cam(image.cam_from_world() * model.points3D[j + 1].xyz)
        error = np.linalg.norm(seen - image.points2D[i].xy)
        assert model.points3D[j + 1].error == pytest.approx(error, abs=1e-6)
        assert [(e.image_id, e.point2D_idx) for e in model.points3D[j + 1].track.elements] == [(1, i)]
    again = tmp_path / "binary"
    again.mkdir()
    model.write_binary(str(again))
    assert pycolmap.Reconstruction(str(again)).num_points3D() == 200


def test_nerfstudio_sees_the_points_where_they_are(tmp_path: Path) -> None:
    content = json.loads(SOLUTION.to_nerfstudio(tmp_path / "transforms.json", camera=EXAMPLE.camera).read_text())
    pose = np.array(content["frames"][0]["transform_matrix"])
    i, j = SOLUTION.matches.T
    camera = (EXAMPLE.points3d[j] - pose[:3, 3]) @ pose[:3, :3]  # x right, y up, z backwards
    x = content["fl_x"] * camera[:, 0] / -camera[:, 2] + content["cx"]
    y = content["fl_y"] * -camera[:, 1] / -camera[:, 2] + content["cy"]
    np.testing.assert_allclose(np.c_[x, y], EXAMPLE.points2d[i], atol=4)
    assert np.median(np.abs(np.c_[x, y] - EXAMPLE.points2d[i])) < 1


def test_rerun_is_told_points_and_camera(monkeypatch: pytest.MonkeyPatch) -> None:
    logged: dict[str, Any] = {}
    fake = SimpleNamespace(
        log=logged.__setitem__, Points3D=lambda points, colors: points, Points2D=lambda points: points,
        Transform3D=lambda translation, mat3x3: translation, Pinhole=lambda **options: options,
    )  # fmt: skip
    monkeypatch.setitem(sys.modules, "rerun", fake)
    SOLUTION.to_rerun("scene", camera=EXAMPLE.camera, size=(1280, 960))
    assert len(logged["scene/points"]) == 200
    np.testing.assert_allclose(logged["scene/camera"], SOLUTION.centre)
    pinhole = logged["scene/camera/image"]
    assert (pinhole["focal_length"], pinhole["width"], pinhole["height"]) == (800.0, 1280, 960)
    np.testing.assert_allclose(pinhole["principal_point"], EXAMPLE.camera[:2, 2])
    np.testing.assert_allclose(logged["scene/camera/image/keypoints"], EXAMPLE.points2d, atol=1e-6)


def test_rerun_is_optional(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(ValueError, match="try pip install rerun-sdk"):
        SOLUTION.to_rerun()


def test_a_solution_without_a_pose_cannot_be_exported(tmp_path: Path) -> None:
    problem = problem_from(np.random.default_rng(0).normal(size=(8, 2)), EXAMPLE.points3d, None)
    with pytest.raises(ValueError, match="expected a solution with a pose to export, got none: a reason"):
        without_pose(problem, "a reason", None).to_colmap(tmp_path / "model")
    assert not (tmp_path / "model").exists()


def test_a_name_that_text_files_do_not_hold_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="expected a `name` without spaces, .* got 'a photo.jpg'"):
        SOLUTION.to_colmap(tmp_path / "model", name="a photo.jpg")
