"""The pairs of a packed store as a source for training and testing."""

import warnings
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from bpnp.datamodules.loader import Pair
from bpnp.datamodules.manifest import StoreError
from bpnp.datamodules.outliers import Side, select
from bpnp.datamodules.pair_store import PairStore


class StoreSource:
    """A `PairSource`: rows of a store, with as many of their points as wanted, each side in random order.

    rows: positions of the pairs in the store.
    min_points: pairs with fewer true pairs are left out; how many is warned about and kept in `skipped`.
    max_points: at most this many true pairs of a pair, drawn without replacement; None for all.
    clutter: points without a partner, as a ratio to the true pairs kept, or as many as the store has.
    clutter_side: which sides get it, "both", "2d" or "3d".
    rotate: turn the 3D points by a uniformly random rotation.
    fresh: draw anew in every epoch, else the same each time.
    seed: a pair is a function of (seed, epoch, index).

    Raises ValueError for `max_points` below `min_points`, StoreError if no pair is left or the store was made with less
    clutter.
    """

    def __init__(
        self,
        store: PairStore,
        rows: NDArray[np.int64],
        *,
        min_points: int = 4,
        max_points: int | None = None,
        clutter: float = 0.0,
        clutter_side: Side = "both",
        rotate: bool = False,
        fresh: bool = False,
        seed: int = 0,
    ) -> None:
        if max_points is not None and max_points < min_points:
            raise ValueError(f"expected `max_points` of at least `min_points` = {min_points}, got {max_points}")
        stored = store.parameters.get("clutter", np.inf)
        if clutter > stored:
            raise StoreError(
                f"expected `clutter` of at most {stored}, what {store.folder} was made with, got {clutter}; try that, "
                f"or preparing again with --clutter {clutter}"
            )
        self.store = store
        self.rows = rows[store.matched[rows] >= min_points]
        self.skipped = len(rows) - len(self.rows)
        if not len(self.rows):
            raise StoreError(
                f"expected pairs of {min_points} or more matched points in {store.folder}, got none of {len(rows)}; "
                "try a smaller `min_points` or other scenes"
            )
        if self.skipped:
            warnings.warn(
                f"skipped {self.skipped} of {len(rows)} pairs of {store.folder}: fewer than {min_points} true pairs",
                stacklevel=2,
            )
        self.max_points = max_points
        self.clutter2d, self.clutter3d = clutter * (clutter_side != "3d"), clutter * (clutter_side != "2d")
        self.rotate, self.fresh, self.seed = rotate, fresh, seed

    @property
    def sizes(self) -> NDArray[np.int64]:
        """Points of the larger side of each pair."""
        matched = self.store.matched[self.rows]
        kept = self._kept(matched)
        extra2d = np.minimum(self.store.count2d[self.rows] - matched, np.rint(self.clutter2d * kept))
        extra3d = np.minimum(self.store.count3d[self.rows] - matched, np.rint(self.clutter3d * kept))
        return kept + np.maximum(extra2d, extra3d).astype(np.int64)

    def pair(self, index: int, epoch: int) -> Pair:
        rng = np.random.default_rng([self.seed, epoch if self.fresh else 0, index])
        pair = self.store.pair(int(self.rows[index]))
        true3d = rng.permutation(np.flatnonzero(pair.match3d >= 0))
        true3d = true3d[: self._kept(len(true3d))]
        extra2d, extra3d = round(self.clutter2d * len(true3d)), round(self.clutter3d * len(true3d))
        chosen2d, matched2d = np.zeros((2, len(pair.points2d)), bool)  # masks: quicker than sets of indices
        chosen2d[pair.match3d[true3d]] = True
        matched2d[pair.match3d[pair.match3d >= 0]] = True
        free2d = rng.permutation(np.flatnonzero(~matched2d))[:extra2d]
        free3d = rng.permutation(np.flatnonzero(pair.match3d < 0))[:extra3d]
        kept2d, kept3d = np.concatenate([np.flatnonzero(chosen2d), free2d]), np.concatenate([true3d, free3d])
        pair = select(pair, rng.permutation(kept2d), rng.permutation(kept3d))
        if not self.rotate:
            return pair
        turn = Rotation.from_quat(rng.standard_normal(4)).as_matrix()  # a normal 4-vector has a uniform direction
        return replace(
            pair,
            points3d=(pair.points3d @ turn.T).astype(np.float32),
            rotation=pair.rotation @ turn.T,
            origin=None if pair.origin is None else turn @ pair.origin,
        )

    def _kept(self, matched: NDArray[np.int64] | int) -> NDArray[np.int64]:
        return np.asarray(matched if self.max_points is None else np.minimum(matched, self.max_points))
