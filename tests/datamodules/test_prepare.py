"""Preparing data sets: every form of the same data gives the same store, and no kill leaves a wrong one."""

import itertools
import multiprocessing
import os
import shutil
import signal
import time
import zlib
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
import torch
import trimesh
from planted_model import plant_model
from small_data import check_pairs

from bpnp.cli import main
from bpnp.datamodules import ColmapDataModule, MeshDataModule, Outliers
from bpnp.datamodules.clouds import open_shapes
from bpnp.datamodules.colmap.module import colmap_recipe
from bpnp.datamodules.meshes import POINTS, SURFACES, surfaces_recipe
from bpnp.datamodules.shapes import normalise, read_mesh, sample_surface, shape_files
from bpnp.datamodules.store import JobResult, Recipe, Store, StoreError, is_store, open_store, prepare

pytestmark = pytest.mark.slow

BAD = {
    "train/cut": "OFF\n3 1 0\n0 0 0\n1 0 0\n",
    "train/empty": "",
    "test/foreign": "<html></html>",
    "train/flat": "OFF\n3 1 0\n0 0 0\n0 0 0\n0 0 0\n3 0 1 2\n",
    "train/hole": "OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 7\n",
    "test/nan": "OFF\n3 1 0\n0 0 nan\n1 0 0\n0 1 0\n3 0 1 2\n",
    "test/nofaces": "OFF\n3 0 0\n0 0 0\n1 0 0\n0 1 0\n",
}


@pytest.fixture
def meshes(tmp_path: Path) -> Path:
    """ModelNet40's layout: 12 good boxes, half of them with the counts on the header line, and 7 bad files."""
    root = tmp_path / "ModelNet40"
    for i in range(12):
        path = root / f"box{i % 2}" / ("test" if i % 3 == 2 else "train") / f"box{i % 2}_{i:04d}.off"
        path.parent.mkdir(parents=True, exist_ok=True)
        text = trimesh.creation.box((1, 2, 3 + i)).export(file_type="off")
        path.write_text(text.replace("OFF\n", "OFF", 1) if i % 4 < 2 else text)
    for name, content in BAD.items():
        (root / f"box0/{name}.off").write_text(content)
    return root


def run(source: Path, output: Path, **changes: object) -> Store:
    options = {"points": 32, "normalisation": "unit_sphere", "processes": 1} | changes
    processes = options.pop("processes")
    return prepare(surfaces_recipe(open_shapes(source), label=str(source), **options), output, processes=processes)


def check_same_bytes(store: Path, expected: Path) -> None:
    for path in expected.iterdir():
        assert (store / path.name).read_bytes() == path.read_bytes()


def names(store: Store) -> list[str]:
    return [store.name(row) for row in range(len(store))]


def check(store: Store, root: Path) -> None:
    """Samples of each mesh, by its name, training meshes first; the bad ones are listed."""
    assert {name.removeprefix("box0/") for name in store.skipped} == set(BAD)
    splits = [name.split("/")[1] for name in names(store)]
    assert splits == ["train"] * 8 + ["test"] * 4
    for row, name in enumerate(names(store)):
        mesh = read_mesh(root / f"{name}.off")
        rng = np.random.default_rng(zlib.crc32(name.encode()))
        samples = normalise(sample_surface(mesh, 32, rng), "unit_sphere")
        np.testing.assert_array_equal(store.row(row)[POINTS], samples.astype("f4"))
        assert store.columns["radius"][row] == pytest.approx(1)


@pytest.mark.parametrize("form", ["folder", "parent", "folder in capitals"])
def test_every_form_of_the_meshes_gives_the_same_store(meshes: Path, tmp_path: Path, form: str) -> None:
    """Folders `train` and `Train` give the same splits, and the data module opens them."""
    source = meshes.parent if form == "parent" else meshes
    if form == "folder in capitals":
        source = shutil.copytree(meshes, tmp_path / "capitals")
        for split in [*source.glob("*/train"), *source.glob("*/test")]:
            split.rename(split.with_name(split.name.upper()))
    prepared = run(source, tmp_path / "out" / "store")
    assert len(prepared) == 12
    check(prepared, meshes)
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["store"]
    data = MeshDataModule(str(prepared.folder), num_points=16, pool_size=32, train_problems=8, val_fraction=0.2)
    data.setup()
    assert (len(data.datasets["train"].source.rows), len(data.datasets["test"])) == (6, 4)


