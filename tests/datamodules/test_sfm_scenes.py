"""SfM-like scenes: exact geometry under the true pose, clutter that is none of the other side, and pure functions."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from jsonargparse import ArgumentParser
from scipy import stats
from scipy.spatial.transform import Rotation

from bpnp.datamodules import Outliers, Pair, PairSource, SfmSceneDataModule
from bpnp.datamodules.augment import Drawn
from bpnp.datamodules.facades.module import SfmSceneSource
from bpnp.datamodules.facades.scenes import Walls, draw_scene
from bpnp.datamodules.facades.views import SfmOptions, draw_camera, draw_sfm_pair, hidden, look


def source(*, seed: tuple[int, ...] = (0, 0), **options: object) -> SfmSceneSource:
    return SfmSceneSource(SfmOptions(**options), num_pairs=100, seed=seed, label="train")


def pairs(count: int, **options: object) -> list[Pair]:
    rngs = (np.random.default_rng([0, 0, 0, i]) for i in range(count))
    return [draw_sfm_pair(f"sfm/{i}", SfmOptions(**options), rng) for i, rng in enumerate(rngs)]


def shown(pair: Pair) -> np.ndarray:
    """Image points of all 3D points, NaN behind the camera."""
    x, y, z = (pair.points3d @ pair.rotation.T + pair.translation).T
    return np.stack([x, y], 1) / np.where(z > 0, z, np.nan)[:, None]


def matched(pair: Pair) -> tuple[np.ndarray, np.ndarray]:
    true = np.arange(pair.matched)
    return true, true


def test_true_pairs_reproject_within_the_noise() -> None:
    exact = pairs(10, num_points=40, clutter=0.5, noise_px=0.0)
    noise = []
    for pair in exact:
        true, seen = matched(pair)
        assert np.abs(shown(pair)[true] - pair.points2d[seen]).max() * pair.focal < 0.02  # float32
        assert len(set(seen)) == len(seen)
        assert np.linalg.det(pair.rotation) == pytest.approx(1)
        np.testing.assert_allclose(pair.rotation @ pair.rotation.T, np.eye(3), atol=1e-12)
    for pair in pairs(40, num_points=80, noise_px=1.2):
        true, seen = matched(pair)
        noise.append((shown(pair)[true] - pair.points2d[seen]).ravel() * pair.focal)
    assert np.concatenate(noise).std() == pytest.approx(1.2, rel=0.05)


def test_the_pose_is_what_opencv_finds_from_the_true_pairs() -> None:
    found = 0
    for pair in pairs(12, num_points=100, clutter=1.0, noise_px=(0.5, 1.5), scale_range=(1.0, 1.0)):
        true, seen = matched(pair)
        points3d, points2d = pair.points3d[true].astype(float), pair.points2d[seen].astype(float)
        middle = points3d.mean(0)
        ok, turn, shift = cv2.solvePnP(points3d - middle, points2d, np.eye(3), np.zeros(5), flags=cv2.SOLVEPNP_SQPNP)
        turn, shift = cv2.solvePnPRefineLM(points3d - middle, points2d, np.eye(3), np.zeros(5), turn, shift)
        rotation = cv2.Rodrigues(turn)[0]
        angle = np.degrees(Rotation.from_matrix(rotation @ pair.rotation.T).magnitude())
        moved = rotation.T @ (shift[:, 0] - rotation @ middle) - pair.rotation.T @ pair.translation
        found += bool(ok) and angle < 0.6 and np.linalg.norm(moved) < 0.5
    assert found >= 11


@pytest.mark.parametrize(("side", "in2d", "in3d"), [("both", 1, 1), ("2d", 1, 0), ("3d", 0, 1)])
def test_clutter_counts_and_is_of_no_point(side: str, in2d: int, in3d: int) -> None:
    shares = []
    for pair in pairs(10, num_points=40, clutter=0.5, clutter_side=side, noise_px=0.0):
        true, seen = matched(pair)
        extra = round(0.5 * len(true))
        assert 16 <= len(true) <= 40
        assert len(pair.points3d) - len(true) == in3d * extra
        assert len(pair.points2d) - len(true) <= in2d * extra
        shares.append((len(pair.points2d) - len(true)) / extra)
        false3d = np.setdiff1d(np.arange(len(pair.points3d)), true)
        false2d = np.setdiff1d(np.arange(len(pair.points2d)), seen)
        distance = np.linalg.norm(pair.points2d[:, None] - shown(pair)[None], axis=-1) * pair.focal
        assert not (distance[:, false3d] < 0.02).any()
        assert not (distance[false2d] < 0.02).any()
        assert len(np.unique(pair.points3d, axis=0)) == len(pair.points3d)
    assert np.mean(shares) == pytest.approx(in2d, abs=0.2)  # where a camera sees few points there is less


@pytest.mark.parametrize("side", ["3d", "random"])
def test_a_range_of_clutter_is_drawn_for_each_pair(side: str) -> None:
    drawn = pairs(100, num_points=30, min_points=30, clutter=(0.2, 1.0), clutter_side=side)
    ratio2d, ratio3d = (np.array([len(p) / 30 - 1 for p in points]) for points in zip(
        *((pair.points2d, pair.points3d) for pair in drawn), strict=True))  # fmt: skip
    with3d = ratio3d[ratio3d > 0]
    assert 0.2 - 0.02 <= with3d.min() < 0.3
    assert 0.9 < with3d.max() <= 1.0
    assert stats.kstest(with3d, "uniform", (0.2, 0.8)).statistic < 0.2
    assert ratio2d.max() <= 1.0
    kinds = np.bincount((ratio2d > 0) + 2 * (ratio3d > 0), minlength=4)
    if side == "random":
        assert stats.chisquare(kinds[1:]).pvalue > 1e-3
    else:
        assert kinds.tolist() == [0, 0, 100, 0]


def test_a_pair_is_a_function_of_seed_epoch_and_index() -> None:
    options = {"num_points": 20, "clutter": (0.0, 1.0)}
    first, index = source(**options), torch.tensor([3, 4])
    assert isinstance(first, PairSource)
    pair = first.batch(index[1:], 2)
    size = int(pair.count3d)
    assert torch.equal(pair.points3d[0], source(**options).batch(index, 2).points3d[1, :size])
    others = [first.batch(index[1:], 1), first.batch(index[:1], 2)]
    others += [source(seed=seed, **options).batch(index[1:], 2) for seed in ((1, 0), (0, 1))]
    assert not any(torch.equal(pair.points3d[0, :16], other.points3d[0, :16]) for other in others)


def test_points_lie_in_the_image_and_the_frame_is_arbitrary() -> None:
    plenty = pairs(60, num_points=30, clutter=0.5, noise_px=0.0)
    for pair in plenty:
        half = 600 / pair.focal
        assert 40 <= 2 * np.degrees(np.arctan(half)) <= 75
        assert np.abs(pair.points2d).max() <= half * (1 + 1e-6)
        assert np.abs(pair.points2d).max(0).min() <= half * 0.75 * (1 + 1e-6)
    for rotate in (False, True):
        data = SfmSceneDataModule(num_points=20, test_pairs=60, eval_batch_size=60, rotate=rotate)
        data.setup("test")
        (batch,) = data.test_dataloader()
        if rotate:
            assert batch.rotation.mean(0).abs().max() < 0.35
        else:
            assert batch.rotation[:, 1, 2].quantile(0.75) < -0.8  # the third axis is upwards in the image
    extents = [np.ptp(pair.points3d, axis=0).max() for pair in plenty]
    assert max(extents) / min(extents) > 20


def test_a_wall_hides_what_is_behind_it_and_nothing_else() -> None:
    """A wall 4 m wide and 3 m high on the x axis; rays from (2, -10, 1.5) by hand."""
    wall = Walls(np.zeros((1, 2)), np.array([[1.0, 0.0]]), np.array([[0.0, -1.0]]), np.array([4.0]), np.array([3.0]), 1)
    points = {
        (2.0, 10.0, 1.5): True,
        (5.9, 10.0, 1.5): True,  # crosses at x = 3.95
        (6.2, 10.0, 1.5): False,  # passes at x = 4.1
        (2.0, 10.0, 4.6): False,  # passes at 3.05 m
        (2.0, 0.3, 1.5): False,  # in a window's recess
        (2.0, -1.0, 1.5): False,
        (2.0, -12.0, 1.5): False,
    }
    found = hidden(wall, np.array([2.0, -10.0, 1.5]), np.array(list(points)))
    assert found.tolist() == list(points.values())


def test_seen_points_face_the_camera_and_the_map_has_all_of_the_true_ones() -> None:
    for seed in range(10):
        rng = np.random.default_rng(seed)
        scene = draw_scene(800, rng)
        camera = draw_camera(scene.walls, 60.0, rng)
        sight = look(scene, camera, 1.0, rng)
        assert scene.mapped[sight.true].all()
        assert not scene.mapped[sight.unmapped].any()
        seen = np.concatenate([sight.true, sight.unmapped])
        towards = camera.centre - scene.points[seen]
        faced = scene.normals[seen].any(1)
        assert ((towards * scene.normals[seen]).sum(1)[faced] > 0).all()
        np.testing.assert_allclose(np.linalg.norm(scene.normals[seen][faced], axis=1), 1)
        nothing = look(scene, camera, 0.0, rng)
        assert len(nothing.true) + len(nothing.unmapped) == 0


def test_density_is_uneven_as_that_of_keypoints() -> None:
    """Counts in cells of the image vary several times as much as those of uniform points would."""
    spread = []
    for pair in pairs(15, num_points=120, min_points=60):
        half = np.abs(pair.points2d).max(0)
        cells = np.histogram2d(*pair.points2d.T, bins=6, range=[(-h, h) for h in half])[0]
        spread.append(cells.var() / cells.mean())
    assert np.median(spread) > 2.5


def test_the_module_is_configured_by_yaml(tmp_path: Path) -> None:
    (tmp_path / "sfm.yaml").write_text(
        "{num_points: 24, clutter: [0, 0.5], eval_clutter: 0.25, noise_px: 1, train_pairs: 8, val_pairs: 3,"
        " test_pairs: 3, batch_size: 4, train_outliers: {ratio: [0, 1]}}"
    )
    parser = ArgumentParser()
    parser.add_class_arguments(SfmSceneDataModule, "data")
    data = parser.instantiate_classes(parser.parse_args([f"--data={tmp_path / 'sfm.yaml'}"])).data
    with pytest.raises(ValueError, match="expected `setup` before the train loader"):
        data.train_dataloader()
    data.setup()
    assert data.options["train"].clutter == (0.0, 0.5)
    assert data.options["val"].clutter == 0.25
    assert data.outliers["train"] == Outliers(ratio=(0.0, 1.0))
    batches = list(data.train_dataloader())
    assert sorted(i for batch in batches for i in batch.index.tolist()) == list(range(8))
    assert max(batch.points3d.shape[1] for batch in batches) <= data.datasets["train"].sizes[0]
    assert sum(len(batch) for batch in data.test_dataloader()) == 3


WRONG: list[tuple[str, object]] = [
    ("min_points", 3), ("min_points", 200), ("clutter", -0.1), ("clutter", (1.0, 0.5)), ("field_of_view", 170.0),
    ("noise_px", (0.0, np.inf)), ("scale_range", (0.0, 1.0)),
]  # fmt: skip


@pytest.mark.parametrize(("name", "value"), WRONG)
def test_wrong_options_are_named(name: str, value: object) -> None:
    with pytest.raises(ValueError, match=name):
        SfmSceneDataModule(**{name: value})  # type: ignore[arg-type]


def test_a_camera_that_never_sees_enough_is_an_error() -> None:
    narrow: Drawn = 5.0
    with pytest.raises(ValueError, match="expected a camera that sees 500 mapped points in 50 scenes"):
        pairs(1, num_points=500, min_points=500, field_of_view=narrow)
