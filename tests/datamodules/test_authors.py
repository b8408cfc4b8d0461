"""The authors' pickles: planted problems come back with their matches, copies dropped, both directions of W_gt."""

import pickle
import shutil
from pathlib import Path

import numpy as np
import pytest
from authors_pickles import Exploit, Sample, sample, write
from planted import seen

from bpnp.cli import main
from bpnp.datamodules.augment import Outliers
from bpnp.datamodules.authors import AuthorsDataModule, PickleError, authors_recipe
from bpnp.datamodules.store import Store, StoreError, open_store, prepare
from bpnp.datamodules.stored import PROBLEMS, scene_rows, stored_problem


def prepare_authors(source: Path, output: Path) -> Store:
    return prepare(authors_recipe(source, None), output)


def check(store: Store, samples: list[Sample]) -> None:
    assert len(store) == 2 * len(samples)
    for i in range(len(store)):
        problem, expected = stored_problem(store, i), samples[i % len(samples)]
        count = expected["num_points_2d"][0]
        assert (len(problem.points2d), len(problem.points3d)) == (count, count)
        assert problem.matched == count
        projected = seen(problem.points3d, problem.rotation, problem.translation)
        assert problem.points2d == pytest.approx(projected, abs=1e-6)
        assert problem.points3d == pytest.approx(expected["p3d"][:count], abs=1e-6)