@pytest.mark.parametrize(("step", "lines"), [(6.0, [2, 4, 6, 8, 10, 12, 14, 16, 18, 19]), (0.01, [])])
def test_progress_lines_end_with_the_last_part(
    step: float, lines: list[int], meshes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    """Where there is no terminal, a line is printed at most every 10 seconds."""
    monkeypatch.setattr("bpnp.datamodules.meshes.MESHES_A_PART", 1)
    monkeypatch.setattr("bpnp.datamodules.store.time", Mock(monotonic=Mock(side_effect=itertools.count(0.0, step))))
    run(meshes, tmp_path / "store")
    assert capsys.readouterr().err.splitlines() == [f"reading {meshes}: {k} of 19" for k in lines]


def test_two_folders_of_one_split_are_refused(meshes: Path, tmp_path: Path) -> None:
    """Of two files of one name, the shape of one would be missing without a word."""
    source = shutil.copytree(meshes, tmp_path / "both")
    train = next(source.glob("*/train"))
    shutil.copytree(train, train.with_name("Train"))
    if len([*train.parent.glob("*")]) < 3:
        pytest.skip("the file system does not distinguish `train` from `Train`")
    with pytest.raises(ValueError, match=rf"Train and .*train are both the folder {train.parent.name}/train; move"):
        shape_files(source)


def test_several_processes_give_the_same_bytes(
    meshes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:  # fmt: skip
    run(meshes, tmp_path / "one")
    monkeypatch.setattr("bpnp.datamodules.meshes.MESHES_A_PART", 1)
    run(meshes, tmp_path / "two", processes=2)
    check_same_bytes(tmp_path / "two", tmp_path / "one")


def test_the_data_module_reads_the_store(meshes: Path, tmp_path: Path) -> None:
    run(meshes, tmp_path / "store")
    options = {"num_points": 16, "pool_size": 32}
    prepared = MeshDataModule(str(tmp_path / "store"), test_outliers=Outliers(ratio=0.5), eval_batch_size=4, **options)
    prepared.setup("test")
    (batch,) = prepared.test_dataloader()
    assert batch.points2d.shape == (4, 24, 2)
    assert ((batch.match3d >= 0).sum(-1) == 16).all()
    with pytest.raises(StoreError, match="pool_size.*--points 64"):
        MeshDataModule(str(tmp_path / "store"), num_points=16, pool_size=64).setup("test")
    with pytest.raises(StoreError, match="unit_cube.*unit_sphere"):
        MeshDataModule(str(tmp_path / "store"), **options, normalisation="unit_cube").setup("test")


def test_unusable_sources_are_named(meshes: Path, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "ModelNet40.zip").write_bytes(b"an archive")
    for name in ("empty", "ModelNet40.zip", "nowhere"):
        with pytest.raises(ValueError, match=name):
            run(tmp_path / name, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_preparing_again_keeps_the_store_and_other_options_are_refused(meshes: Path, tmp_path: Path) -> None:
    run(meshes, tmp_path / "store")
    before = (tmp_path / "store" / "manifest.json").stat().st_mtime_ns
    assert len(run(meshes, tmp_path / "store")) == 12
    assert (tmp_path / "store" / "manifest.json").stat().st_mtime_ns == before
    with pytest.raises(StoreError, match="another points"):
        run(meshes, tmp_path / "store", points=16)
    with pytest.raises(StoreError, match="no store of bpnp"):
        run(meshes, tmp_path / "ModelNet40")


@pytest.mark.nightly
def test_a_kill_at_any_time_leaves_no_wrong_store(
    meshes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("bpnp.datamodules.meshes.MESHES_A_PART", 2)

    def work(output: str = "store") -> None:
        run(meshes, tmp_path / output)

    work("first")  # imports what it needs
    start = time.perf_counter()
    work("whole")
    duration = time.perf_counter() - start
    rng = np.random.default_rng(0)
    ended = 0
    for _ in range(24):
        process = multiprocessing.get_context("fork").Process(target=work)
        process.start()
        time.sleep(rng.uniform(0, 1.2 * duration))
        process.kill()
        process.join()
        ended += process.exitcode == 0
        if not (tmp_path / "store").exists():
            continue
        check_same_bytes(tmp_path / "store", tmp_path / "whole")
        shutil.rmtree(tmp_path / "store")
    assert ended < 24
    work()
    assert is_store(tmp_path / "store")
    assert {path.name for path in tmp_path.iterdir() if "unfinished" in path.name} == set()


def test_ctrl_c_reports_that_nothing_was_written(
    meshes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("bpnp.datamodules.shapes.sample_surface", Mock(side_effect=KeyboardInterrupt))
    with pytest.raises(SystemExit) as ended:
        main(["prepare", "modelnet40", str(meshes), "--output", str(tmp_path / "store"), "--processes", "1"])
    assert ended.value.code == 130
    assert "bpnp: interrupted; nothing was written, run it again" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["ModelNet40"]


def test_folders_of_the_user_near_the_store_are_kept(meshes: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    mine = [out / ".store.2024-notes" / "a.txt", out / ".store.unfinished" / "b.txt", out / ".store.1" / "c.txt"]
    for file in mine:
        file.parent.mkdir(parents=True)
        file.write_text("mine")
    run(meshes, out / "store")
    assert [file.read_text() for file in mine] == ["mine"] * 3
    assert sorted(path.name for path in out.iterdir()) == sorted([*(file.parent.name for file in mine), "store"])


def test_a_folder_of_folders_gives_the_shapes_of_all(meshes: Path, tmp_path: Path) -> None:
    both = tmp_path / "both"
    shutil.copytree(meshes, both / "A")
    shutil.copytree(meshes, both / "B")
    (both / "C").mkdir()
    store = run(both, tmp_path / "store")
    splits = [name.split("/")[2] for name in names(store)]
    assert splits == ["train"] * 16 + ["test"] * 8
    assert {name.split("/")[0] for name in names(store)} == {"A", "B"}
    first = next(row for row, name in enumerate(names(store)) if name.startswith("B/"))
    mesh = read_mesh(both / f"{names(store)[first]}.off")
    high, low = mesh.vertices.max(0), mesh.vertices.min(0)
    spread = store.row(first)[POINTS].max(0) - store.row(first)[POINTS].min(0)
    assert spread / spread[2] == pytest.approx((high - low) / (high - low)[2], rel=0.2)


def test_files_of_one_stem_are_shapes_of_their_own(tmp_path: Path) -> None:
    folder = tmp_path / "data" / "box" / "train"
    folder.mkdir(parents=True)
    for suffix, size in (("off", 1), ("obj", 2), ("ply", 3)):
        trimesh.creation.box((1, 2, 3 + size)).export(folder / f"a.{suffix}")
    trimesh.creation.box((1, 2, 3)).export(folder / "b.off")
    samplers = open_shapes(tmp_path / "data").samplers
    assert list(samplers) == ["box/train/a.obj", "box/train/a.off", "box/train/a.ply", "box/train/b"]
    heights = [np.ptp(make(4000)[:, 2]) for make in samplers.values()]
    assert heights == pytest.approx([5, 4, 6, 3], abs=0.05)


@pytest.mark.nightly
def test_a_worker_that_is_killed_is_one_error(meshes: Path, tmp_path: Path) -> None:
    """End this process like the system ends one that takes too much memory."""
    recipe = Recipe("toy", {"points": 3}, {}, [(os.getpid(),)] * 4, end_worker, "mesh", "here")
    with pytest.raises(OSError, match="a process that was reading here ended, .* try fewer --processes"):
        prepare(recipe, tmp_path / "store", processes=2)
    assert not (tmp_path / "store").exists()


def end_worker(parent: int) -> JobResult:
    assert os.getpid() != parent
    os.kill(os.getpid(), signal.SIGKILL)
    return [], {}


def scenes(root: Path, count: int) -> None:
    for i in range(count):
        plant_model(root / f"{i:04d}" / "sparse" / "manhattan" / "0", seen=30 + i, seed=i)


def test_stored_colmap_problems_equal_those_of_the_models(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scenes(tmp_path / "MegaDepth_v1_SfM", 6)
    broken = tmp_path / "MegaDepth_v1_SfM" / "0003" / "sparse" / "manhattan" / "0" / "points3D.bin"
    broken.write_bytes(broken.read_bytes()[:-9])
    arguments = [str(tmp_path / "MegaDepth_v1_SfM"), "--output", str(tmp_path / "store"), "--clutter", "0.5"]
    main(["prepare", "megadepth", *arguments, "--processes", "1", "--min-points", "31"])
    assert "4 scenes, 12 images" in capsys.readouterr().out
    (tmp_path / "test.txt").write_text("0005\n\n0001\n")
    options = {"test_scenes": str(tmp_path / "test.txt"), "clutter": 0.4, "eval_max_points": 32, "min_points": 31}
    batches = []
    for root in (tmp_path / "MegaDepth_v1_SfM", tmp_path / "store"):
        module = ColmapDataModule(str(root), **options)
        module.setup("test")
        batches.append(next(iter(module.test_dataloader())))
    order = [sorted(range(6), key=lambda i, ids=batch.ids: ids[i]) for batch in batches]
    for name in ("rotation", "translation", "focal", "mask2d", "mask3d"):
        anew, stored = (getattr(batch, name)[rows] for batch, rows in zip(batches, order, strict=True))
        torch.testing.assert_close(stored, anew)
    stored = batches[1]
    assert sorted((stored.match3d >= 0).sum(-1).tolist()) == [31, 31, 31, 32, 32, 32]
    check_pairs(stored, 2e-5)
    assert set(open_store(tmp_path / "store", "problems").skipped) == {"0003", "0000"}
    with pytest.raises(StoreError, match="clutter.*0.5.*--clutter 0.6"):
        ColmapDataModule(str(tmp_path / "store"), **(options | {"clutter": 0.6})).setup("test")
    with pytest.raises(ValueError, match="nothing.txt"):
        ColmapDataModule(str(tmp_path / "store"), val_scenes=str(tmp_path / "nothing.txt"))


def test_no_usable_model_is_one_error(tmp_path: Path) -> None:
    scenes(tmp_path / "scenes", 1)
    with pytest.raises(StoreError, match="no usable image.*min_points"):
        prepare(colmap_recipe(tmp_path / "scenes", min_points=50, clutter=0.0), tmp_path / "store")
    assert not (tmp_path / "store").exists()


def module(meshes: Path, cache: Path) -> MeshDataModule:
    data = MeshDataModule(str(meshes), num_points=16, pool_size=32, cache_dir=str(cache), val_fraction=0.2)
    with pytest.warns(UserWarning, match="left out 7 of 19, all listed in .*manifest.json"):
        data.setup()
    return data


def test_meshes_that_were_not_prepared_are_sampled_into_the_cache_once(
    meshes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    counted = Mock(side_effect=sample_surface)
    monkeypatch.setattr("bpnp.datamodules.shapes.sample_surface", counted)
    module(meshes, tmp_path / "cache")
    (folder,) = (tmp_path / "cache").iterdir()
    check(open_store(folder, SURFACES), meshes)
    module(meshes, tmp_path / "cache")
    assert counted.call_count == 12
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    for name in ("points.npy", "manifest.json"):
        damaged = bytearray(before[name])
        damaged[-1] ^= 1
        (folder / name).write_bytes(damaged)
        with pytest.warns(UserWarning, match=rf"the cached store {folder} is damaged .*; making it again"):
            module(meshes, tmp_path / "cache")
        assert {path.name: path.read_bytes() for path in folder.iterdir()} == before
    assert counted.call_count == 3 * 12


def test_the_cache_is_the_users_wherever_the_work_is(
    meshes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    options = {"num_points": 16, "pool_size": 32, "train_shapes": 3, "val_shapes": 3}
    for variable, folder in (("XDG_CACHE_HOME", "a/bpnp"), ("BPNP_CACHE", "b")):
        monkeypatch.setenv(variable, str(tmp_path / folder.split("/")[0]))
        for place in ("x", "y"):
            (tmp_path / place).mkdir(exist_ok=True)
            monkeypatch.chdir(tmp_path / place)
            MeshDataModule(**options).setup("validate")
            assert list((tmp_path / place).iterdir()) == []
        assert len(list((tmp_path / folder).iterdir())) == 1


def test_two_processes_may_make_one_cache_at_once(meshes: Path, tmp_path: Path) -> None:
    context = multiprocessing.get_context("fork")
    children = [context.Process(target=module, args=(meshes, tmp_path / "cache")) for _ in range(2)]
    for child in children:
        child.start()
    for child in children:
        child.join()
    assert [child.exitcode for child in children] == [0, 0]
    assert len(list((tmp_path / "cache").iterdir())) == 1


def test_a_cache_that_another_process_has_just_made_is_taken(
    meshes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    module(meshes, tmp_path / "cache")
    (made,) = (tmp_path / "cache").iterdir()
    first, looks = made.stat().st_ino, iter([False])
    monkeypatch.setattr("bpnp.datamodules.store.is_store", lambda folder: next(looks, True))
    module(meshes, tmp_path / "cache")
    assert made.stat().st_ino == first
