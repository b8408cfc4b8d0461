"""Point clouds in ModelNet's layouts: fixed or sampled points of the files, and errors that name the file."""

import os
from pathlib import Path
from typing import Literal

import h5py
import numpy as np
import pytest
import trimesh

from bpnp.datamodules.clouds import draw_points, is_cloud, open_shapes, read_cloud
from bpnp.datamodules.meshes import SURFACES, MeshDataModule
from bpnp.datamodules.shapes import MeshError, normalise
from bpnp.datamodules.store import StoreError, open_store

SIZES = (40, 40, 50, 40, 60, 40)


def points(seed: int, count: int = 40) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(count, 3)).astype(np.float32)


def write(path: Path, values: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".ply":
        trimesh.PointCloud(values).export(path)
    elif path.suffix == ".npy":
        np.save(path, np.hstack([values, values]))  # x, y, z and normals
    elif path.suffix == ".txt":
        np.savetxt(path, np.hstack([values, values]), delimiter=",")
    else:
        np.savetxt(path, values, header="x y z")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Six clouds of four formats and two classes; 40 to 60 points."""
    for i, size in enumerate(SIZES):
        suffix = (".ply", ".npy", ".txt", ".xyz")[i % 4]
        write(tmp_path / "clouds" / f"c{i % 2}" / ("train" if i < 4 else "test") / f"s{i}{suffix}", points(i, size))
    return tmp_path / "clouds"


def module(root: Path, **options) -> MeshDataModule:
    known = {"num_points": 40, "pool_size": 40, "normalisation": "none", "train_problems": 12, "val_fraction": 0.25}
    return MeshDataModule(str(root), cache_dir=str(root.parent / "cache"), **(known | options))


@pytest.mark.parametrize("suffix", [".ply", ".npy", ".txt", ".xyz"])
def test_every_format_gives_the_points_of_its_file(tmp_path: Path, suffix: str) -> None:
    write(tmp_path / f"a{suffix}", points(0))
    assert is_cloud(tmp_path / f"a{suffix}")
    np.testing.assert_allclose(read_cloud(tmp_path / f"a{suffix}"), points(0), atol=1e-6)


def test_a_ply_with_faces_is_a_mesh_and_its_surface_is_sampled(tmp_path: Path) -> None:
    for split in ("train", "test"):
        path = tmp_path / "meshes" / "box" / split / "a.ply"
        path.parent.mkdir(parents=True)
        trimesh.creation.box((2, 2, 2)).export(path)
    assert not is_cloud(path)
    samples = open_shapes(tmp_path / "meshes").samplers["box/test/a"](100)
    np.testing.assert_allclose(np.abs(samples).max(-1), 1, atol=1e-6)
    assert len(np.unique(samples, axis=0)) == 100  # not the 8 corners


XYZ = b"property float x\nproperty float y\nproperty float z\n"


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("empty.xyz", b""),
        ("words.txt", b"a b c\n"),
        ("two.xyz", b"1 2\n3 4\n"),
        ("nan.xyz", b"1 2 nan\n"),
        ("cut.npy", b"\x93NUMPY\x01\x00"),
        ("cut.ply", b"ply\nformat ascii 1.0\nelement vertex 3\n" + XYZ + b"end_header\n1 2 3\n4 5 6\n"),
        ("within.ply", b"ply\nformat ascii 1.0\nelement vertex 2\n" + XYZ + b"end_header\n1 2 3\n4 5"),
        ("none.ply", b"ply\nformat ascii 1.0\nelement vertex 0\nend_header\n"),
    ],
)
def test_a_file_that_is_no_cloud_is_one_error_with_its_name(tmp_path: Path, name: str, content: bytes) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(MeshError, match=name):
        read_cloud(tmp_path / name)


def test_file_names_that_are_not_utf8_are_escaped(folder: Path) -> None:
    name = folder / "c0" / "train" / os.fsdecode(b"caf\xe9")
    write(name.with_suffix(".xyz"), points(7))
    name.with_suffix(".off").write_text(trimesh.creation.box().export(file_type="off"), encoding="utf-8")
    module(folder).setup("fit")
    (cache,) = (folder.parent / "cache").iterdir()
    store = open_store(cache, SURFACES)
    assert [store.name(i) for i in range(2)] == [r"c0/train/caf\udce9.off", r"c0/train/caf\udce9.xyz"]


@pytest.mark.parametrize("mode", ["unit_sphere", "unit_cube"])
def test_points_without_extent_have_no_unit_frame(mode: Literal["unit_sphere", "unit_cube"]) -> None:
    """They would all become NaN; in the units of the file they stay."""
    same = np.full((5, 3), 2.0)
    with pytest.raises(MeshError, match="all 5 points coincide at"):
        normalise(same, mode)
    np.testing.assert_array_equal(normalise(same, "none"), same)


def test_a_pool_as_large_as_a_problem_gives_the_same_points_in_every_view(folder: Path) -> None:
    """The paper's fixed points: 1,000 of the 1,024 of a file, the same in every problem of the shape."""
    data = module(folder, num_points=30, pool_size=30)
    data.setup("fit")
    views = [data.datasets["train"].problem(i) for i in range(12)]
    by_shape = {}
    for view in views:
        cloud = {tuple(p) for p in view.points3d[0].tolist()}
        assert by_shape.setdefault(view.ids[0].partition("#")[0], cloud) == cloud
        rows = points(int(view.ids[0].partition("#")[0][-1]), SIZES[int(view.ids[0].partition("#")[0][-1])])
        assert all(np.abs(rows - p).max(1).min() < 1e-6 for p in np.array(sorted(cloud)))
    assert len(by_shape) == 3


def test_each_problem_draws_its_own_points_from_a_larger_pool(folder: Path) -> None:
    data = module(folder, num_points=30, pool_size=2048)
    data.setup("fit")
    data.setup("test")
    drawn = [data.datasets["train"].problem(i) for i in (0, 3, 6, 9)]  # views of one shape
    assert len({view.ids[0].partition("#")[0] for view in drawn}) == 1
    sets = [{tuple(p) for p in view.points3d[0].tolist()} for view in drawn]
    assert all(len(one) == 30 for one in sets)
    assert sets[0] != sets[1]
    number = int(drawn[0].ids[0].partition("#")[0][-1])
    assert 30 < len(set.union(*sets)) <= SIZES[number]
    # shapes of 60 and 40 points in one batch: each is what it is alone
    together = data.datasets["test"][[(0, 0), (0, 1)]]
    for i in range(2):
        assert together.points3d[i].equal(data.datasets["test"].problem(i).points3d[0])


def test_a_shape_with_too_few_points_is_one_error(folder: Path) -> None:
    with pytest.raises(StoreError, match=r"c\d/(train|test)/s\d in .* has 40 points, fewer than `num_points` 45"):
        module(folder, num_points=45, pool_size=64).setup("fit")


def test_the_order_of_drawn_points_depends_on_the_name_alone() -> None:
    cloud = np.arange(300.0).reshape(100, 3)
    first = draw_points(cloud, 20, "a")
    assert (first == draw_points(cloud, 60, "a")[:20]).all()  # a larger pool begins with the same points
    assert (first != draw_points(cloud, 20, "b")).any()
    assert len(draw_points(cloud, 500, "a")) == 100


def test_the_hdf5_archive_of_modelnet40(tmp_path: Path) -> None:
    root = tmp_path / "modelnet40_ply_hdf5_2048"
    root.mkdir()
    (root / "shape_names.txt").write_text("airplane\nbathtub\n")
    for split, count in (("train", 4), ("test", 2)):
        with h5py.File(root / f"ply_data_{split}0.h5", "w") as file:
            file["data"] = np.stack([points(i) for i in range(count)])
            file["label"] = np.array([[i % 2] for i in range(count)], np.uint8)
    shapes = open_shapes(root)
    assert list(shapes.samplers)[:2] == ["airplane/train/ply_data_train0_0000", "bathtub/train/ply_data_train0_0001"]
    samples = shapes.samplers["bathtub/test/ply_data_test0_0001"](40)
    np.testing.assert_allclose(np.sort(samples, axis=0), np.sort(points(1), axis=0), atol=1e-6)
    data = module(root)
    data.setup("test")
    assert len(data.datasets["test"]) == 2


WRONG_LABELS = [[0, 1], [0, 1, 0, 1], [0.0, 1.0, 0.0], [0, 1, -1], None]


@pytest.mark.parametrize("labels", WRONG_LABELS, ids=["few", "many", "floats", "negative", "none"])
def test_labels_that_do_not_fit_the_shapes_of_an_hdf5_file_are_one_error(tmp_path: Path, labels: list | None) -> None:
    """With fewer labels than shapes, the last shapes would be left out without a word."""
    with h5py.File(tmp_path / "ply_data_test0.h5", "w") as file:
        file["label" if labels is None else "data"] = np.zeros((3, 40, 3), np.float32)
        if labels is not None:
            file["label"] = np.array(labels)
    with pytest.raises(ValueError, match=r"ply_data_test0\.h5 (has \d labels of type|is not a file of ModelNet40's)"):
        open_shapes(tmp_path)


def test_the_normal_resampled_archive_of_modelnet40(tmp_path: Path) -> None:
    root = tmp_path / "modelnet40_normal_resampled"
    for i, name in enumerate(["night_stand_0001", "night_stand_0002", "chair_0001"]):
        write(root / name.rpartition("_")[0] / f"{name}.txt", points(i))
    (root / "modelnet40_train.txt").write_text("night_stand_0001\nchair_0001\n")
    (root / "modelnet40_test.txt").write_text("night_stand_0002\n")
    shapes = open_shapes(tmp_path)
    assert list(shapes.samplers) == [
        "chair/train/chair_0001",
        "night_stand/train/night_stand_0001",
        "night_stand/test/night_stand_0002",
    ]
    samples = shapes.samplers["night_stand/test/night_stand_0002"](40)
    np.testing.assert_allclose(np.sort(samples, axis=0), np.sort(points(1), axis=0), atol=1e-6)


def test_a_class_of_two_words_is_one_class(tmp_path: Path) -> None:
    (tmp_path / "shape_names.txt").write_text("flower pot\nlamp\n")
    with h5py.File(tmp_path / "ply_data_train0.h5", "w") as file:
        file["data"], file["label"] = points(0)[None], np.array([[1]], np.uint8)
    assert list(open_shapes(tmp_path).samplers) == ["lamp/train/ply_data_train0_0000"]


def test_a_listed_file_of_the_normal_resampled_archive_that_is_missing_is_named(tmp_path: Path) -> None:
    root = tmp_path / "modelnet40_normal_resampled"
    for i in range(3):
        write(root / "chair" / f"chair_000{i}.txt", points(i))
    (root / "modelnet40_train.txt").write_text("chair_0000\nchair_0001\ndesk_0001\n")
    (root / "modelnet40_test.txt").write_text("chair_0002\n")
    with pytest.warns(UserWarning, match=r"left out 1 of 4, .*desk_0001\.txt"):
        module(root).prepare_data()
