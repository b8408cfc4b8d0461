"""Outliers and occlusion: counts, bounds and distributions of the protocol; true pairs stay true."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from jsonargparse import ArgumentParser
from scipy import stats

from bpnp.datamodules import MeshDataModule
from bpnp.datamodules.loader import Pair, PairSource
from bpnp.datamodules.outliers import Outliers, harder, select, with_outliers


def planted(count: int = 60, seed: int = 0) -> Pair:
    """A camera's pair without noise; match3d is a random permutation."""
    rng = np.random.default_rng(seed)
    points3d = rng.normal(size=(count, 3))
    rotation, translation = cv2.Rodrigues(rng.normal(size=3))[0], np.array([0.1, -0.2, 9.0])
    camera = points3d @ rotation.T + translation
    order = rng.permutation(count)
    points2d = (camera[:, :2] / camera[:, 2:])[order]
    return Pair("p", np.float32(points2d), np.float32(points3d), rotation, translation, np.argsort(order), 1.0)


class Planted:
    sizes = np.array([60, 30])

    def pair(self, index: int, epoch: int) -> Pair:
        return planted(int(self.sizes[index]), seed=index)


def residuals(pair: Pair) -> np.ndarray:
    true = pair.match3d >= 0
    camera = pair.points3d[true] @ pair.rotation.T + pair.translation
    return pair.points2d[pair.match3d[true]] - camera[:, :2] / camera[:, 2:]


@pytest.mark.parametrize("ratio", [0.1, 0.5, 1.0, 2.5])
@pytest.mark.parametrize("side", ["both", "2d", "3d"])
def test_counts_and_box_of_the_protocol(ratio: float, side: str) -> None:
    pair = planted()
    result = with_outliers(pair, Outliers(ratio=ratio, side=side), np.random.default_rng(0))
    added = int(ratio * 60)
    assert len(result.points2d) == 60 + added * (side != "3d")
    assert len(result.points3d) == 60 + added * (side != "2d")
    assert (result.match3d >= 0).sum() == 60
    assert np.abs(residuals(result)).max() < 1e-6
    assert (result.points2d.min(0) == pair.points2d.min(0)).all()
    assert (result.points3d.max(0) == pair.points3d.max(0)).all()


def test_outliers_are_uniform_in_the_box_and_nowhere_first() -> None:
    pair = planted(400)
    result = with_outliers(pair, Outliers(ratio=5.0), np.random.default_rng(0))
    outliers = result.points3d[result.match3d < 0]
    low, high = pair.points3d.min(0), pair.points3d.max(0)
    for axis in range(3):
        assert stats.kstest((outliers[:, axis] - low[axis]) / (high - low)[axis], "uniform").pvalue > 1e-3
    for positions in (np.flatnonzero(result.match3d < 0), result.match3d[result.match3d >= 0]):
        assert stats.kstest(positions / 2400, "uniform").pvalue > 1e-3


@pytest.mark.parametrize(("side", "left2d", "left3d"), [("2d", 45, 60), ("3d", 60, 45), ("both", 53, 52)])
def test_occlusion_leaves_points_without_a_partner(side: str, left2d: int, left3d: int) -> None:
    result = with_outliers(planted(), Outliers(occlusion=0.25, occluded_side=side), np.random.default_rng(0))
    assert (len(result.points2d), len(result.points3d)) == (left2d, left3d)
    assert (result.match3d >= 0).sum() == 45
    assert np.abs(residuals(result)).max() < 1e-6
    few = with_outliers(planted(6), Outliers(occlusion=0.9), np.random.default_rng(0))
    assert (few.match3d >= 0).sum() == 4


def test_select_cuts_pairs_whose_point_is_gone() -> None:
    pair = planted(10)
    result = select(pair, np.array([3, 1]), np.arange(9, -1, -1))
    assert sorted(result.match3d) == [-1] * 8 + [0, 1]
    assert np.abs(residuals(result)).max() < 1e-6


