"""Candidate poses of one problem: the one record of them, and how poses that are the same are merged."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bpnp.geometry import distinct, same_pose
from bpnp.search.scene import Scene

EXCEEDS = 1e3  # nats a bearing, more than any log-likelihood


@dataclass(frozen=True, eq=False)
class Candidates:
    """c poses of one problem, camera = R p + t, and how well they explain the bearings.

    rotation: (c, 3, 3). translation: (c, 3). In the frame of a `Scene` in float32, in that of the user in float64.
    score: (c,) mean log-likelihood of the bearings, nats; -inf for a pose that the points do not fix.
    matched: (c,) expected share of min(m, n) points that have a partner.
    scale: (c,) standard deviation of the residuals per axis, radians, at which score and matched were taken.
    hits: (c,) independent starts that ended at this pose.
    log10_false_alarms: (c,) how likely chance fits as well (`bpnp.search.evidence.false_alarms`), log10_rough: the same
        at scales far beyond that of the residuals; NaN before they are weighed.
    """

    rotation: NDArray[Any]
    translation: NDArray[Any]
    score: NDArray[Any]
    matched: NDArray[Any]
    scale: NDArray[Any]
    hits: NDArray[np.int64]
    log10_false_alarms: NDArray[np.float64]
    log10_rough: NDArray[np.float64]

    @classmethod
    def unscored(cls, rotation: NDArray[Any], translation: NDArray[Any], *, hits: int = 0) -> "Candidates":
        """Poses to start from."""
        c = len(rotation)
        score, zero, unknown = np.full(c, -math.inf, np.float32), np.zeros(c, np.float32), np.full(c, math.nan)
        return cls(rotation, translation, score, zero, zero, np.full(c, hits, np.int64), unknown, unknown)

    @classmethod
    def none(cls) -> "Candidates":
        return cls.unscored(np.empty((0, 3, 3), np.float32), np.empty((0, 3), np.float32))

    @property
    def preference(self) -> NDArray[np.float64]:
        """(c,) what is largest for the best: the score, and above any score a pose that is known to exceed chance."""
        exceeds = self.log10_false_alarms < 0  # not NaN
        return np.where(exceeds, EXCEEDS - self.log10_false_alarms, self.score)

    def without_hits(self) -> "Candidates":
        """These poses, of starts that were not independent."""
        return replace(self, hits=np.zeros_like(self.hits))

    def __len__(self) -> int:
        return len(self.rotation)

    def __getitem__(self, chosen: slice | NDArray[Any]) -> "Candidates":
        return Candidates(*(getattr(self, f.name)[chosen] for f in fields(self)))

    @classmethod
    def concatenated(cls, parts: "Sequence[Candidates]") -> "Candidates":
        """All poses of the parts, one after the other."""
        return cls(*(np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(cls)))


def best_distinct(candidates: Candidates, scene: Scene, count: int, apart_deg: float | None = None) -> Candidates:
    """The best `count` poses of a scene of which no two are the same, or turned by less than `apart_deg`; best first.

    A pose has the hits of all poses that are the same.
    """
    settings = scene.settings
    limits = (settings.same_deg, settings.same_shift) if apart_deg is None else (apart_deg, math.inf)
    poses = candidates.rotation, candidates.translation * scene.shift_weight
    kept = distinct(*poses, candidates.preference, count, *limits)
    if not len(kept):
        return candidates[kept]
    same = same_pose(*poses, kept, *limits)
    first = same & (np.cumsum(same, 0) == 1)  # a pose near two counts for the better one
    return replace(candidates[kept], hits=first @ candidates.hits)


def merged(parts: Sequence[Candidates], scene: Scene) -> Candidates:
    """The best distinct poses of several batches; a pose has the hits of all batches that found it."""
    return best_distinct(Candidates.concatenated(parts), scene, scene.settings.kept)


def in_user_frame(candidates: Candidates, scene: Scene) -> Candidates:
    """Candidates of a scene in the coordinates and unit of the user, in float64."""
    rotation, translation = scene.leave(candidates.rotation, candidates.translation)
    score, matched, scale = (
        values.astype(np.float64) for values in (candidates.score, candidates.matched, candidates.scale)
    )
    return replace(candidates, rotation=rotation, translation=translation, score=score, matched=matched, scale=scale)


def in_scene_frame(candidates: Candidates, scene: Scene) -> Candidates:
    """Candidates of the user in the frame of a scene."""
    rotation, translation = scene.enter(candidates.rotation, candidates.translation)
    return replace(candidates, rotation=rotation, translation=translation)
