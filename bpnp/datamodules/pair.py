"""One pair of point sets as a source gives it, and how pairs become a batch."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Int
from numpy.typing import NDArray
from torch import Tensor

from bpnp.types import Batch


@dataclass(frozen=True)
class Pair:
    """One image's points and the scene's points; see `bpnp.types` for the conventions.

    points2d (m, 2) normalised, points3d (n, 3), rotation (3, 3), translation (3,), focal pixels per unit of normalised
    coordinates. The first `matched` points of both sides are the true pairs, in the same order; the others have no
    partner. origin (3,): what was subtracted from the scene's coordinates, for scenes so far from theirs that float32
    would lose digits; None for nothing.
    """

    name: str
    points2d: NDArray[np.float32]
    points3d: NDArray[np.float32]
    matched: int
    rotation: NDArray[np.float64]
    translation: NDArray[np.float64]
    focal: float
    origin: NDArray[np.float64] | None = None

    @classmethod
    def from_matches(
        cls,
        name: str,
        points2d: NDArray[np.floating],
        points3d: NDArray[np.floating],
        rotation: NDArray[np.floating],
        translation: NDArray[np.floating],
        match3d: NDArray[np.integer],
        focal: float,
        origin: NDArray[np.float64] | None = None,
    ) -> "Pair":
        """The pair of two sets in any order; match3d (n,) is the 2D point of each 3D point, -1 for none.

        Raises ValueError that names the pair: shapes that do not fit, NaN or infinity, or a match3d that holds no
        integers, an index that is no 2D point, or one 2D point twice.
        """
        m, n, match = len(points2d), len(points3d), np.asarray(match3d)
        shapes = np.shape(points2d), np.shape(points3d), match.shape
        if shapes != ((m, 2), (n, 3), (n,)):
            raise ValueError(
                f"expected `points2d` (m, 2), `points3d` (n, 3) and `match3d` (n,), got {shapes} in {name!r}"
            )
        if not np.issubdtype(match.dtype, np.integer):
            raise ValueError(
                f"expected `match3d` as integers, indices of 2D points, got {match.dtype} in {name!r}; try .astype(int)"
            )
        if n and not -1 <= match.min() <= match.max() < m:
            raise ValueError(
                f"expected `match3d` between -1 and {m - 1}, got {match.min()} to {match.max()} in {name!r}"
            )
        numbers = (points2d, points3d, rotation, translation, focal, 0.0 if origin is None else origin)
        if not all(np.isfinite(values).all() for values in numbers):
            raise ValueError(f"expected finite points, pose and focal, got NaN or infinity in {name!r}")
        true3d = np.flatnonzero(match >= 0)
        true2d = match[true3d]
        if len(np.unique(true2d)) < len(true2d):
            raise ValueError(f"expected at most one 3D point for each 2D point, got two in `match3d` of {name!r}")
        order2d = np.concatenate([true2d, np.setdiff1d(np.arange(m), true2d)])
        order3d = np.concatenate([true3d, np.flatnonzero(match < 0)])
        return cls(
            name,
            points2d[order2d].astype(np.float32),
            points3d[order3d].astype(np.float32),
            len(true3d),
            np.asarray(rotation, np.float64),
            np.asarray(translation, np.float64),
            focal,
            origin,
        )


class Counts(NamedTuple):
    """True pairs, 2D points and 3D points of each pair of a source (k,)."""

    matched: NDArray[np.int64]
    points2d: NDArray[np.int64]
    points3d: NDArray[np.int64]


@runtime_checkable
class PairSource(Protocol):
    """An indexed set of pairs, before their augmentation."""

    @property
    def counts(self) -> Counts:
        """Points of each pair."""

    def names(self, index: Sequence[int]) -> tuple[str, ...]: ...

    def batch(self, index: Int[Tensor, " b"], epoch: int) -> Batch:
        """Pairs as `stacked` makes them, ids apart: each a function of its index, the epoch and the source's seed."""


def stacked(pairs: Sequence[Pair], index: Int[Tensor, " b"]) -> Batch:
    """Pad and mask pairs: 3D point j of the batch was seen as 2D point j, or (match3d -1) not at all.

    Points are float32, poses float64.
    """
    size = len(pairs)
    count2d, count3d = (torch.tensor([len(getattr(p, f"points{d}d")) for p in pairs])[:, None] for d in (2, 3))
    matched = torch.tensor([pair.matched for pair in pairs])[:, None]
    points2d = np.zeros((size, int(count2d.max()), 2), np.float32)
    points3d = np.zeros((size, int(count3d.max()), 3), np.float32)
    for i, pair in enumerate(pairs):
        points2d[i, : len(pair.points2d)] = pair.points2d
        points3d[i, : len(pair.points3d)] = pair.points3d
    places = torch.arange(points3d.shape[1])
    return Batch(
        points2d=torch.from_numpy(points2d),
        points3d=torch.from_numpy(points3d),
        mask2d=torch.arange(points2d.shape[1]) < count2d,
        mask3d=places < count3d,
        focal=torch.tensor([pair.focal for pair in pairs], dtype=torch.float32),
        index=index,
        ids=tuple(pair.name for pair in pairs),
        rotation=torch.from_numpy(np.stack([pair.rotation for pair in pairs])),
        translation=torch.from_numpy(np.stack([pair.translation for pair in pairs])),
        match3d=torch.where(places < matched, places, -1),
        origin=torch.from_numpy(np.stack([np.zeros(3) if p.origin is None else p.origin for p in pairs])),
    )
