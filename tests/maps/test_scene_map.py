"""Maps are read with the points, tracks and views that the model has, whichever its form."""

import shutil
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
from planted_model import OPENCV, Planted, plant_model

from bpnp import SceneMap
from bpnp.datamodules.colmap.reconstruction import read_reconstruction
from bpnp.maps import index, scene_map
from bpnp.maps.many_photos import read_views


@pytest.fixture(scope="module")
def planted(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Planted]:
    folder = tmp_path_factory.mktemp("map")
    return folder, plant_model(folder, images=4, points=60, seen=25, seed=3)


@pytest.mark.parametrize("text", [False, True])
def test_a_map_is_read_as_it_was_planted(tmp_path: Path, text: bool) -> None:
    truth = plant_model(tmp_path, images=4, points=60, seen=25, text=text)
    scene = SceneMap.from_colmap(tmp_path)
    seen = np.unique(np.concatenate(truth.seen))
    np.testing.assert_array_equal(scene.point_ids, seen + 1)  # pycolmap counts from 1
    np.testing.assert_allclose(scene.points3d, truth.points3d[seen])
    np.testing.assert_array_equal(scene.track_lengths, np.bincount(np.concatenate(truth.seen), minlength=60)[seen])
    assert [view.name for view in scene.views] == [f"photo {i}.jpg" for i in range(4)]
    for view, rotation, translation, points in zip(
        scene.views, truth.rotations, truth.translations, truth.seen, strict=True
    ):
        np.testing.assert_allclose(view.rotation, rotation, atol=1e-12)
        np.testing.assert_allclose(view.rotation @ view.centre + translation, 0, atol=1e-9)
        np.testing.assert_array_equal(scene.point_ids[view.points], points + 1)
        pixels = view.camera.project(truth.points3d[points] @ rotation.T + translation)
        assert np.isfinite(pixels).all()
        assert view.camera.focal == pytest.approx(np.mean(OPENCV[1][:2]))


def test_a_large_map_is_indexed_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("BPNP_CACHE", str(tmp_path / "cache"))
    folder = tmp_path / "model"
    truth = plant_model(folder, images=4, points=60, seen=25)
    files = sorted(folder.iterdir())
    SceneMap.from_colmap(folder)
    assert not (tmp_path / "cache").exists()
    monkeypatch.setattr(scene_map, "INDEXED_POINTS", 10)
    first = SceneMap.from_colmap(folder)
    assert sorted(folder.iterdir()) == files
    with monkeypatch.context() as without_model:
        without_model.setattr(scene_map, "read_reconstruction", None)
        again = SceneMap.from_colmap(folder)
    for name in ("points3d", "point_ids", "track_lengths"):
        np.testing.assert_array_equal(getattr(again, name), getattr(first, name))
    for one, other in ((again.pictures, first.pictures), (again.cones, first.cones)):
        for x, y in zip(one, other, strict=True):
            np.testing.assert_array_equal(x, y)
    for k, (view, as_read) in enumerate(zip(again.views, first.views, strict=True)):
        np.testing.assert_array_equal(view.points, as_read.points)
        np.testing.assert_allclose(view.rotation, truth.rotations[k], atol=1e-12)
        np.testing.assert_allclose(view.translation, truth.translations[k])
        assert (view.name, view.camera.focal) == (as_read.name, as_read.camera.focal)
    plant_model(folder, images=3, points=50, seen=20)  # another model in its place
    assert len(SceneMap.from_colmap(folder).views) == 3
    (kept,) = (tmp_path / "cache").rglob("*.npz")
    kept.write_bytes(kept.read_bytes()[:500])
    assert len(SceneMap.from_colmap(folder).views) == 3
    shutil.rmtree(tmp_path / "cache")
    (tmp_path / "cache").touch()  # where nothing can be written
    assert len(SceneMap.from_colmap(folder).views) == 3