def test_preprocessed_pickles_become_a_store(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    samples = [sample(i) for i in range(8)]
    write(tmp_path / "data", samples)
    main(["prepare", "authors", str(tmp_path / "data"), "--output", str(tmp_path / "store")])
    assert "8 train, 8 test" in capsys.readouterr().out
    store = open_store(tmp_path / "store", PROBLEMS)
    check(store, samples)
    assert list(scene_rows(store)) == ["train", "test"]
    assert stored_problem(store, 0).focal == 800
    assert len(prepare_authors(tmp_path / "data", tmp_path / "store")) == 16


def test_correspondences_indexed_by_2d_points_are_read(tmp_path: Path) -> None:
    samples = [sample(i) for i in range(8)]
    for s in samples:
        count = s["num_points_2d"][0]
        s["W_gt"] = np.resize(np.argsort(s["W_gt"][:count]), 40)
    write(tmp_path, samples, "data61_2d3d")
    prepare_authors(tmp_path, tmp_path / "store")
    check(open_store(tmp_path / "store", PROBLEMS), samples)


def test_pickles_before_preprocessing_become_a_store_by_scene(tmp_path: Path) -> None:
    samples = [sample(i) for i in range(6)]
    for split in ("train", "test"):
        for scene, part in (("0001", samples[:3]), ("0002", samples[3:])):
            folder = tmp_path / f"megadepth_{split}" / scene
            folder.mkdir(parents=True)
            rows = [np.hstack([s["p2d"][s["W_gt"]], s["p3d"]])[: s["num_points_2d"][0]] for s in part]
            for name, values in (("matches", rows), ("R", [s["R_gt"] for s in part])):
                (folder / f"{name}.pkl").write_bytes(pickle.dumps(values, 2))
            (folder / "t.pkl").write_bytes(pickle.dumps([s["t_gt"][:, None] for s in part], 2))
    prepare_authors(tmp_path, tmp_path / "store")
    store = open_store(tmp_path / "store", PROBLEMS)
    assert tuple(scene_rows(store)) == ("train/0001", "train/0002", "test/0001", "test/0002")
    check(store, samples)


def write_pairs(folder: Path, samples: list[Sample], outliers: int = 0) -> None:
    """Write samples as Liu et al. do: the rows of `matches` are not matched, those of `inlier_matches` are (3D, 2D)."""
    folder.mkdir(parents=True)
    rng = np.random.default_rng(0)
    columns: dict[str, list[object]] = {name: [] for name in ("matches", "inlier_matches", "focal", "R", "t")}
    for s in samples:
        count = s["num_points_2d"][0]
        points2d = np.vstack([s["p2d"][:count], rng.normal(size=(outliers, 2))])
        points3d = np.vstack([s["p3d"][:count], rng.normal(size=(outliers, 3))])
        columns["matches"].append(np.hstack([points2d, points3d]))
        columns["inlier_matches"].append(np.column_stack([np.arange(count), s["W_gt"][:count]]))
        columns["focal"].append(np.array([612.5]))
        columns["R"].append(s["R_gt"])
        columns["t"].append(s["t_gt"])
    for name, values in columns.items():
        (folder / f"{name}.pkl").write_bytes(pickle.dumps(values, 2))


def test_the_folders_of_liu_et_al_are_train_and_test(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The planted matches come back, two points of each side stay without one, and the focal length is theirs."""
    samples = [sample(i) for i in range(6)]
    for split in ("train", "valid"):
        write_pairs(tmp_path / "data" / f"nyu_{split}", samples, outliers=2)
    main(["prepare", "authors", str(tmp_path / "data"), "--output", str(tmp_path / "store")])
    assert "6 train, 6 test" in capsys.readouterr().out
    store = open_store(tmp_path / "store", PROBLEMS)
    for i in range(12):
        problem, count = stored_problem(store, i), samples[i % 6]["num_points_2d"][0]
        assert (problem.matched, len(problem.points2d), len(problem.points3d)) == (count, count + 2, count + 2)
        projected = seen(problem.points3d, problem.rotation, problem.translation)
        assert problem.points2d[:count] == pytest.approx(projected[:count], abs=1e-5)
        assert problem.focal == 612.5


def test_two_folders_of_test_problems_are_refused(tmp_path: Path) -> None:
    for split in ("train", "valid", "test"):
        write_pairs(tmp_path / f"nyu_{split}", [sample(0)])
    with pytest.raises(ValueError, match="nyu_test and .*nyu_valid both have test problems"):
        authors_recipe(tmp_path, None)


def test_pairs_beyond_the_points_are_left_out(tmp_path: Path) -> None:
    write_pairs(tmp_path / "nyu_train", [sample(i) for i in range(5)])
    file = tmp_path / "nyu_train" / "inlier_matches.pkl"
    pairs = pickle.loads(file.read_bytes())
    pairs[1][0, 1] = 1000
    pairs[2] = pairs[2][:, 0]
    file.write_bytes(pickle.dumps(pairs))
    store = prepare_authors(tmp_path, tmp_path / "store")
    assert (len(store), len(store.skipped)) == (3, 2)
    assert "inlier_matches of shape" in next(iter(store.skipped.values()))


@pytest.mark.parametrize("protocol", [0, 2])
def test_only_the_scenes_of_the_split_file_are_taken(
    protocol: int, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    for split in ("train", "test"):
        for scene in ("0001", "0002", "0003"):
            write_pairs(tmp_path / f"megadepth_{split}" / scene, [sample(int(scene))])
    listed = {"train": ["0001.pkl", "0003.pkl"], "val": ["0002.pkl", "0099.pkl"]}
    (tmp_path / "megadepth_split_SIFT.pkl").write_bytes(pickle.dumps(listed, protocol))
    store = prepare_authors(tmp_path, tmp_path / "store")
    assert tuple(scene_rows(store)) == ("train/0001", "train/0003", "test/0002")
    assert "1 of the test scenes that the split lists have no pickles" in caplog.text
    (tmp_path / "megadepth_split_SIFT.pkl").write_bytes(pickle.dumps({"train": []}))
    with pytest.raises(PickleError, match="has no list of names under 'val'"):
        authors_recipe(tmp_path, None)


BAD = {
    "rotation": {"R_gt": np.ones((3, 3))},
    "reflection": {"R_gt": -np.eye(3)},
    "translation": {"t_gt": np.array([0, np.nan, 1])},
    "2D points": {"p2d": np.full((40, 2), np.inf)},
    "3D points": {"p3d": np.zeros((40, 2))},
    "correspondences": {"W_gt": np.full(40, 77)},
    "few correspondences": {"W_gt": np.zeros(2, int)},
    "no correspondence": {"W_gt": np.full(40, -1)},
    "no numbers": {"p2d": [["a", "b"]]},
}


def test_bad_samples_are_left_out_and_listed(tmp_path: Path) -> None:
    samples = [sample(i) for i in range(8)] + [sample(i) | bad for i, bad in enumerate(BAD.values())]
    store = prepare_authors(write(tmp_path, samples), tmp_path / "store")
    assert (len(store), len(store.skipped)) == (16, 2 * len(BAD))


def test_a_2d_point_is_matched_once(tmp_path: Path) -> None:
    """If two 3D points have the same 2D point, the first one is its match."""
    samples = [sample(i) for i in range(8)]
    count = int(samples[0]["num_points_2d"][0])
    samples[0]["W_gt"][1] = samples[0]["W_gt"][0]
    prepare_authors(write(tmp_path, samples), tmp_path / "store")
    problem = stored_problem(open_store(tmp_path / "store", PROBLEMS), 0)
    assert (problem.matched, len(problem.points2d), len(problem.points3d)) == (count - 1, count, count)


def test_an_unreadable_source_is_one_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    root, output = write(tmp_path / "data", [sample(i) for i in range(4)]), tmp_path / "store"
    for content, message in (
        (pickle.dumps([Exploit()]), "system"),
        (b"", "p3d.pkl"),
        (pickle.dumps(3), "a bare int is refused"),
        (pickle.dumps([]), "p3d.pkl has no samples"),
        (pickle.dumps([np.zeros((4, 3))] * 3), "has other samples than"),
    ):
        (root / "modelnet40_test" / "preprocessed" / "p3d.pkl").write_bytes(content)
        with pytest.raises(PickleError, match=message):
            prepare_authors(root, output)
    (root / "modelnet40_test" / "preprocessed" / "p3d.pkl").unlink()
    with pytest.raises(ValueError, match="missing: .*p3d.pkl"):
        prepare_authors(root, output)
    write(tmp_path / "data", [sample(0)], "other")
    with pytest.raises(ValueError, match="--dataset modelnet40"):
        prepare_authors(root, output)
    with pytest.raises(ValueError, match="nowhere"):
        prepare_authors(tmp_path / "nowhere", output)
    with pytest.raises(ValueError, match="has no <dataset>_train and _test; its data sets: none"):
        prepare_authors(root / "other_test", output)
    shifted = [sample(i) | {"t_gt": np.array([5.0, 5.0, 8.0])} for i in range(4)]
    with pytest.raises(PickleError, match="project"):
        prepare_authors(write(tmp_path / "shifted", shifted), output)
    unusable = [sample(i) | BAD["rotation"] for i in range(4)]
    with pytest.raises(StoreError, match="has no usable sample"):
        prepare_authors(write(tmp_path / "unusable", unusable), output)
    assert not output.exists()
    assert not Path("hacked").exists()


def test_the_data_module_splits_and_augments_the_samples(tmp_path: Path) -> None:
    samples = [sample(i) for i in range(20)]
    options = {"val_fraction": 0.2, "batch_size": 4, "cache_dir": str(tmp_path / "cache"), "max_points": 6}
    options |= {"test_outliers": Outliers(ratio=1.0), "min_points": 5}
    module = AuthorsDataModule(str(write(tmp_path / "data", samples)), **options)
    module.prepare_data()
    module.setup()
    names = [name for batch in module.train_dataloader() for name in batch.ids]
    held_out = [name for batch in module.val_dataloader() for name in batch.ids]
    assert sorted(names + held_out) == [f"train/{i:06d}" for i in range(20)]
    assert len(held_out) == 4
    for batch in module.test_dataloader():
        true = (batch.match3d >= 0).sum(-1)
        assert (batch.count2d == 2 * true).all()
        assert (batch.count3d == 2 * true).all()
    assert len(list((tmp_path / "cache").iterdir())) == 1
    again = AuthorsDataModule(str(next((tmp_path / "cache").iterdir())), **options)
    again.setup("test")
    assert len(again.datasets["test"]) == 20


def test_problems_for_testing_alone_are_tested_on(tmp_path: Path) -> None:
    root = write(tmp_path / "data", [sample(i) for i in range(4)])
    shutil.rmtree(root / "modelnet40_train")
    store = prepare_authors(root, tmp_path / "store")
    for source in (root, store.folder):
        module = AuthorsDataModule(str(source), cache_dir=str(tmp_path / "cache"))
        module.setup("test")
        assert len(module.datasets["test"]) == 4
        with pytest.raises(StoreError, match="none of the 0 problems in "):
            module.setup("fit")


def test_a_store_of_another_data_set_is_refused(tmp_path: Path) -> None:
    store = prepare_authors(write(tmp_path / "data", [sample(i) for i in range(4)]), tmp_path / "store")
    AuthorsDataModule(str(store.folder), dataset="modelnet40").setup("test")
    with pytest.raises(StoreError, match="`dataset` is megadepth, but .*store was made of modelnet40; leave it out"):
        AuthorsDataModule(str(store.folder), dataset="megadepth").setup("test")
