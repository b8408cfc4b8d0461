"""When the search stops, and what it says about its best pose: all of it is here."""

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from bpnp.distinct_poses import same_pose
from bpnp.search.candidates import Candidates
from bpnp.search.scene import Scene

Verdict = Literal["confident", "ambiguous", "failed"]


@dataclass(frozen=True, eq=False)
class SearchResult:
    """What is known of one pair's pose.

    candidates: distinct poses in the user's coordinates, float64, best first. batches: of starts that were tried.
    verdict: "confident", more starts would hardly have changed the best pose; "ambiguous", it fits about as closely as
    the bearings lie, but another one may as well; "failed", there is no pose or the best fits only loosely.
    reason: of the verdict, in words.
    """

    candidates: Candidates
    verdict: Verdict
    reason: str
    batches: int

    @property
    def best(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Rotation (3, 3) and translation (3,) of the best pose, NaN if there is none."""
        if not len(self.candidates):
            return np.full((3, 3), math.nan), np.full(3, math.nan)
        return self.candidates.rotation[0], self.candidates.translation[0]

    @property
    def residual(self) -> float:
        """Scale of the best pose's residuals, radians; infinite if there is none."""
        return float(self.candidates.scale[0]) if len(self.candidates) else math.inf


def is_safe(candidates: Candidates, scene: Scene) -> bool:
    """Whether more starts would hardly change the best pose, and no other one comes close.

    Either more points match than chance explains (`is_unique`), or the pose leads all different ones by enough, came
    out of enough batches of starts, and is plausible.
    """
    if not len(candidates):
        return False
    rule, ahead, hits = scene.settings.evidence, lead(candidates, scene), int(candidates.hits[0])
    found = (ahead > rule.far_lead and hits >= rule.far_hits) or (ahead > rule.lead and hits >= rule.hits)
    return is_unique(candidates, scene) or (found and is_plausible(candidates, scene))


def is_exhausted(candidates: Candidates, scene: Scene, stalled: int) -> bool:
    """Whether batches keep ending at the best pose, or `stalled` of them in a row did not better it."""
    rule = scene.settings.evidence
    enough = len(candidates) > 0 and (int(candidates.hits[0]) >= rule.hits or stalled >= rule.stalled)
    return enough and is_plausible(candidates, scene)


def is_unique(candidates: Candidates, scene: Scene) -> bool:
    """Whether the matched share exceeds a floor, and several times what chance matches within two scales."""
    rule = scene.settings.evidence
    by_chance = len(scene.points3d) / scene.solid_angle * math.pi * (2 * float(candidates.scale[0])) ** 2
    return bool(candidates.matched[0] > max(rule.matched, rule.over_chance * by_chance))


def is_plausible(candidates: Candidates, scene: Scene) -> bool:
    """Whether the residuals are about the spacing of the bearings or less, and enough points are matched."""
    rule = scene.settings.evidence
    spacing = 0.5 * math.sqrt(scene.solid_angle / len(scene.offsets))
    return bool(candidates.scale[0] < rule.plausible_scale * spacing and candidates.matched[0] > rule.plausible_matched)


def lead(candidates: Candidates, scene: Scene) -> float:
    """Log-likelihood of all bearings under the best pose over that under the next different one, nats."""
    limit = scene.settings.evidence.other_deg
    other = ~same_pose(candidates.rotation, candidates.translation, 0, limit, math.inf)
    gap = candidates.score[0] - candidates.score[other].max() if other.any() else math.inf
    return float(gap) * len(scene.offsets)


def judged(candidates: Candidates, scene: Scene, *, safe: bool, batches: int) -> SearchResult:
    """The candidates of a scene in the user's coordinates, with the verdict on the best of them.

    safe: whether the search ended because its best pose was (`is_safe`).
    """
    counts = f"{len(scene.offsets)} 2D and {len(scene.points3d)} 3D points"
    if not len(candidates):
        return no_pose(f"no pose fits: {counts}, too few or all on one line", batches)
    verdict, reason = _judge(candidates, scene, safe)
    rotation, translation = scene.leave(candidates.rotation, candidates.translation)
    score, matched, scale = (
        values.astype(np.float64) for values in (candidates.score, candidates.matched, candidates.scale)
    )
    return SearchResult(
        Candidates(rotation, translation, score, matched, scale, candidates.hits), verdict, reason, batches
    )


def no_pose(reason: str, batches: int = 0) -> SearchResult:
    """Of points that fix no pose, or for which none was found."""
    return SearchResult(Candidates.unscored(np.empty((0, 3, 3)), np.empty((0, 3))), "failed", reason, batches)


def _judge(candidates: Candidates, scene: Scene, safe: bool) -> tuple[Verdict, str]:
    if safe:
        return "confident", "the matches are unique, or the pose leads all others and was found again and again"
    if not is_plausible(candidates, scene):
        return "failed", "no pose fits closely; more batches, more time or a prior may help"
    gap = lead(candidates, scene)
    if gap <= scene.settings.evidence.lead:
        return "ambiguous", f"another pose explains the points nearly as well, {gap:.0f} nats behind"
    return "ambiguous", "the pose fits and leads, but too few batches of starts came upon it to be sure"
