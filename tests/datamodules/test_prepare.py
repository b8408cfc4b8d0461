"""Preparing data sets: every form of the same data gives the same store, and no kill leaves a wrong one."""

import os
import shutil
import signal
import time
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from planted_model import plant_model

from bpnp.cli import main
from bpnp.datamodules import ColmapDataModule, MeshDataModule
from bpnp.datamodules import prepare as preparing
from bpnp.datamodules.manifest import StoreError, is_store
from bpnp.datamodules.meshes.folder import folder_pools
from bpnp.datamodules.meshes.surface_store import SurfaceStore, open_surfaces, write_surfaces
from bpnp.datamodules.outliers import Outliers
from bpnp.datamodules.pair_store import PairStore
from bpnp.datamodules.prepare import Prepared, prepare_colmap, prepare_meshes

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


def run(source: Path, output: Path, **changes: object) -> Prepared:
    options = {"points": 32, "normalisation": "unit_sphere", "processes": 1} | changes
    return prepare_meshes(source, output, **options)


def zipped(root: Path) -> Path:
    path = root.with_suffix(".zip")
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for file in sorted(root.rglob("*.off")):
            archive.write(file, Path("ModelNet40") / file.relative_to(root))
            archive.writestr(f"__MACOSX/ModelNet40/{file.relative_to(root).parent}/._{file.name}", b"junk")
        archive.writestr("ModelNet40/README.txt", "read me")
    return path


def check(store: SurfaceStore, root: Path, tmp_path: Path) -> None:
    """The store holds what the folder of meshes gives when it is read without preparing it."""
    assert {name.removeprefix("box0/") for name in store.skipped} == set(BAD)
    for split, count in (("train", 8), ("test", 4)):
        with pytest.warns(UserWarning, match="left out"):
            pools = folder_pools(
                root, split, pool_size=32, normalisation="unit_sphere", cache_dir=tmp_path / "cache"
            )  # fmt: skip
        ours = store.pools(split, pool_size=32)
        assert ours.names == pools.names
        assert len(ours) == count
        assert np.array_equal(ours.points, pools.points)
        assert ours.radius == pytest.approx(pools.radius)


@pytest.mark.parametrize("form", ["folder", "parent", "zip"])
def test_every_form_of_the_meshes_gives_the_same_store(meshes: Path, tmp_path: Path, form: str) -> None:
    source = {"folder": lambda: meshes, "parent": lambda: meshes.parent, "zip": lambda: zipped(meshes)}[form]()
    prepared = run(source, tmp_path / "out" / "store")
    assert prepared.counts == {"train": 8, "test": 4}
    check(open_surfaces(tmp_path / "out" / "store"), meshes, tmp_path)
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["store"]


