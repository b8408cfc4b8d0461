"""Pairs made harder: subsets of their points, uniform outliers on either side, and occluded points."""

from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bpnp.datamodules.loader import Pair, PairSource
from bpnp.geometry import MIN_POINTS

Side = Literal["both", "2d", "3d"]
DrawnSide = Literal["both", "2d", "3d", "random"]
Drawn = float | tuple[float, float]  # a number, or (low, high) for one drawn uniformly for each pair
STREAM = 7  # of random numbers, apart from those that drew the pair


class Amounts(NamedTuple):
    """What one pair gets of `Outliers`."""

    ratio: float
    side: Side
    occlusion: float
    occluded_side: Side


@dataclass(frozen=True)
class Outliers:
    """What is added to and taken from a pair. The defaults change nothing.

    Args:
        ratio: rho, synthetic outliers as a ratio to the true pairs: int(rho * pairs) points, uniform in the
            axis-aligned bounding box of the true points of that side; 1 makes half of the points outliers. Two numbers,
            [low, high], draw it for each pair, uniformly.
        side: the side that gets them, both, 2d or 3d, or random for one of the three in each pair.
        occlusion: share of the true pairs that lose one of their two points, so that the other has no partner; a number
            or [low, high], as ratio.
        occluded_side: where they lose it, 2d, 3d, or both for half of them here and half there; or random.
    """

    ratio: Drawn = 0.0
    side: DrawnSide = "both"
    occlusion: Drawn = 0.0
    occluded_side: DrawnSide = "2d"

    def __post_init__(self) -> None:
        low, high = bounds(self.ratio)
        if not 0 <= low <= high < np.inf:
            raise ValueError(
                f"expected an outlier `ratio` of 0 or more, or (low, high), got {self.ratio}; 1 doubles the points"
            )
        low, high = bounds(self.occlusion)
        if not 0 <= low <= high < 1:
            raise ValueError(
                f"expected `occlusion` in [0, 1), or (low, high), got {self.occlusion}; 0.1 hides one point in ten"
            )
        for name in ("side", "occluded_side"):
            if getattr(self, name) not in ("both", "2d", "3d", "random"):
                raise ValueError(f'expected `{name}` "both", "2d", "3d" or "random", got {getattr(self, name)!r}')

    @property
    def fixed(self) -> Amounts | None:
        """What every pair gets; none if it is drawn for each."""
        ratio, occlusion = bounds(self.ratio), bounds(self.occlusion)
        if ratio[0] < ratio[1] or occlusion[0] < occlusion[1] or "random" in (self.side, self.occluded_side):
            return None
        return self.drawn(np.random.default_rng())

    def drawn(self, rng: np.random.Generator) -> Amounts:
        """What a pair gets; takes numbers of `rng` for what is not fixed only."""
        return Amounts(
            draw(self.ratio, rng), draw_side(self.side, rng), draw(self.occlusion, rng),
            draw_side(self.occluded_side, rng),
        )  # fmt: skip


def bounds(value: Drawn) -> tuple[float, float]:
    """(low, high) of what `draw` gives."""
    low, high = value if isinstance(value, (tuple, list)) else (value, value)
    return low, high


def draw(value: Drawn, rng: np.random.Generator) -> float:
    """The number, or one between the two, uniformly."""
    low, high = bounds(value)
    return float(rng.uniform(low, high)) if low < high else low


def draw_side(side: DrawnSide, rng: np.random.Generator) -> Side:
    """The side, or for "random" each of the three equally often."""
    sides: tuple[Side, ...] = ("both", "2d", "3d")
    return sides[rng.integers(3)] if side == "random" else side


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
    amounts = outliers.drawn(rng)
    true3d = np.flatnonzero(pair.match3d >= 0)
    hidden = max(0, min(round(amounts.occlusion * len(true3d)), len(true3d) - MIN_POINTS))
    split = {"2d": hidden, "3d": 0, "both": hidden // 2}[amounts.occluded_side]
    hidden3d = rng.permutation(true3d)[:hidden]
    pair = select(
        pair,
        np.setdiff1d(np.arange(len(pair.points2d)), pair.match3d[hidden3d[:split]]),
        np.setdiff1d(np.arange(len(pair.points3d)), hidden3d[split:]),
    )
    true3d = np.flatnonzero(pair.match3d >= 0)
    count = int(amounts.ratio * len(true3d))
    count2d, count3d = count * (amounts.side != "3d"), count * (amounts.side != "2d")
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
        return sizes + (bounds(self.outliers.ratio)[1] * sizes).astype(np.int64)

    def pair(self, index: int, epoch: int) -> Pair:
        rng = np.random.default_rng([self.seed, STREAM, epoch if self.fresh else 0, index])
        return with_outliers(self.source.pair(index, epoch), self.outliers, rng)


def harder(source: PairSource, outliers: Outliers | None, *, seed: int, fresh: bool) -> PairSource:
    """The source with outliers, or itself where there are none."""
    if outliers is None or outliers == Outliers():
        return source
    return OutlierSource(source, outliers, seed=seed, fresh=fresh)
