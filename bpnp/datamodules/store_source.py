"""The pairs of a packed store as a source for training and testing."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from bpnp.datamodules.batching import Pair
from bpnp.datamodules.manifest import StoreError
from bpnp.datamodules.outliers import select
from bpnp.datamodules.pair_store import PairStore


class StoreSource:
    """A `PairSource`: rows of a store, with as many of their points as wanted, each side in random order.

    rows: positions of the pairs in the store.
    min_points: pairs with fewer true pairs are left out; how many is in `skipped`.
    max_points: at most this many true pairs of a pair, drawn without replacement; None for all.
    clutter: points without a partner, as a ratio to the true pairs kept, as many as the store has; drawn on both sides.
    rotate: turn the 3D points by a uniformly random rotation.
    fresh: draw anew in every epoch, else the same each time.
    seed: a pair is a function of (seed, epoch, index).

    Raises StoreError if no pair is left.
    """

    def __init__(
        self,
        store: PairStore,
        rows: NDArray[np.int64],
        *,
        min_points: int = 4,
        max_points: int | None = None,
        clutter: float = 0.0,
        rotate: bool = False,
        fresh: bool = False,
        seed: int = 0,
    ) -> None:
        self.store = store
        self.rows = rows[store.matched[rows] >= min_points]
        self.skipped = len(rows) - len(self.rows)
        if not len(self.rows):
            raise StoreError(
                f"expected pairs of {min_points} or more matched points in {store.folder}, got none of {len(rows)}; "
                "try a smaller `min_points` or other scenes"
            )
        self.max_points, self.clutter = max_points, clutter
        self.rotate, self.fresh, self.seed = rotate, fresh, seed

    @property
    def sizes(self) -> NDArray[np.int64]:
        """Points of the larger side of each pair."""
        kept = self._kept(self.store.matched[self.rows])
        count2d, count3d = self.store.count2d[self.rows], self.store.count3d[self.rows]
        free = np.maximum(count2d, count3d) - self.store.matched[self.rows]
        return kept + np.minimum(free, np.rint(self.clutter * kept).astype(np.int64))

    def pair(self, index: int, epoch: int) -> Pair:
        rng = np.random.default_rng([self.seed, epoch if self.fresh else 0, index])
        pair = self.store.pair(int(self.rows[index]))
        true3d = rng.permutation(np.flatnonzero(pair.match3d >= 0))
        true3d = true3d[: self._kept(len(true3d))]
        free2d = np.setdiff1d(np.arange(len(pair.points2d)), pair.match3d)
        free3d = np.flatnonzero(pair.match3d < 0)
        extra = round(self.clutter * len(true3d))
        kept2d = np.concatenate([np.unique(pair.match3d[true3d]), rng.permutation(free2d)[:extra]])
        kept3d = np.concatenate([true3d, rng.permutation(free3d)[:extra]])
        pair = select(pair, rng.permutation(kept2d), rng.permutation(kept3d))
        if not self.rotate:
            return pair
        turn = Rotation.from_quat(rng.standard_normal(4)).as_matrix()  # a normal 4-vector has a uniform direction
        return replace(
            pair, points3d=(pair.points3d @ turn.T).astype(np.float32), rotation=pair.rotation @ turn.T
        )  # fmt: skip

    def _kept(self, matched: NDArray[np.int64] | int) -> NDArray[np.int64]:
        return np.asarray(matched if self.max_points is None else np.minimum(matched, self.max_points))
