from pathlib import Path

import numpy as np
import pytest
from planted_model import plant_model

from bpnp.datamodules.colmap.model_files import ColmapError
from bpnp.datamodules.colmap.pairs import ColmapSource
from bpnp.datamodules.colmap.reconstruction import read_reconstruction
from bpnp.datamodules.loader import Pair


def source(folder: Path, *, plant: dict | None = None, **options) -> ColmapSource:
    if not folder.exists():
        plant_model(folder, **(plant or {}))
    return ColmapSource([read_reconstruction(folder, name="castle")], **options)


def residuals(pair: Pair) -> np.ndarray:
    """Distance of each true pair's 2D point to the projection of its 3D point, normalised coordinates."""
    points = pair.points3d.astype(np.float64) @ pair.rotation.T + pair.translation
    true = pair.match3d >= 0
    return np.linalg.norm(points[true, :2] / points[true, 2:] - pair.points2d[pair.match3d[true]], axis=-1)


def same(a: Pair, b: Pair) -> bool:
    return all(np.array_equal(getattr(a, field), getattr(b, field)) for field in Pair.__dataclass_fields__)


def test_every_true_pair_projects_onto_its_keypoint(tmp_path: Path) -> None:
    pairs = source(tmp_path / "m")
    assert pairs.sizes.tolist() == [40, 40, 40]
    for i in range(3):
        pair = pairs.pair(i, 0)
        assert pair.name == f"castle/photo {i}.jpg"
        assert residuals(pair).max() < 1e-6
        assert sorted(pair.match3d) == list(range(40))
        assert (pair.match3d != np.arange(40)).sum() > 30  # nothing in the order gives the pairing away
        assert (pair.points2d.dtype, pair.points3d.dtype, pair.focal) == (np.float32, np.float32, 510.0)


@pytest.mark.parametrize(
    ("clutter", "side", "extra2d", "extra3d"),
    [(0.25, "both", 10, 10), (0.25, "2d", 10, 0), (0.25, "3d", 0, 10), (1.0, "both", 12, 20), (0.0, "both", 0, 0)],
)
def test_clutter_is_what_the_image_does_not_pair(
    clutter: float, side, extra2d: int, extra3d: int, tmp_path: Path
) -> None:
    """12 keypoints have no point and 20 of the 60 points are not seen: no more can be had."""
    truth = plant_model(tmp_path / "m")
    pairs = source(tmp_path / "m", clutter=clutter, clutter_side=side)
    pair = pairs.pair(1, 0)
    assert (len(pair.points2d), len(pair.points3d)) == (40 + extra2d, 40 + extra3d)
    assert pairs.sizes[1] == 40 + max(extra2d, extra3d)
    matched = pair.match3d[pair.match3d >= 0]
    assert len(set(matched.tolist())) == len(matched) == 40
    assert residuals(pair).max() < 1e-6
    unseen = np.delete(truth.points3d, truth.seen[1], axis=0).astype(np.float32)
    drawn = {tuple(point) for point in pair.points3d[pair.match3d < 0]}
    assert len(drawn) == extra3d
    assert drawn <= {tuple(point) for point in unseen}
    noise = np.delete(pair.points2d, matched, axis=0)
    distance = np.linalg.norm(noise[:, None] - truth.points2d[1], axis=-1)
    assert len(noise) == extra2d
    assert len(noise) == 0 or distance.min() > 1e-5


def test_a_subset_keeps_the_pairing_and_has_no_point_twice(tmp_path: Path) -> None:
    pairs = source(tmp_path / "m", max_points=15, clutter=0.2)
    assert pairs.sizes.tolist() == [18, 18, 18]
    pair = pairs.pair(0, 0)
    assert residuals(pair).max() < 1e-6
    assert len(np.unique(pair.points3d, axis=0)) == len(np.unique(pair.points2d, axis=0)) == 18
    assert (pair.match3d >= 0).sum() == 15


