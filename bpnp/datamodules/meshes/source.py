"""Pairs of meshes' surface samples and what virtual cameras see of them."""

import warnings

import numpy as np
from numpy.typing import NDArray

from bpnp.datamodules.loader import Pair
from bpnp.datamodules.meshes.pools import SurfacePools
from bpnp.datamodules.meshes.procedural import SPLITS
from bpnp.datamodules.meshes.views import Views, draw_pair


def hold_out(count: int, fraction: float, *, seed: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Split range(count) at random into training rows and validation rows, at least one of each, both sorted.

    Raises ValueError for a fraction outside (0, 1) or fewer than two rows.
    """
    if not 0 < fraction < 1:
        raise ValueError(f"expected `val_fraction` between 0 and 1, got {fraction}")
    if count < 2:
        raise ValueError(f"expected at least 2 training meshes, to hold one out for validation, got {count}")
    held = min(count - 1, max(1, round(fraction * count)))
    order = np.random.default_rng(seed).permutation(count)
    return np.sort(order[held:]), np.sort(order[:held])


class MeshSource:
    """A `PairSource`: pair i is view i // k of mesh rows[i % k], k meshes in all.

    A pair is a function of (seed, split, index), and of the epoch too with `fresh_views`.
    Warns if the views may lose points behind the camera. Raises ValueError for no pairs.
    """

    def __init__(
        self,
        pools: SurfacePools,
        rows: NDArray[np.int64],
        *,
        num_pairs: int,
        num_points: int,
        views: Views,
        seed: int,
        split: str,
        fresh_views: bool = False,
    ) -> None:
        if num_pairs < 1:
            raise ValueError(f"expected at least one {split} pair, got {num_pairs}")
        if not views.sees_all(pools.radius):
            warnings.warn(
                f"the {split} meshes reach {pools.radius:.3g} from their origin: points that fall behind a camera at "
                f"`distance` {views.distance} get no 2D point; try normalisation unit_sphere or a larger distance",
                stacklevel=2,
            )
        # fewer pairs than meshes: a fair sample of them, the first ones would be all of one class
        rng = np.random.default_rng(seed)
        self.rows = np.sort(rng.choice(rows, num_pairs, replace=False)) if num_pairs < len(rows) else rows
        self.pools, self.num_pairs, self.num_points, self.views = pools, num_pairs, num_points, views
        self.seed, self.split, self.fresh_views = seed, split, fresh_views

    @property
    def sizes(self) -> NDArray[np.int64]:
        return np.full(self.num_pairs, self.num_points)

    def pair(self, index: int, epoch: int) -> Pair:
        view, mesh = divmod(index, len(self.rows))
        row = self.rows[mesh]
        rng = np.random.default_rng([self.seed, SPLITS.index(self.split), epoch if self.fresh_views else 0, index])
        name = f"{self.pools.names[row]}#{view}"
        return draw_pair(name, self.pools.points[row], num_points=self.num_points, views=self.views, rng=rng)
