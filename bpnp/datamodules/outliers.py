"""Pairs made harder: subsets of their points, uniform outliers on either side, and occluded points."""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from bpnp.datamodules.batching import Pair, PairSource

Side = Literal["both", "2d", "3d"]
MIN_TRUE = 4  # pairs that occlusion leaves; fewer do not fix a pose
STREAM = 7  # of random numbers, apart from those that drew the pair


@dataclass(frozen=True)
class Outliers:
    """What is added to and taken from a pair. The defaults change nothing.

    Args:
        ratio: rho, synthetic outliers as a ratio to the true pairs: int(rho * pairs) points, uniform in the
            axis-aligned bounding box of the true points of that side; 1 makes half of the points outliers.
        side: the side that gets them, both, 2d or 3d.
        occlusion: share of the true pairs that lose one of their two points, so that the other has no partner.
        occluded_side: where they lose it, 2d, 3d, or both for half of them here and half there.
    """

    ratio: float = 0.0
    side: Side = "both"
    occlusion: float = 0.0
    occluded_side: Side = "2d"

    def __post_init__(self) -> None:
        if not 0 <= self.ratio < np.inf:
            raise ValueError(f"expected an outlier `ratio` of 0 or more, got {self.ratio}; 1 doubles the points")
        if not 0 <= self.occlusion < 1:
            raise ValueError(f"expected `occlusion` in [0, 1), got {self.occlusion}; 0.1 hides one point in ten")
        for name in ("side", "occluded_side"):
            if getattr(self, name) not in ("both", "2d", "3d"):
                raise ValueError(f'expected `{name}` "both", "2d" or "3d", got {getattr(self, name)!r}')


def select(pair: Pair, kept2d: NDArray[np.int64], kept3d: NDArray[np.int64]) -> Pair:
    """The pair of the 2D points `kept2d` and the 3D points `kept3d` (indices, without repetition), in that order.

    A 3D point whose 2D point is left out gets -1 in match3d.
    """
    place = np.full(len(pair.points2d) + 1, -1)  # the last entry: where -1 points to
    place[kept2d] = np.arange(len(kept2d))
    return replace(
        pair, points2d=pair.points2d[kept2d], points3d=pair.points3d[kept3d], match3d=place[pair.match3d[kept3d]]
    )


def with_outliers(pair: Pair, outliers: Outliers, rng: np.random.Generator) -> Pair:
    """The pair with occluded points removed and outliers appended, each side in a new random order.

    Occlusion leaves at least 4 true pairs. The outliers count relative to the true pairs that are left.
    """
    true3d = np.flatnonzero(pair.match3d >= 0)
    hidden = max(0, min(round(outliers.occlusion * len(true3d)), len(true3d) - MIN_TRUE))
    split = {"2d": hidden, "3d": 0, "both": hidden // 2}[outliers.occluded_side]
    hidden3d = rng.permutation(true3d)[:hidden]
    pair = select(
        pair,
        np.setdiff1d(np.arange(len(pair.points2d)), pair.match3d[hidden3d[:split]]),
        np.setdiff1d(np.arange(len(pair.points3d)), hidden3d[split:]),
    )
    true3d = np.flatnonzero(pair.match3d >= 0)
    count = int(outliers.ratio * len(true3d))
    count2d, count3d = count * (outliers.side != "3d"), count * (outliers.side != "2d")
    pair = replace(
        pair,
        points2d=np.concatenate([pair.points2d, _uniform(pair.points2d[pair.match3d[true3d]], count2d, rng)]),
        points3d=np.concatenate([pair.points3d, _uniform(pair.points3d[true3d], count3d, rng)]),
        match3d=np.concatenate([pair.match3d, np.full(count3d, -1)]),
    )
    return select(pair, rng.permutation(len(pair.points2d)), rng.permutation(len(pair.points3d)))


def _uniform(points: NDArray[np.float32], count: int, rng: np.random.Generator) -> NDArray[np.float32]:
    """`count` points, uniform in the axis-aligned bounding box of `points`."""
    if count == 0:
        return np.empty((0, points.shape[1]), np.float32)
    return rng.uniform(points.min(0), points.max(0), (count, points.shape[1])).astype(np.float32)


class OutlierSource:
    """A source whose pairs get outliers: a function of (seed, index), and of the epoch too if `fresh`."""

    def __init__(self, source: PairSource, outliers: Outliers, *, seed: int, fresh: bool) -> None:
        self.source, self.outliers, self.seed, self.fresh = source, outliers, seed, fresh

    @property
    def sizes(self) -> NDArray[np.int64]:
        """Most points of the larger side of each pair."""
        sizes = np.asarray(self.source.sizes)
        return sizes + (self.outliers.ratio * sizes).astype(np.int64)

    def pair(self, index: int, epoch: int) -> Pair:
        rng = np.random.default_rng([self.seed, STREAM, epoch if self.fresh else 0, index])
        return with_outliers(self.source.pair(index, epoch), self.outliers, rng)


def harder(source: PairSource, outliers: Outliers | None, *, seed: int, fresh: bool) -> PairSource:
    """The source with outliers, or itself where there are none."""
    if outliers is None or outliers == Outliers():
        return source
    return OutlierSource(source, outliers, seed=seed, fresh=fresh)
