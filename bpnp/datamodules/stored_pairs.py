"""Pairs of point sets in a data store: 50,000 of them open at once."""

import warnings
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int
from numpy.typing import NDArray
from torch import Tensor

from bpnp.datamodules.pair import Counts, Pair, stacked
from bpnp.datamodules.store import Store, StoreError, StoreWriter, new_store
from bpnp.geometry import MIN_POINTS
from bpnp.types import Batch

PAIRS = "pairs"  # the kind of such a store
WIDTHS = {"points2d": 2, "points3d": 3}


def write_pairs(
    folder: Path, pairs: Iterable[tuple[str, Pair]], *, parameters: Mapping[str, Any] | None = None
) -> None:
    """Write (scene, pair) after (scene, pair) into the new store `folder`; complete or not there at all.

    parameters: kept in the manifest, must be JSON.
    Raises StoreError if the folder exists.
    """
    with new_store(folder, PAIRS, WIDTHS) as writer:
        for scene, pair in pairs:
            add_pair(writer, scene, pair)
        writer.parameters |= parameters or {}


def add_pair(writer: StoreWriter, scene: str, pair: Pair) -> None:
    writer.add(
        pair.name,
        {"points2d": pair.points2d, "points3d": pair.points3d},
        scene=np.bytes_(scene.encode()),
        matched=np.int64(pair.matched),
        focal=np.float64(pair.focal),
        rotation=np.asarray(pair.rotation, np.float64),
        translation=np.asarray(pair.translation, np.float64),
        origin=np.zeros(3) if pair.origin is None else np.asarray(pair.origin, np.float64),
    )


def stored_pair(store: Store, row: int) -> Pair:
    """The pair in a row; its points are views of the mapped files. StoreError if they are not what was written."""
    points, columns = store.row(row), store.columns
    return Pair(
        name=store.name(row),
        points2d=points["points2d"],
        points3d=points["points3d"],
        matched=int(columns["matched"][row]),
        rotation=columns["rotation"][row],
        translation=columns["translation"][row],
        focal=float(columns["focal"][row]),
        origin=columns["origin"][row],
    )


def scene_rows(store: Store) -> dict[str, NDArray[np.int64]]:
    """The rows of each scene, scenes in the order of their first row."""
    names, first, scene = np.unique(store.columns["scene"], return_index=True, return_inverse=True)
    return {bytes(names[i]).decode(): np.flatnonzero(scene == i) for i in np.argsort(first)}


class StoredPairs:
    """A `PairSource`: rows of a store of pairs. Raises ValueError as `enough_pairs`."""

    def __init__(self, store: Store, rows: NDArray[np.int64], *, min_points: int) -> None:
        self.store = store
        self.rows = rows[enough_pairs(store.columns["matched"][rows], min_points, str(store.folder))]

    @property
    def counts(self) -> Counts:
        matched = self.store.columns["matched"][self.rows]
        points2d, points3d = (self.store.counts(name)[self.rows] for name in WIDTHS)
        return Counts(matched, points2d, points3d)

    def names(self, index: Sequence[int]) -> tuple[str, ...]:
        return tuple(self.store.name(int(self.rows[i])) for i in index)

    def batch(self, index: Int[Tensor, " b"], epoch: int) -> Batch:
        return stacked([stored_pair(self.store, int(self.rows[i])) for i in index.tolist()], index)


def check_limits(min_points: int, *max_points: int | None) -> None:
    """Raises ValueError for fewer than 4 points, or a largest number below the smallest."""
    if min_points < MIN_POINTS:
        raise ValueError(f"expected `min_points` of {MIN_POINTS} or more, got {min_points}: fewer do not fix a pose")
    for most in max_points:
        if most is not None and most < min_points:
            raise ValueError(f"expected `max_points` of at least `min_points` = {min_points}, got {most}")


def enough_pairs(matched: NDArray[np.int64], min_points: int, where: str) -> NDArray[np.int64]:
    """Which pairs have `min_points` true pairs or more; the others are warned about.

    Raises StoreError if there are none.
    """
    kept = np.flatnonzero(matched >= min_points)
    if not len(kept):
        raise StoreError(
            f"expected pairs of {min_points} or more matched points in {where}, got none of {len(matched)}; try a "
            "smaller `min_points` or other scenes"
        )
    if skipped := len(matched) - len(kept):
        warnings.warn(
            f"skipped {skipped} of {len(matched)} pairs of {where}: fewer than {min_points} true pairs", stacklevel=3
        )
    return kept