def test_several_processes_give_the_same_bytes(meshes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run(meshes, tmp_path / "one")
    monkeypatch.setattr(preparing, "MESHES_A_PART", 3)
    run(meshes, tmp_path / "two", processes=2)
    for name in ("points.bin", "names.txt", "radii.bin"):
        assert (tmp_path / "one" / name).read_bytes() == (tmp_path / "two" / name).read_bytes()


def hdf5(folder: Path) -> dict[str, np.ndarray]:
    h5py = pytest.importorskip("h5py")
    folder.mkdir()
    (folder / "shape_names.txt").write_text("airplane\nbathtub\n")
    expected = {}
    for name, count in (("train0", 5), ("train1", 3), ("test0", 4)):
        rng = np.random.default_rng(count)
        data, label = rng.normal(size=(count, 64, 3)).astype("f4"), rng.integers(0, 2, (count, 1)).astype("u1")
        with h5py.File(folder / f"ply_data_{name}.h5", "w") as file:
            file["data"], file["label"] = data, label
        for row in range(count):
            split = name.rstrip("01")
            expected[f"{('airplane', 'bathtub')[label[row, 0]]}/{split}/ply_data_{name}-{row:04d}"] = data[row]
    return expected


def test_sampled_hdf5_files(tmp_path: Path) -> None:
    expected = hdf5(tmp_path / "modelnet40_ply_hdf5_2048")
    run(tmp_path / "modelnet40_ply_hdf5_2048", tmp_path / "store", normalisation="none")
    store = open_surfaces(tmp_path / "store")
    assert set(store.names) == set(expected)
    for name, points in zip(store.names, store.points, strict=True):
        assert {tuple(p) for p in points} <= {tuple(p) for p in expected[name]}
        assert len(np.unique(points, axis=0)) == 32
    with pytest.raises(StoreError, match="at least one usable mesh.*expected 99 finite points"):
        run(tmp_path / "modelnet40_ply_hdf5_2048", tmp_path / "more", points=99)
    shutil.copytree(tmp_path / "modelnet40_ply_hdf5_2048", tmp_path / "copy")
    path = tmp_path / "copy" / "ply_data_test0.h5"
    path.write_bytes(path.read_bytes()[:-50])
    with pytest.raises(ValueError, match="ply_data_test0"):
        run(tmp_path / "copy", tmp_path / "cut")


def test_the_data_module_reads_the_store(meshes: Path, tmp_path: Path) -> None:
    run(meshes, tmp_path / "store")
    options = {"num_points": 16, "pool_size": 32, "train_pairs": 9, "batch_size": 3, "eval_batch_size": 4}
    outliers = Outliers(ratio=0.5)
    prepared = MeshDataModule(str(tmp_path / "store"), test_outliers=outliers, **options)
    prepared.setup("test")
    (batch,) = prepared.test_dataloader()
    assert batch.points2d.shape == (4, 24, 2)
    assert ((batch.match3d >= 0).sum(-1) == 16).all()
    fewer = MeshDataModule(str(tmp_path / "store"), **(options | {"pool_size": 20}))
    fewer.setup("fit")
    assert len(list(fewer.train_dataloader())) == 3
    with pytest.raises(StoreError, match="pool_size.*--points 64"):
        MeshDataModule(str(tmp_path / "store"), num_points=16, pool_size=64).setup("test")
    with pytest.raises(StoreError, match="unit_cube.*unit_sphere"):
        MeshDataModule(str(tmp_path / "store"), **options, normalisation="unit_cube").setup("test")


def test_unusable_sources_are_named(meshes: Path, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "cut.zip").write_bytes(zipped(meshes).read_bytes()[:-300])
    (tmp_path / "text.zip").write_text("404 Not Found")
    with zipfile.ZipFile(tmp_path / "other.zip", "w") as archive:
        archive.writestr("a.txt", "a")
    for name in ("empty", "cut.zip", "text.zip", "other.zip", "nowhere"):
        with pytest.raises(ValueError, match=name):
            run(tmp_path / name, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_damaged_entry_of_a_zip_is_skipped(meshes: Path, tmp_path: Path) -> None:
    path = zipped(meshes)
    with zipfile.ZipFile(path) as archive:
        entry = archive.getinfo("ModelNet40/box1/train/box1_0001.off")
    content = bytearray(path.read_bytes())
    start = entry.header_offset + 30 + len(entry.filename) + entry.compress_size // 2
    content[start : start + 8] = bytes(8)
    path.write_bytes(content)
    prepared = run(path, tmp_path / "store")
    assert set(prepared.skipped) - {f"box0/{name}" for name in BAD} == {"box1/train/box1_0001"}


def test_again_does_nothing_and_otherwise_is_refused(meshes: Path, tmp_path: Path) -> None:
    run(meshes, tmp_path / "store")
    before = (tmp_path / "store" / "manifest.json").stat().st_mtime_ns
    assert run(meshes, tmp_path / "store").counts == {"train": 8, "test": 4}
    assert (tmp_path / "store" / "manifest.json").stat().st_mtime_ns == before
    with pytest.raises(StoreError, match="another points"):
        run(meshes, tmp_path / "store", points=16)
    with pytest.raises(StoreError, match="no store of bpnp"):
        run(meshes, tmp_path / "ModelNet40")


def killed(work: object, seconds: float) -> bool:
    """Run `work` in a fork that is killed after some time. Whether it had ended before."""
    child = os.fork()
    if child == 0:
        os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
        work()
        os._exit(0)
    time.sleep(seconds)
    os.kill(child, signal.SIGKILL)
    return os.waitpid(child, 0)[1] == 0


@pytest.mark.parametrize("kind", ["meshes", "colmap"])
def test_no_kill_leaves_a_wrong_store(
    meshes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:  # fmt: skip
    monkeypatch.setattr(preparing, "MESHES_A_PART", 2)
    scenes(tmp_path / "scenes", 8)

    def work(output: str = "store") -> None:
        if kind == "meshes":
            run(meshes, tmp_path / output)
        else:
            prepare_colmap(tmp_path / "scenes", tmp_path / output, min_points=4, clutter=1.0, processes=1)

    start = time.perf_counter()
    work("whole")
    duration = time.perf_counter() - start
    rng = np.random.default_rng(0)
    ended = 0
    for _ in range(24):
        ended += killed(work, rng.uniform(0, 1.2 * duration))
        if not (tmp_path / "store").exists():
            continue
        for path in (tmp_path / "whole").iterdir():
            assert (tmp_path / "store" / path.name).read_bytes() == path.read_bytes()
        shutil.rmtree(tmp_path / "store")
    assert ended < 24
    work()
    assert is_store(tmp_path / "store")
    assert {path.name for path in tmp_path.iterdir() if "unfinished" in path.name} == set()


def test_finished_parts_are_kept(meshes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(preparing, "MESHES_A_PART", 2)
    done: list[Path] = []
    sample = preparing.sample_part

    def stop_at_four(job: tuple, path: Path) -> None:
        if len(done) == 4:
            raise KeyboardInterrupt
        sample(job, path)
        done.append(path)

    monkeypatch.setattr(preparing, "sample_part", stop_at_four)
    with pytest.raises(KeyboardInterrupt):
        run(meshes, tmp_path / "store")
    monkeypatch.setattr(preparing, "sample_part", lambda job, path: (done.append(path), sample(job, path)))
    run(meshes, tmp_path / "store")
    assert len(done) == len(set(done)) == 10
    check(open_surfaces(tmp_path / "store"), meshes, tmp_path)


def test_two_at_once_are_refused(meshes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def again(job: tuple, path: Path) -> None:
        run(meshes, tmp_path / "store")

    monkeypatch.setattr(preparing, "sample_part", again)
    with pytest.raises(StoreError, match="another at work"):
        run(meshes, tmp_path / "store")


def scenes(root: Path, count: int) -> None:
    for i in range(count):
        plant_model(root / f"{i:04d}" / "sparse" / "manhattan" / "0", seen=30 + i, seed=i)


def test_colmap_pairs_are_those_read_anew(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scenes(tmp_path / "MegaDepth_v1_SfM", 6)
    broken = tmp_path / "MegaDepth_v1_SfM" / "0003" / "sparse" / "manhattan" / "0" / "points3D.bin"
    broken.write_bytes(broken.read_bytes()[:-9])
    arguments = [str(tmp_path / "MegaDepth_v1_SfM"), "--output", str(tmp_path / "store"), "--clutter", "0.5"]
    main(["prepare", "megadepth", *arguments, "--processes", "1", "--min-points", "31"])
    assert "4 scenes, 12 pairs" in capsys.readouterr().out
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
    for i in range(6):
        true = stored.match3d[i] >= 0
        camera = stored.points3d[i, true] @ stored.rotation[i].mT + stored.translation[i]
        seen = stored.points2d[i, stored.match3d[i, true]]
        torch.testing.assert_close(camera[:, :2] / camera[:, 2:], seen, rtol=0, atol=2e-5)
    assert set(PairStore(tmp_path / "store").skipped) == {"0003", "0000"}
    with pytest.raises(StoreError, match="clutter.*0.5.*--clutter 0.6"):
        ColmapDataModule(str(tmp_path / "store"), **(options | {"clutter": 0.6})).setup("test")


def test_outliers_reach_the_batches_of_a_store(tmp_path: Path) -> None:
    scenes(tmp_path / "scenes", 4)
    prepare_colmap(tmp_path / "scenes", tmp_path / "store", min_points=4, clutter=0.0, processes=1)
    module = ColmapDataModule(
        str(tmp_path / "store"),
        max_points=20,
        batch_size=2,
        train_outliers=Outliers(ratio=1.0, side="3d"),
        test_outliers=Outliers(occlusion=0.5),
    )
    module.setup()
    train, test = next(iter(module.train_dataloader())), next(iter(module.test_dataloader()))
    assert (train.points2d.shape[1], train.points3d.shape[1]) == (20, 40)
    assert (test.count2d < test.count3d).all()
    with pytest.raises(ValueError, match="nothing.txt"):
        ColmapDataModule(str(tmp_path / "store"), val_scenes=str(tmp_path / "nothing.txt"))


def test_no_usable_model_is_one_error(tmp_path: Path) -> None:
    scenes(tmp_path / "scenes", 1)
    with pytest.raises(StoreError, match="at least one usable image.*min_points"):
        prepare_colmap(tmp_path / "scenes", tmp_path / "store", min_points=50, clutter=0.0, processes=1)
    assert not (tmp_path / "store").exists()


def test_what_is_left_of_removed_parts_is_not_used(
    meshes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:  # fmt: skip
    """A kill while the parts are removed, after the store has got its name."""
    run(meshes, tmp_path / "whole")
    monkeypatch.setattr(preparing, "MESHES_A_PART", 2)
    with monkeypatch.context() as patch:
        patch.setattr(shutil, "rmtree", _remove_one_file_and_stop)
        with pytest.raises(KeyboardInterrupt):
            run(meshes, tmp_path / "store")
    shutil.rmtree(tmp_path / "store")
    run(meshes, tmp_path / "store")
    assert (tmp_path / "store" / "points.bin").read_bytes() == (tmp_path / "whole" / "points.bin").read_bytes()


def _remove_one_file_and_stop(folder: Path, *, ignore_errors: bool = False) -> None:
    if folder.name.startswith("0"):
        (folder / "points.bin").unlink()
        raise KeyboardInterrupt


@pytest.mark.parametrize("name", ["points.bin", "names.txt", "radii.bin", "manifest.json"])
def test_a_damaged_surface_store_is_one_error(meshes: Path, tmp_path: Path, name: str) -> None:
    run(meshes, tmp_path / "store")
    path = tmp_path / "store" / name
    whole = path.read_bytes()
    flipped = bytearray(whole)
    flipped[len(whole) // 2] ^= 1
    for content in (whole[:-1], whole + b"0", bytes(flipped), b""):
        path.write_bytes(content)
        with pytest.raises(StoreError, match=str(tmp_path / "store")):
            open_surfaces(tmp_path / "store")
    path.write_bytes(whole)
    assert len(open_surfaces(tmp_path / "store").names) == 12


def test_parts_of_another_preparation_are_not_used(
    meshes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:  # fmt: skip
    run(meshes, tmp_path / "whole")
    monkeypatch.setattr(preparing, "write_surfaces", _write_parts_only)
    with pytest.raises(KeyboardInterrupt):
        run(meshes, tmp_path / "store", normalisation="none")
    assert len(list((tmp_path / ".store.unfinished").iterdir())) == 3
    monkeypatch.setattr(preparing, "write_surfaces", write_surfaces)
    run(meshes, tmp_path / "store")
    assert (tmp_path / "store" / "points.bin").read_bytes() == (tmp_path / "whole" / "points.bin").read_bytes()


def _write_parts_only(folder: Path, *args: object, **options: object) -> None:
    if folder.name == "store":
        raise KeyboardInterrupt
    write_surfaces(folder, *args, **options)