def test_a_source_with_outliers_is_deterministic() -> None:
    source = Planted()
    assert harder(source, Outliers(), seed=0, fresh=True) is source
    fixed, fresh = (harder(source, Outliers(ratio=0.5, occlusion=0.1), seed=3, fresh=f) for f in (False, True))
    assert isinstance(fixed, PairSource)
    assert (fixed.sizes >= [len(fixed.pair(i, 0).points3d) for i in range(2)]).all()
    assert (fixed.pair(0, 0).points2d == fixed.pair(0, 5).points2d).all()
    assert (fresh.pair(0, 1).points2d == fresh.pair(0, 1).points2d).all()
    assert not np.array_equal(fresh.pair(0, 0).points2d, fresh.pair(0, 1).points2d)


WRONG = [
    {"ratio": -1.0}, {"ratio": np.nan}, {"ratio": (0.5, 0.2)}, {"ratio": (0.0, np.inf)}, {"occlusion": 1.0},
    {"occlusion": (0.0, 1.0)},
]  # fmt: skip


@pytest.mark.parametrize("bad", WRONG)
def test_wrong_options_are_named(bad: dict[str, object]) -> None:
    with pytest.raises(ValueError, match=next(iter(bad))):
        Outliers(**bad)  # type: ignore[arg-type]


def test_ranges_are_drawn_uniformly_for_each_pair() -> None:
    """Counts follow their ranges: ratio uniform in (0.2, 1.4), occlusion in (0.1, 0.5), each side a third."""
    outliers = Outliers(ratio=(0.2, 1.4), side="random", occlusion=(0.1, 0.5), occluded_side="3d")
    pair, added, left, sides = planted(), [], [], []
    for seed in range(600):
        result = with_outliers(pair, outliers, np.random.default_rng(seed))
        true = int((result.match3d >= 0).sum())
        outliers2d, outliers3d = len(result.points2d) - 60, len(result.points3d) - true
        left.append(true / 60)
        added.append(max(outliers2d, outliers3d) / true)
        sides.append((outliers2d > 0) + 2 * (outliers3d > 0))
        assert np.abs(residuals(result)).max() < 1e-6
    assert 0.2 - 1 / 30 < min(added) < 0.25
    assert 1.35 < max(added) <= 1.4
    assert np.mean(added) == pytest.approx(0.8, abs=0.06)  # 4 standard errors
    assert stats.kstest(1 - np.array(left), "uniform", (0.1, 0.4)).statistic < 0.08
    assert stats.chisquare(np.bincount(sides)[1:]).pvalue > 1e-3
    assert stats.spearmanr(added, left).pvalue > 1e-3


def test_a_number_takes_none_of_the_random_numbers_of_a_range() -> None:
    for same in (Outliers(ratio=(0.5, 0.5), occlusion=(0.25, 0.25)), Outliers(ratio=0.5, occlusion=0.25)):
        result = with_outliers(planted(), same, np.random.default_rng(0))
        assert (len(result.points2d), len(result.points3d)) == (45 + 22, 60 + 22)
        assert same.fixed == (0.5, "both", 0.25, "2d")
    assert Outliers(side="random").fixed is None
    assert Outliers(occlusion=(0.0, 0.1)).fixed is None


def test_a_source_of_drawn_ratios_is_deterministic_and_bounds_its_sizes() -> None:
    fresh = harder(Planted(), Outliers(ratio=(0.0, 1.0)), seed=3, fresh=True)
    counts = [len(fresh.pair(0, epoch).points2d) for epoch in range(40)]
    assert counts == [len(fresh.pair(0, epoch).points2d) for epoch in range(40)]
    assert len(set(counts)) > 20
    assert max(counts) <= fresh.sizes[0] == 120


def test_ranges_come_from_yaml(tmp_path: Path) -> None:
    (tmp_path / "data.yaml").write_text("train_outliers: {ratio: [0, 1], side: random, occlusion: [0.1, 0.3]}\n")
    parser = ArgumentParser()
    parser.add_class_arguments(MeshDataModule, "data")
    options = parser.instantiate_classes(parser.parse_args([f"--data={tmp_path / 'data.yaml'}"]))
    assert options.data.outliers["train"] == Outliers((0.0, 1.0), "random", (0.1, 0.3))
    options = parser.instantiate_classes(parser.parse_args(["--data.train_outliers={ratio: 0.5}"]))
    assert options.data.outliers["train"] == Outliers(0.5)
