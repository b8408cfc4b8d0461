"""The distinct poses that a search has met, and how sure the best of them is."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bpnp.distinct_poses import SAME_DEG, SAME_SHIFT, distinct, near
from bpnp.search.scene import Scene
from bpnp.search.starts import Array

OTHER_DEG = 10.0  # poses farther apart than this answer differently
FAR_AHEAD, FAR_HITS, AHEAD, SAFE_HITS = 100.0, 2, 20.0, 4  # nats, and batches that found the pose
SAFE_MATCHED, OVER_CHANCE, PLAUSIBLE, PLAUSIBLE_MATCHED = 0.2, 6.0, 2.0, 0.25
MOST_STALLED, BETTER = 4, 0.002  # batches, and nats a bearing


class Pool(NamedTuple):
    """Distinct poses in the frame of a `Scene`, best first.

    result (c, 3): likelihood, matched share and scale. hits (c,): batches whose own starts ended there.
    """

    rotation: Array
    translation: Array
    result: Array
    hits: NDArray[np.int64]

    def joined(self, other: "Pool", count: int) -> "Pool":
        """The best `count` distinct poses of both; a pose that both have counts the hits of both."""
        rotation = np.concatenate([self.rotation, other.rotation])
        translation = np.concatenate([self.translation, other.translation])
        result, hits = np.concatenate([self.result, other.result]), np.concatenate([self.hits, other.hits])
        kept = distinct(rotation, translation, result[:, 0], count, SAME_DEG, SAME_SHIFT)
        total = np.array(
            [hits[near(rotation, translation, i, SAME_DEG, SAME_SHIFT)].sum() for i in kept.tolist()], dtype=np.int64
        )  # fmt: skip
        return Pool(rotation[kept], translation[kept], result[kept], total)


def is_safe(pool: Pool, scene: Scene) -> bool:
    """Whether more starts would hardly change the answer, and no other pose comes close.

    A pose whose matches are unique says so itself. Where points lie as close as the residuals, the pose must lead the
    others and have come out of several batches while none found a better one.
    """
    ahead, hits = lead(pool, scene), int(pool.hits[0])
    found = (ahead > FAR_AHEAD and hits >= FAR_HITS) or (ahead > AHEAD and hits >= SAFE_HITS)
    return unique(pool, scene) or (found and plausible(pool, scene))


def is_exhausted(pool: Pool, scene: Scene, stalled: int) -> bool:
    """Whether batches keep ending at the best pose, or `stalled` of them in a row did not better it."""
    return (int(pool.hits[0]) >= SAFE_HITS or stalled >= MOST_STALLED) and plausible(pool, scene)


def unique(pool: Pool, scene: Scene) -> bool:
    """Whether many points are matched at a scale at which chance would give few of them a neighbour."""
    _, matched, scale = pool.result[0]
    chance = len(scene.points3d) / scene.solid_angle * math.pi * (2 * float(scale)) ** 2
    return bool(matched > max(SAFE_MATCHED, OVER_CHANCE * chance))


def plausible(pool: Pool, scene: Scene) -> bool:
    """Whether the residuals are about the spacing of the bearings or less, and enough points are matched.

    Larger residuals say that only a shape fits. Any pose has some neighbours: wrong ones of sparse points had up to a
    quarter of the points matched.
    """
    _, matched, scale = pool.result[0]
    spacing = 0.5 * math.sqrt(scene.solid_angle / len(scene.bearings))
    return bool(scale < PLAUSIBLE * spacing and matched > PLAUSIBLE_MATCHED)


def lead(pool: Pool, scene: Scene) -> float:
    """Log-likelihood of all bearings under the best pose over that under the next other one, nats."""
    other = ~near(pool.rotation, pool.translation, 0, OTHER_DEG, math.inf)
    gap = pool.result[0, 0] - pool.result[other, 0].max() if other.any() else math.inf
    return float(gap) * len(scene.bearings)
