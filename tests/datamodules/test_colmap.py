from pathlib import Path
from typing import Any

import numpy as np
import pytest
from lightning.pytorch.trainer.states import TrainerFn
from planted_model import plant_model
from small_data import check_pairs

from bpnp.datamodules.colmap.model_files import ColmapError, find_scenes
from bpnp.datamodules.colmap.module import ColmapDataModule
from bpnp.datamodules.stored import split_scenes


def test_colmap_models_are_found_in_every_folder_layout(tmp_path: Path) -> None:
    folders = [
        "castle/sparse/0",
        "0007/sparse/manhattan/0",
        "0007/sparse/manhattan/10",
        "old/plain",
        "x/dense/0/sparse",
    ]
    for folder in folders:
        plant_model(tmp_path / folder, images=1)
    assert find_scenes(tmp_path) == {
        "0007": {f"0007/sparse/manhattan/{k}": tmp_path / f"0007/sparse/manhattan/{k}" for k in ("0", "10")},
        "castle": {"castle": tmp_path / folders[0]},
        "old/plain": {"old/plain": tmp_path / folders[3]},
        "x": {"x": tmp_path / folders[4]},
    }
    for inside in ("castle", "castle/sparse", "castle/sparse/0"):
        assert find_scenes(tmp_path / inside) == {"castle": {"castle": tmp_path / folders[0]}}
    assert list(find_scenes(tmp_path / "0007/sparse/manhattan")) == ["0007"]
    assert list(find_scenes([tmp_path / "x", str(tmp_path / "old")])) == ["plain", "x"]
    (tmp_path / "loop").symlink_to(tmp_path)
    assert len(find_scenes(tmp_path)) == 4


def test_folders_that_hold_no_scene_are_one_error(tmp_path: Path) -> None:
    with pytest.raises(ColmapError, match="nowhere is no folder"):
        find_scenes(tmp_path / "nowhere")
    with pytest.raises(ColmapError, match="has no COLMAP models; give a folder that holds"):
        find_scenes(tmp_path)
    plant_model(tmp_path / "a/broken", images=1)
    (tmp_path / "a/broken/points3D.bin").unlink()
    with pytest.raises(ColmapError, match="1 folders lack cameras, images or points3D .*broken"):
        find_scenes(tmp_path)
    plant_model(tmp_path / "a/whole", images=1)
    with pytest.warns(UserWarning, match="skipped: 1 folders lack cameras, images or points3D .*broken"):
        assert list(find_scenes(tmp_path)) == ["a/whole"]
    plant_model(tmp_path / "b/whole", images=1)
    with pytest.raises(ColmapError, match="are both named 'whole'"):
        find_scenes([tmp_path / "a/whole", tmp_path / "b/whole"])


def test_a_model_in_two_roots_is_one_error(tmp_path: Path) -> None:
    """Under two names it would be two scenes, of which a split may train on one and test on the other."""
    plant_model(tmp_path / "data/a/castle/sparse/0", images=1)
    (tmp_path / "link").symlink_to(tmp_path / "data/a/castle")
    assert list(find_scenes([tmp_path / "data/a", tmp_path / "data/a/castle"])) == ["castle"]
    for other, name in ((tmp_path / "data/a", "castle"), (tmp_path / "link", "link")):
        with pytest.raises(ColmapError, match=rf"would be in the scenes 'a/castle' and '{name}'; give"):
            find_scenes([tmp_path / "data", other])


SCENES = [f"s{i}" for i in range(10)]


