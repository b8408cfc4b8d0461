import logging
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from planted_model import HEIGHT, WIDTH, plant_model

from bpnp.cameras import camera_models, colmap_camera
from bpnp.datamodules.colmap.model_files import ModelRecords, read_records
from bpnp.datamodules.colmap.reconstruction import read_reconstruction

pytestmark = pytest.mark.slow

FISHEYE = ("OPENCV_FISHEYE", [300.0, 310.0, 400.0, 300.0, 0.05, -0.02, 0.01, 0.001])
EXACT = ("name", "points2d", "seen", "clutter2d", "observed", "translation")
PARAMETERS = {
    "f": 450.0, "fx": 440.0, "fy": 460.0, "cx": 390.0, "cy": 310.0, "omega": 0.8, "alpha": 0.6, "beta": 1.1,
    "w": 4000.0, "h": 2000.0,
}  # fmt: skip


def equal(a, b) -> bool:
    """Return whether two reconstructions are equal, except for the name; pycolmap normalises rotations."""
    return np.array_equal(a.points3d, b.points3d) and all(
        all(np.array_equal(getattr(x, field), getattr(y, field)) for field in EXACT)
        and np.array_equal(x.camera.matrix, y.camera.matrix)
        and np.allclose(x.rotation, y.rotation, rtol=0, atol=1e-15)
        for x, y in zip(a.images, b.images, strict=True)
    )


@pytest.mark.parametrize("model", [name for name, _ in camera_models().values()])
def test_planted_points_come_back_through_every_camera_model(model: str, tmp_path: Path) -> None:
    """Keypoints are projections of known points, so undistorting them has to give x/z, y/z back."""
    info = pycolmap.Camera.create_from_model_name(1, model, 1.0, WIDTH, HEIGHT).params_info
    params = [PARAMETERS.get(name.strip(), 0.01) for name in info.split(",")]
    truth = plant_model(tmp_path, camera=(model, params))
    found = read_reconstruction(tmp_path)
    np.testing.assert_allclose(found.points3d, truth.points3d, atol=1e-15)
    for i, image in enumerate(found.images):
        assert image.name == f"photo {i}.jpg"
        np.testing.assert_array_equal(image.seen, truth.seen[i])
        np.testing.assert_allclose(image.points2d, truth.points2d[i], atol=1e-6)
        np.testing.assert_allclose(image.rotation, truth.rotations[i], atol=1e-12)
        np.testing.assert_allclose(image.translation, truth.translations[i], atol=1e-12)
        if model != "EQUIRECTANGULAR":  # which sees keypoints that have no x/z
            rays = np.column_stack([image.clutter2d, np.ones(12)]).astype(np.float64)
            np.testing.assert_allclose(colmap_camera(model, params).project(rays), truth.clutter_px[i], atol=1e-3)
        expected = {"f": 450, "fx": 450, "w": 4000 / (2 * np.pi)}[info.split(",")[0].strip()]
        assert image.camera.focal == pytest.approx(expected, rel=1e-6)
        (ahead,) = image.camera.project(np.array([[0.0, 0.0, 2.0]]))
        np.testing.assert_allclose(image.camera.matrix @ [0, 0, 1], [*ahead, 1])
        assert np.sqrt(np.linalg.det(image.camera.matrix)) == pytest.approx(expected, rel=0.01)


def editable(folder: Path, monkeypatch: pytest.MonkeyPatch) -> ModelRecords:
    """The content of the files of a model, to be changed before the model is read."""
    records = read_records(folder)
    copies = [replace(im, keypoints=im.keypoints.copy(), point_ids=im.point_ids.copy()) for im in records.images]
    records = replace(records, images=copies)
    monkeypatch.setattr("bpnp.datamodules.colmap.reconstruction.read_records", lambda _: records)
    return records


def test_keypoints_outside_the_field_of_view_are_dropped_and_counted(tmp_path: Path, monkeypatch, caplog) -> None:
    """At 300 pixels a radian a fisheye pixel 600 from the centre looks backwards: x/z means nothing."""
    plant_model(tmp_path, camera=FISHEYE, images=1)
    keypoints = editable(tmp_path, monkeypatch).images[0].keypoints
    keypoints[3] = 400.0 + 600.0, 300.0  # of a 3D point
    keypoints[-2] = 400.0, 300.0 - 600.0  # clutter
    with caplog.at_level(logging.WARNING):
        found = read_reconstruction(tmp_path)
    assert found.lost == {"keypoints that could not be undistorted": 2}
    assert "2 keypoints that could not be undistorted" in caplog.text
    assert (len(found.images[0].points2d), len(found.images[0].clutter2d)) == (39, 11)


def test_the_better_of_repeated_keypoints_is_kept(tmp_path: Path, monkeypatch) -> None:
    truth = plant_model(tmp_path, images=1)
    image = editable(tmp_path, monkeypatch).images[0]
    image.keypoints[-1], image.point_ids[-1] = image.keypoints[5], image.point_ids[5]
    image.keypoints[5] += 3.0
    found = read_reconstruction(tmp_path)
    assert found.lost == {"repeated keypoints": 1}
    np.testing.assert_array_equal(found.images[0].seen, truth.seen[0])
    np.testing.assert_allclose(found.images[0].points2d, truth.points2d[0], atol=1e-6)
    assert len(found.images[0].clutter2d) == 11


