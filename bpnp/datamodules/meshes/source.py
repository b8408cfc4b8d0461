"""Pairs of meshes' surface samples and what virtual cameras see of them."""

import warnings
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy.typing import NDArray
from torch import Tensor

from bpnp.datamodules.keyed_random import row_keys
from bpnp.datamodules.meshes.views import Views, check_seen, draw_views
from bpnp.datamodules.pair import Counts
from bpnp.datamodules.store import Store
from bpnp.types import Batch

POINTS = "points"  # the bulk column of a store of surface samples
SURFACES = "surfaces"  # the kind of such a store


class MeshSource:
    """A `PairSource`: pair i is view i // k of mesh rows[i % k] of a store of surface samples, k meshes in all.

    Fewer pairs than meshes are a random choice of the meshes. A pair draws its points from the first `pool_size`
    samples of its mesh; it is a function of (seed, epoch, index).

    Warns if cameras may come too near to some points. Raises ValueError for no pairs.
    """

    def __init__(
        self,
        store: Store,
        rows: NDArray[np.int64],
        *,
        num_pairs: int | None,
        num_points: int,
        pool_size: int,
        views: Views,
        seed: Sequence[int],
        label: str,
    ) -> None:
        if num_pairs is not None and num_pairs < 1:
            raise ValueError(f"expected at least one {label} pair, got {num_pairs}")
        radius = float(store.columns["radius"][rows].max())
        self.sees_all = views.sees_all(radius)
        if not self.sees_all:
            warnings.warn(
                f"the {label} meshes reach {radius:.3g} from their origin: points that fall behind a camera at "
                f"`distance` {views.distance} get no 2D point; try normalisation unit_sphere or a larger distance",
                stacklevel=2,
            )
        self.num_pairs = len(rows) if num_pairs is None else num_pairs
        if self.num_pairs < len(rows):  # the first meshes would all be of one class
            rows = np.sort(np.random.default_rng(seed[0]).choice(rows, self.num_pairs, replace=False))
        self.store, self.rows, self.num_points, self.pool_size = store, rows, num_points, pool_size
        self.views, self.seed = views, tuple(seed)
        self._on_device: Tensor | None = None

    @property
    def counts(self) -> Counts:
        points = np.full(self.num_pairs, self.num_points)
        return Counts(points, points, points)

    def names(self, index: Sequence[int]) -> tuple[str, ...]:
        views = (divmod(i, len(self.rows)) for i in index)
        return tuple(f"{self.store.name(int(self.rows[mesh]))}#{view}" for view, mesh in views)

    def batch(self, index: Int[Tensor, " b"], epoch: int) -> Batch:
        samples = self._samples(index % len(self.rows))
        keys = row_keys(index, *self.seed, epoch)
        views = draw_views(samples, index, self.views, self.num_points, keys)
        if not self.sees_all:
            check_seen(views, self.names(index.tolist()))
        return views

    def free(self) -> None:
        """Forget the samples on the device."""
        self._on_device = None

    def _samples(self, mesh: Int[Tensor, " b"]) -> Float[Tensor, "b k 3"]:
        """Surface samples of each mesh: from the mapped files, or on another device from all samples, copied once."""
        if mesh.device.type == "cpu":
            return torch.from_numpy(np.stack([self._row(i) for i in mesh.tolist()]))
        if self._on_device is None or self._on_device.device != mesh.device:
            self._on_device = torch.empty(len(self.rows), self.pool_size, 3, device=mesh.device)
            for i in range(len(self.rows)):
                self._on_device[i] = torch.from_numpy(self._row(i).copy())
        return self._on_device[mesh]

    def _row(self, mesh: int) -> NDArray[np.float32]:
        return self.store.row(int(self.rows[mesh]))[POINTS][: self.pool_size]


def hold_out(count: int, fraction: float, *, seed: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Split range(count) at random into training rows and validation rows, at least one of each, both sorted.

    Raises ValueError for a fraction outside (0, 1) or fewer than two rows.
    """
    if not 0 < fraction < 1:
        raise ValueError(f"expected `val_fraction` between 0 and 1, got {fraction}")
    if count < 2:
        raise ValueError(f"expected at least 2 training rows, to hold one out for validation, got {count}")
    held = min(count - 1, max(1, round(fraction * count)))
    order = np.random.default_rng(seed).permutation(count)
    return np.sort(order[held:]), np.sort(order[:held])
