"""The mesh data: the laws of the paper's protocol, determinism, splits by model, and real meshes."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import trimesh
from scipy import stats
from scipy.spatial.transform import Rotation

from bpnp.datamodules.loader import PairSource
from bpnp.datamodules.meshes.module import MeshDataModule
from bpnp.datamodules.meshes.pools import SurfacePools
from bpnp.datamodules.meshes.source import MeshSource, hold_out
from bpnp.datamodules.meshes.views import Views, draw_pair


def cloud(models: int = 5, samples: int = 400) -> SurfacePools:
    points = np.random.default_rng(0).normal(size=(models, samples, 3))
    points /= np.linalg.norm(points, axis=-1, keepdims=True)
    return SurfacePools(points.astype(np.float32), tuple(f"m{i}" for i in range(models)), 1.0)


def source(views: Views | None = None, *, num_pairs: int = 200, **options) -> MeshSource:
    options = {"num_points": 300, "seed": 0, "split": "train"} | options
    return MeshSource(cloud(), np.arange(5), num_pairs=num_pairs, views=views or Views(), **options)


def module(folder: Path, root: Path | None = None, **options) -> MeshDataModule:
    sizes = {"num_points": 32, "pool_size": 64, "train_shapes": 6, "val_shapes": 2, "test_shapes": 3, "train_pairs": 20}
    return MeshDataModule(None if root is None else str(root), cache_dir=str(folder / "cache"), **(sizes | options))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """10 boxes to train on and 4 to test, of two classes, in three formats."""
    for i in range(14):
        path = tmp_path / "meshes" / f"box{i % 2}" / ("train" if i < 10 else "test") / f"box{i % 2}_{i:04d}"
        path.parent.mkdir(parents=True, exist_ok=True)
        trimesh.creation.box((1, 2, 3 + i)).export(path.with_suffix((".off", ".ply", ".stl")[i % 3]))
    return tmp_path / "meshes"


def test_projections_by_opencv_leave_the_noise() -> None:
    pairs = [source().pair(i, 0) for i in range(200)]
    residuals = []
    for pair in pairs:
        assert pair.points3d.shape == (300, 3)
        assert sorted(pair.match3d) == list(range(300))
        assert (pair.match3d == np.arange(300)).mean() < 0.1
        image, _ = cv2.projectPoints(
            pair.points3d.astype(float), cv2.Rodrigues(pair.rotation)[0], pair.translation, np.eye(3), None
        )
        residuals.append(pair.points2d[pair.match3d] - image[:, 0])
    scaled = np.concatenate(residuals).ravel() * 800 / 2
    assert stats.kstest(scaled, stats.norm.cdf).pvalue > 1e-3


def test_poses_have_the_distributions_of_the_paper() -> None:
    pairs = [source(num_pairs=1000).pair(i, 0) for i in range(1000)]
    angles = Rotation.from_matrix([pair.rotation for pair in pairs]).as_euler("xyz", degrees=True)
    offsets = np.array([pair.translation for pair in pairs]) - [0, 0, 4.5]
    for axis in range(3):
        assert stats.kstest(angles[:, axis], stats.uniform(0, 45).cdf).pvalue > 1e-3
        assert stats.kstest(offsets[:, axis], stats.uniform(-0.5, 1).cdf).pvalue > 1e-3
    # R = Rz Ry Rx, written out for one pair
    (a, b, c), turn = np.deg2rad(angles[0]), pairs[0].rotation
    assert turn[2] == pytest.approx([-np.sin(b), np.cos(b) * np.sin(a), np.cos(b) * np.cos(a)])
    assert turn[:2, 0] == pytest.approx([np.cos(b) * np.cos(c), np.cos(b) * np.sin(c)])


def test_so3_is_uniform() -> None:
    """The angle of a uniform rotation has the distribution function (a - sin a) / pi, its axes are uniform too."""
    uniform = source(Views(rotation="so3"), num_pairs=1000)
    rotations = Rotation.from_matrix([uniform.pair(i, 0).rotation for i in range(1000)])
    assert stats.kstest(rotations.magnitude(), lambda a: (a - np.sin(a)) / np.pi).pvalue > 1e-3
    assert stats.kstest(rotations.as_matrix()[:, 2, 2], stats.uniform(-1, 2).cdf).pvalue > 1e-3


@pytest.mark.parametrize("fresh", [False, True])
def test_a_pair_depends_on_seed_epoch_and_index_alone(fresh: bool) -> None:
    one, other, reseeded = (source(fresh_views=fresh, seed=seed) for seed in (0, 0, 1))
    assert isinstance(one, PairSource)
    other.pair(3, 0)
    pair, same = one.pair(7, 2), other.pair(7, 2)
    for name in ("points2d", "points3d", "rotation", "translation", "match3d"):
        np.testing.assert_array_equal(getattr(pair, name), getattr(same, name))
        assert not np.array_equal(getattr(pair, name), getattr(reseeded.pair(7, 2), name))
        assert np.array_equal(getattr(pair, name), getattr(one.pair(7, 3), name)) is not fresh
        assert not np.array_equal(getattr(pair, name), getattr(one.pair(12, 2), name))
    assert (pair.name, one.pair(12, 2).name) == ("m2#1", "m2#2")
    assert {tuple(p) for p in pair.points3d} <= {tuple(p) for p in one.pools.points[2]}


def test_points_behind_the_camera_have_no_image() -> None:
    with pytest.warns(UserWarning, match="reach 1 from their origin"):
        inside = source(Views(distance=0.0, noise_px=0.0), num_pairs=5)
    for i in range(5):
        pair = inside.pair(i, 0)
        depth = (pair.points3d @ pair.rotation.T + pair.translation)[:, 2]
        assert ((pair.match3d >= 0) == (depth > 0.1)).all()
        assert sorted(pair.match3d[pair.match3d >= 0]) == list(range(len(pair.points2d)))
    behind = np.full((50, 3), [0, 0, -9], np.float32)
    with pytest.raises(ValueError, match=r"4 points in front of the camera, got 0 in a#0"):
        draw_pair("a#0", behind, num_points=50, views=Views(), rng=np.random.default_rng(0))


def test_splits_are_by_model(folder: Path, tmp_path: Path) -> None:
    data = module(tmp_path, folder, val_fraction=0.2, val_pairs=4, test_pairs=3)
    data.prepare_data()
    data.setup()
    names = {split: [one.pair(i, 0).name for i in range(one.num_pairs)] for split, one in data.sources.items()}
    models = {split: {name.split("#")[0] for name in some} for split, some in names.items()}
    assert [len(models[split]) for split in ("train", "val", "test")] == [8, 2, 3]
    assert [len(names[split]) for split in ("train", "val", "test")] == [20, 4, 3]
    assert not models["train"] & models["val"]
    assert all("/test/" in name for name in models["test"])
    assert all("/train/" in name for name in models["train"] | models["val"])
    assert "box0/train/box0_0000" in models["train"] | models["val"]
    (batch,) = data.test_dataloader()
    assert sorted(batch.ids) == sorted(names["test"])
    assert len(data.train_dataloader()) == 1
    train, held = hold_out(10, 0.01, seed=1)
    assert len(held) == 1
    assert sorted([*train, *held]) == list(range(10))


def test_stages_open_what_they_need(folder: Path, tmp_path: Path) -> None:
    for path in folder.glob("*/test/*"):
        path.unlink()
    data = module(tmp_path, folder)
    data.setup("fit")
    assert set(data.sources) == {"train", "val"}
    with pytest.raises(ValueError, match=r"expected `setup` before the test loader"):
        data.test_dataloader()
    with pytest.raises(ValueError, match=rf"<class>/.train,test./.*in {folder}, got none for 'test'"):
        data.setup("test")
    with pytest.raises(ValueError, match=rf"got {folder}x, which is no folder"):
        module(tmp_path, folder.with_name("meshesx")).setup("fit")


def test_a_bad_mesh_is_left_out_and_a_changed_one_read_again(folder: Path, tmp_path: Path) -> None:
    bad = folder / "box1" / "test" / "box1_0099.off"
    bad.write_text("OFF\n8 12 0\n0 0 0\n")
    with pytest.warns(UserWarning, match=rf"left out 1 of 5 meshes.*{bad.name}: expected 8 vertices"):
        module(tmp_path, folder).setup("test")
    bad.write_text("OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n")
    data = module(tmp_path, folder)
    data.setup("test")
    assert "box1/test/box1_0099" in data.sources["test"].pools.names


def test_wrong_arguments_are_named(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="`num_points` from 4 to `pool_size`, got 65 and 64"):
        module(tmp_path, num_points=65)
    with pytest.raises(ValueError, match="`euler_range`"):
        module(tmp_path, euler_range=(45.0, 0.0))
    with pytest.raises(ValueError, match="`noise_px`, got nan"):
        module(tmp_path, noise_px=float("nan"))
    with pytest.raises(ValueError, match="at least one train pair, got 0"):
        module(tmp_path, train_pairs=0).setup("fit")
    with pytest.raises(ValueError, match="`val_fraction` between 0 and 1, got 1"):
        hold_out(10, 1.0, seed=0)
    with pytest.raises(ValueError, match="at least 2 training meshes"):
        hold_out(1, 0.1, seed=0)


def test_procedural_batches(tmp_path: Path) -> None:
    data = module(tmp_path, batch_size=4, eval_batch_size=2)
    data.setup()
    batch = next(iter(data.train_dataloader()))
    assert batch.points2d.shape == (4, 32, 2)
    assert batch.mask2d.all()
    assert batch.points3d.norm(dim=-1).max() <= 1 + 1e-6
    seen = torch.cat([some.index for some in data.test_dataloader()])
    assert sorted(seen.tolist()) == [0, 1, 2]
    assert [len(some) for some in data.val_dataloader()] == [2]


def test_psb(shared_data: Path, tmp_path: Path) -> None:
    """Real CAD meshes: all of six classes are read, and the noise of their pairs is the one asked for."""
    root = tmp_path / "psb"
    root.mkdir()
    for name in ("aircraft", "blade", "city", "door", "hat", "watch"):
        (root / name).symlink_to(shared_data / "psb" / name)
    data = module(tmp_path, root, num_points=1000, pool_size=1000, eval_batch_size=8)
    data.setup("test")
    assert len(data.sources["test"].pools) == len(list(root.glob("*/test/*.off")))
    for batch in data.test_dataloader():
        camera = batch.points3d @ batch.rotation.mT + batch.translation[:, None]
        matched = torch.take_along_dim(batch.points2d, batch.match3d[..., None], 1)
        residual = (matched - camera[..., :2] / camera[..., 2:]) * batch.focal[:, None, None]
        assert residual.std().item() == pytest.approx(2, rel=0.03)