def test_scenes_are_split_without_overlap() -> None:
    splits = [split_scenes(SCENES, seed=seed) for seed in range(20)]
    for split in splits:
        assert sorted(split["train"] + split["val"] + split["test"]) == SCENES
        assert {part: len(names) for part, names in split.items()} == {"train": 7, "val": 1, "test": 2}
    assert splits[3] == split_scenes(SCENES[::-1], seed=3)
    assert len({tuple(split["test"]) for split in splits}) > 10
    named = split_scenes(SCENES, train=["s4", "s2"], test=["s0"], val_fraction=0.5)
    assert (named["train"], named["test"], len(named["val"])) == (["s4", "s2"], ["s0"], 5)
    assert not {"s4", "s2", "s0"} & set(named["val"])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"test": ["s77"]}, "there are no scenes s77; the scenes are s0, s1, "),
        ({"test": ["s1"], "train": ["s1"]}, "name s1 more than once"),
        ({"test_fraction": 1.5}, "`test_fraction` is 1.5; it must be from 0 to 1"),
    ],
)
def test_a_split_that_does_not_fit_is_one_error(options: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        split_scenes(SCENES, **options)


def plant_scenes(root: Path, count: int = 5) -> None:
    for i in range(count):
        plant_model(root / f"s{i}" / "sparse" / "0", images=4, seen=20 + 5 * i, seed=i)


def test_the_loaders_serve_disjoint_scenes(tmp_path: Path) -> None:
    plant_scenes(tmp_path)
    data = ColmapDataModule(str(tmp_path), max_points=22, clutter=0.2, rotate=True, batch_size=3)
    data.setup()
    served = {}
    for part in ("train", "val", "test", "predict"):
        ids = []
        for batch in getattr(data, f"{part}_dataloader")():
            check_pairs(batch, 1e-5)
            ids += batch.ids
        served[part] = {name.split("/")[0] for name in ids}
        assert len(ids) == len(set(ids)) == 4 * len(served[part])
    assert served["test"] == served["predict"]
    assert served["train"] | served["val"] | served["test"] == {f"s{i}" for i in range(5)}
    assert sum(len(served[part]) for part in ("train", "val", "test")) == 5
    assert max(data.datasets["train"].sizes) == 22 + round(0.2 * 22)
    predicted, tested = (data.datasets[part] for part in ("predict", "test"))
    image = predicted.source.images[0][1]
    np.testing.assert_allclose(predicted.problem(0).rotation[0].numpy(), image.rotation, atol=1e-6)
    assert not np.allclose(tested.problem(0).rotation[0].numpy(), image.rotation, atol=0.1)


WRONG: list[tuple[dict[str, Any], str]] = [
    ({"clutter": -0.25}, "`clutter` is -0.25; it must be 0 or more"),
    ({"clutter": float("nan")}, "`clutter`"),
    ({"clutter": float("inf")}, "`clutter` is inf; it must be finite"),
    ({"min_points": 1}, "`min_points` is 1; it must be 4 or more"),
    ({"max_points": 8, "min_points": 9}, "`max_points` is 8; it must be at least `min_points`, 9"),
    ({"eval_max_points": 3}, "`eval_max_points` is 3; it must be at least `min_points`, 4"),
    ({"batch_size": 0}, "`batch_size` is 0; it must be 1 or more"),
    ({"eval_batch_size": 0}, "`eval_batch_size` is 0; it must be 1 or more"),
    ({"num_workers": -1}, "`num_workers` is -1; it must be 0 or more"),
]


@pytest.mark.parametrize(("options", "message"), WRONG)
def test_wrong_options_are_named_for_models_and_stores_alike(options: dict[str, Any], message: str) -> None:
    for root in ("models", "store"):
        with pytest.raises(ValueError, match=message):
            ColmapDataModule(root, **options)


def test_a_broken_model_among_others_is_skipped_and_counted(tmp_path: Path) -> None:
    plant_scenes(tmp_path, 3)
    (tmp_path / "s1/sparse/0/points3D.bin").write_bytes(b"\0" * 7)
    data = ColmapDataModule(str(tmp_path), test_fraction=1.0)
    with pytest.warns(UserWarning, match="skipped 1 of 3 COLMAP models: .*s1/sparse/0/points3D.bin"):
        data.setup("test")
    assert {scene.name for scene, _ in data.datasets["test"].source.images} == {"s0", "s2"}


def test_a_stage_without_scenes_is_one_error(tmp_path: Path) -> None:
    plant_scenes(tmp_path, 1)
    data = ColmapDataModule(str(tmp_path))
    with pytest.raises(ValueError, match=r"the test loader needs `setup\(\)` first"):
        data.test_dataloader()
    data.setup("test")
    for stage in ("fit", "validate"):
        with pytest.raises(ValueError, match=f"no scene is left for {stage} of s0"):
            data.setup(stage)
    with pytest.raises(ValueError, match="no scene is left for fit of"):
        data.setup(TrainerFn.FITTING)
