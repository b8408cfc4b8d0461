"""Outliers and occlusion: counts, bounds and distributions of the protocol; true pairs stay true."""

import cv2
import numpy as np
import pytest
from scipy import stats

from bpnp.datamodules.batching import Pair, PairSource
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


@pytest.mark.parametrize("bad", [{"ratio": -1.0}, {"ratio": np.nan}, {"occlusion": 1.0}])
def test_wrong_options_are_named(bad: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=next(iter(bad))):
        Outliers(**bad)