def test_bad_points_are_dropped_and_counted(tmp_path: Path, monkeypatch) -> None:
    """A NaN point leaves the scene, a point behind a camera leaves its matches, an unknown one is no clutter."""
    truth = plant_model(tmp_path, images=1)
    records = editable(tmp_path, monkeypatch)
    nan, behind, unknown = (np.flatnonzero(records.point_ids == seen + 1) for seen in truth.seen[0][:3])
    records.points3d[nan] = np.nan
    records.points3d[behind] = truth.rotations[0].T @ (np.array([0, 0, -1.0]) - truth.translations[0])
    records.point_ids[unknown] = 999_999
    found = read_reconstruction(tmp_path)
    assert found.lost == {
        "points that are not finite": 1,
        "keypoints of a point that is missing": 2,
        "matches with the point behind or in the camera": 1,
    }
    image = found.images[0]
    assert (len(found.points3d), len(image.seen), len(image.observed), len(image.clutter2d)) == (59, 37, 38, 12)
    np.testing.assert_allclose(image.points2d, truth.points2d[0][3:], atol=1e-6)


def test_an_image_with_a_broken_pose_is_skipped_and_counted(tmp_path: Path, monkeypatch) -> None:
    plant_model(tmp_path)
    images = editable(tmp_path, monkeypatch).images
    images[0].quaternion[:], images[2].quaternion[0] = 0, np.nan
    found = read_reconstruction(tmp_path)
    assert (len(found.images), found.lost) == (1, {"images with a broken pose": 2})


def test_poses_of_a_rig_are_those_of_the_images(tmp_path: Path) -> None:
    """COLMAP stores one pose a frame for all cameras of a rig; the reading must give cam_from_world of each camera."""
    rng = np.random.default_rng(0)

    def random_pose() -> pycolmap.Rigid3d:
        return pycolmap.Rigid3d(pycolmap.Rotation3d(rng.normal(size=3)), rng.normal(size=3))

    model, rig, frame = pycolmap.Reconstruction(), pycolmap.Rig(rig_id=1), pycolmap.Frame(frame_id=1, rig_id=1)
    for i in (1, 2):
        model.add_camera(pycolmap.Camera(camera_id=i, model="PINHOLE", width=9, height=9, params=[9.0, 9, 4, 4]))
    rig.add_ref_sensor(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, 1))
    rig.add_sensor(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, 2), random_pose())
    model.add_rig(rig)
    images = [pycolmap.Image(f"{i}.jpg", np.full((1, 2), 5.0), i, i) for i in (1, 2)]
    for image in images:
        image.frame_id = 1
        frame.add_data_id(image.data_id)
    frame.rig_from_world = random_pose()
    model.add_frame(frame)
    for image in images:
        model.add_image(image)
    model.register_frame(1)
    model.add_point3D(np.ones(3), pycolmap.Track([pycolmap.TrackElement(1, 0), pycolmap.TrackElement(2, 0)]))
    model.write_binary(tmp_path)
    for image in read_reconstruction(tmp_path).images:
        pose = model.find_image_with_name(image.name).cam_from_world()
        np.testing.assert_allclose(image.rotation, pose.rotation.matrix(), atol=1e-12)
        np.testing.assert_allclose(image.translation, pose.translation, atol=1e-12)


def test_zlib_works_after_pycolmap_was_imported(tmp_path: Path) -> None:
    """pycolmap before zlib makes both calls abort the process."""
    code = (
        "import bpnp.cameras, io, zlib, numpy\n"
        "bpnp.cameras.camera_models()\n"
        "zlib.compress(bytes(100_000)); numpy.savez_compressed(io.BytesIO(), a=numpy.arange(10_000))"
    )
    subprocess.run([sys.executable, "-c", code], check=True, cwd=Path(__file__).parents[2])


@pytest.mark.parametrize("scene", ["castle-P30", "sceaux_castle_txt", "statue_of_liberty", "walkthrough"])
def test_real_residuals_are_those_of_the_reconstruction(scene: str, shared_data: Path, tmp_path: Path) -> None:
    """Every problem's residual, sent back through the lens into pixels, is the one that pycolmap computes there."""
    folder = shared_data / "colmap" / scene / "sparse" / "0"
    model = pycolmap.Reconstruction(folder)
    ids = np.sort(np.fromiter(model.points3D, dtype=np.int64))
    found = read_reconstruction(folder)
    assert len(found.images) == model.num_reg_images()
    for image in found.images[::7]:
        expected = model.find_image_with_name(image.name)
        errors: dict[int, list[float]] = {}
        for keypoint in expected.get_observation_points2D():
            pixel = expected.project_point(model.point3D(keypoint.point3D_id).xyz)
            error = np.inf if pixel is None else float(np.linalg.norm(pixel - keypoint.xy))
            errors.setdefault(keypoint.point3D_id, []).append(error)
        assert 0 <= len(errors) - len(image.seen) <= 3
        points = found.points3d[image.seen] @ image.rotation.T + image.translation
        rays = np.column_stack([image.points2d, np.ones(len(image.points2d))]).astype(np.float64)
        residuals = np.linalg.norm(expected.camera.img_from_cam(points) - expected.camera.img_from_cam(rays), axis=-1)
        for point_id, residual in zip(ids[image.seen], residuals, strict=True):
            # pycolmap does not normalise the 6-digit quaternions of a text model: up to 0.003 pixels
            assert min(abs(error - residual) for error in errors[point_id]) < 5e-3
        assert np.median(residuals) < 2.0


@pytest.mark.parametrize("scene", ["fountain-P11", None])
def test_binary_and_text_give_the_same(scene: str | None, request, tmp_path: Path) -> None:
    if scene is None:
        plant_model(tmp_path / "binary")
    else:
        shutil.copytree(request.getfixturevalue("shared_data") / "colmap" / scene / "sparse" / "0", tmp_path / "binary")
    (tmp_path / "text").mkdir()
    pycolmap.Reconstruction(tmp_path / "binary").write_text(tmp_path / "text")
    assert equal(read_reconstruction(tmp_path / "binary"), read_reconstruction(tmp_path / "text"))
