"""From pairs of point sets to padded batches: what a source must offer, and how its pairs are put together."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Pair:
    """One image's points and the scene's points; see `bpnp.types` for the conventions.

    points2d (m, 2) normalised, points3d (n, 3), rotation (3, 3), translation (3,), match3d (n,) index into points2d
    or -1, focal pixels per unit of normalised coordinates.
    """

    name: str
    points2d: NDArray[np.float32]
    points3d: NDArray[np.float32]
    rotation: NDArray[np.float64]
    translation: NDArray[np.float64]
    match3d: NDArray[np.int64]
    focal: float


class PairSource(Protocol):
    """An indexed set of pairs. `pair` is a pure function of its arguments and the source's seed."""

    @property
    def sizes(self) -> NDArray[np.int64]:
        """Points of the larger side of each pair, one entry a pair: what padding costs."""

    def pair(self, index: int, epoch: int) -> Pair: ...