def test_a_damaged_index_is_not_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Any damage of a file in the cache is noticed; the map is read from its model again."""
    monkeypatch.setenv("BPNP_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(scene_map, "INDEXED_POINTS", 10)
    truth = plant_model(tmp_path / "model", images=2, points=30, seen=25)
    SceneMap.from_colmap(tmp_path / "model")
    (file,) = (tmp_path / "cache").rglob("*.npz")
    whole, used = file.read_bytes(), 0
    for place in (*range(0, 200, 2), *range(len(whole) - 400, len(whole), 2)):
        file.write_bytes(whole[:place] + bytes([whole[place] ^ 0xFF]) + whole[place + 1 :])
        found = index.read_index(tmp_path / "model")
        if found is not None:
            np.testing.assert_allclose([view.rotation for view in found.views], truth.rotations, atol=1e-12)
            used += 1
    assert used < 150
    file.write_bytes(whole[: len(whole) // 2])
    assert len(SceneMap.from_colmap(tmp_path / "model").views) == 2
    assert file.read_bytes() == whole


def test_a_model_that_is_replaced_while_it_is_read_is_read_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("BPNP_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(scene_map, "INDEXED_POINTS", 10)
    folder = tmp_path / "model"
    plant_model(folder, images=4, points=60, seen=25)

    def read_and_replace(*arguments: Any, **options: Any) -> Any:
        model = read_reconstruction(*arguments, **options)
        plant_model(folder, images=3, points=50, seen=20)
        return model

    with monkeypatch.context() as replaced:
        replaced.setattr(scene_map, "read_reconstruction", read_and_replace)
        assert len(SceneMap.from_colmap(folder).views) == 4
    assert len(SceneMap.from_colmap(folder).views) == 3
    with monkeypatch.context() as without_model:
        without_model.setattr(scene_map, "read_reconstruction", None)
        assert len(SceneMap.from_colmap(folder).views) == 3


def test_one_of_several_processes_computes_the_index_of_a_large_map(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The other waits, and reads what the first one wrote."""
    monkeypatch.setenv("BPNP_CACHE", str(tmp_path / "cache"))
    model = tmp_path / "model"
    plant_model(model, images=4, points=60, seen=25)
    scene, stamp = SceneMap.from_colmap(model), index.model_stamp(model)
    parts = scene.points3d, scene.point_ids, scene.track_lengths, scene.views, scene.pictures, scene.cones
    begun, computed = threading.Event(), list[int]()

    def compute(number: int) -> index.Index:
        begun.set()
        time.sleep(0.3)
        computed.append(number)
        return index.Index(*parts)

    with ThreadPoolExecutor() as pool:  # a lock of a file holds threads apart as it does processes
        first = pool.submit(index.make_index, model, stamp, lambda: compute(1))
        begun.wait()
        second = pool.submit(index.make_index, model, stamp, lambda: compute(2))
        np.testing.assert_array_equal(second.result().points3d, first.result().points3d)
    assert computed == [1]


def test_a_map_without_a_view_lacks_the_points_that_only_it_saw(planted: tuple[Path, Planted]) -> None:
    scene, truth = SceneMap.from_colmap(planted[0]), planted[1]
    rest = scene.without(["photo 1.jpg"])
    others = np.bincount(np.concatenate([seen for i, seen in enumerate(truth.seen) if i != 1]), minlength=60)
    kept = np.flatnonzero(others >= 2)
    np.testing.assert_array_equal(rest.point_ids, kept + 1)
    np.testing.assert_array_equal(rest.track_lengths, others[kept])
    np.testing.assert_array_equal(rest.point_ids[rest.views[1].points] - 1, np.intersect1d(truth.seen[2], kept))
    assert [view.name for view in rest.views] == ["photo 0.jpg", "photo 2.jpg", "photo 3.jpg"]
    assert len(scene.views) == 4


def test_a_file_of_retrieved_views_is_read_and_wrong_lines_named(tmp_path: Path) -> None:
    path = tmp_path / "pairs.txt"
    path.write_text("q1.jpg db/a.jpg\nq2.jpg db/b.jpg\n\nq1.jpg db/c.jpg\n")
    assert read_views(path) == {"q1.jpg": ["db/a.jpg", "db/c.jpg"], "q2.jpg": ["db/b.jpg"]}
    path.write_text("q1.jpg db/a.jpg 0.3\n")
    with pytest.raises(ValueError, match=r"line 1 of .* is 'q1.jpg db/a.jpg 0.3'; a line has two names without spaces"):
        read_views(path)
    with pytest.raises(ValueError, match="--views needs a text file of lines `photo view`"):
        read_views(tmp_path / "none.txt")


def test_a_map_without_views_is_one_clear_error(tmp_path: Path) -> None:
    plant_model(tmp_path, seen=0)
    with pytest.raises(ValueError, match="no view of .* sees a point"):
        SceneMap.from_colmap(tmp_path)


def test_a_real_map_is_that_of_pycolmap(shared_data: Path) -> None:
    folder = shared_data / "colmap/fountain-P11/sparse/0"
    scene, model = SceneMap.from_colmap(folder), pycolmap.Reconstruction(folder)
    assert len(scene.points3d) == model.num_points3D()
    assert {view.name for view in scene.views} == {image.name for image in model.images.values()}
    by_id = dict(zip(scene.point_ids.tolist(), zip(scene.points3d, scene.track_lengths, strict=True), strict=True))
    for number, point in model.points3D.items():
        np.testing.assert_array_equal(by_id[number][0], point.xyz)
        assert by_id[number][1] == len({element.image_id for element in point.track.elements})
    for image in model.images.values():
        (view,) = scene.named([image.name])
        np.testing.assert_allclose(view.centre, image.projection_center(), atol=1e-9)
        seen = {point.point3D_id for point in image.points2D if point.has_point3D()}
        assert set(scene.point_ids[view.points].tolist()) == seen


def test_a_reconstruction_of_pycolmap_is_a_map_without_an_index(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("BPNP_CACHE", str(tmp_path / "cache"))
    plant_model(tmp_path, images=4, points=60, seen=25)
    expected = SceneMap.from_colmap(tmp_path)
    monkeypatch.setattr(scene_map, "INDEXED_POINTS", 10)
    scene = SceneMap.from_colmap(pycolmap.Reconstruction(str(tmp_path)))
    assert not (tmp_path / "cache").exists()
    np.testing.assert_array_equal(scene.points3d, expected.points3d)
    np.testing.assert_array_equal(scene.point_ids, expected.point_ids)
    for view, other in zip(scene.views, expected.views, strict=True):
        assert view.name == other.name
        np.testing.assert_allclose(view.rotation, other.rotation, atol=1e-12)
        np.testing.assert_array_equal(view.points, other.points)