def test_a_pair_is_a_function_of_seed_epoch_and_index(tmp_path: Path) -> None:
    options = {"max_points": 15, "clutter": 0.2, "rotate": True}
    fresh = source(tmp_path / "m", fresh=True, **options)
    again = source(tmp_path / "m", fresh=True, **options)
    fixed = source(tmp_path / "m", **options)
    other = source(tmp_path / "m", seed=1, **options)
    again.pair(2, 5)
    assert same(fresh.pair(0, 3), again.pair(0, 3))
    assert not same(fresh.pair(0, 3), fresh.pair(0, 4))
    assert same(fixed.pair(0, 3), fixed.pair(0, 4))
    assert same(fixed.pair(0, 0), fresh.pair(0, 0))
    assert not same(fixed.pair(0, 0), other.pair(0, 0))


def test_a_turned_scene_keeps_its_geometry_and_can_be_turned_back(tmp_path: Path) -> None:
    truth = plant_model(tmp_path / "m")
    pairs = source(tmp_path / "m", rotate=True)
    turns = []
    for i in range(3):
        pair = pairs.pair(i, 0)
        turn, origin = pairs.frame(i)
        turns.append(turn)
        assert residuals(pair).max() < 1e-6
        np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-12)
        np.testing.assert_allclose(pair.rotation @ turn, truth.rotations[i], atol=1e-12)
        np.testing.assert_allclose(pair.translation - pair.rotation @ turn @ origin, truth.translations[i], atol=1e-12)
    assert np.linalg.det(turns[0]) == pytest.approx(1.0)
    assert not np.allclose(turns[0], turns[1])


def test_turns_are_uniform(tmp_path: Path) -> None:
    """The mean of uniform rotations is the zero matrix; its entries have variance 1/3."""
    pairs = source(tmp_path / "m", rotate=True, fresh=True)
    mean = np.mean([pairs.frame(0, epoch)[0] for epoch in range(2000)], axis=0)
    assert np.abs(mean).max() < 4 * np.sqrt(1 / 3 / 2000)


def test_a_scene_far_from_its_origin_keeps_its_digits(tmp_path: Path, caplog) -> None:
    """At 5e6 units float32 steps by half a unit, as large as the scene."""
    truth = plant_model(tmp_path / "m", origin=5e6)
    pairs = source(tmp_path / "m")
    assert "3 of 3 images of castle see points that are far" in caplog.text
    for i in range(3):
        pair = pairs.pair(i, 0)
        assert residuals(pair).max() < 1e-6
        assert np.abs(pair.translation).max() < 10
        turn, origin = pairs.frame(i)
        np.testing.assert_allclose(pair.rotation @ turn, truth.rotations[i], atol=1e-12)
        np.testing.assert_allclose(pair.translation - pair.rotation @ turn @ origin, truth.translations[i], atol=1e-8)


def test_images_with_too_few_points_are_skipped_and_counted(tmp_path: Path) -> None:
    plant_model(tmp_path / "few", images=2, seen=5)
    plant_model(tmp_path / "many", seen=6)
    scenes = [read_reconstruction(tmp_path / name) for name in ("few", "many")]
    with pytest.warns(UserWarning, match="skipped 2 of 5 images of few, many: fewer than 6 points"):
        pairs = ColmapSource(scenes, min_points=6)
    assert (len(pairs.sizes), pairs.skipped) == (3, 2)
    with pytest.raises(ColmapError, match="7 points or more in few, many, got none of 5"):
        ColmapSource(scenes, min_points=7)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"min_points": 3}, "`min_points`"),
        ({"max_points": 3}, "`max_points`"),
        ({"clutter": -0.1}, "`clutter`"),
        ({"clutter": float("nan")}, "`clutter`"),
        ({"clutter_side": "left"}, "clutter_side"),
    ],
)
def test_bad_options_name_themselves(options: dict, message: str, tmp_path: Path) -> None:
    with pytest.raises((ValueError, TypeError), match=message):
        source(tmp_path / "m", **options)


def test_real_images_are_pairs_within_the_reconstruction_error(shared_data: Path) -> None:
    for scene in ("castle-P30", "sceaux_castle_txt", "walkthrough"):
        reconstruction = read_reconstruction(shared_data / "colmap" / scene / "sparse" / "0", name=scene)
        pairs = ColmapSource([reconstruction], clutter=0.5)
        for index in range(0, len(pairs.images), 9):
            pair = pairs.pair(index, 0)
            assert len(pair.points2d) <= np.ceil(1.5 * len(pairs.images[index][1].seen))
            assert np.median(residuals(pair)) * pair.focal < 2.5
