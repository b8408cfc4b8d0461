"""The poses that a search has found so far, and the verdict on them."""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from bpnp.search.annealing import finish
from bpnp.search.candidates import Candidates, best_distinct, in_user_frame, merged
from bpnp.search.evidence.repetitions import decades_behind, repeated_poses
from bpnp.search.evidence.thresholds import Evidence
from bpnp.search.point_sets import PointSets
from bpnp.search.scene import Scene
from bpnp.search.verdict import SearchResult, is_certain, is_settled, judged, weighed_leaders, with_false_alarms


class Pool:
    """Distinct poses of a scene, best first, from all batches of starts and looks of a search.

    few: the result of the enumeration of few points, whose poses are the first. candidates: at most `settings.kept`.
    turned: the likeliest ones of different rotations. batches: so far. new: whether the last batch bettered the best
    pose, and no look has followed.
    """

    def __init__(self, scene: Scene, sets: PointSets, few: SearchResult) -> None:
        self.scene, self.sets, self.few = scene, sets, few
        self.batches, self.new = 0, False
        self.candidates = self.turned = Candidates.none()
        if len(few.candidates):
            rotation, translation = scene.enter(few.candidates.rotation, few.candidates.translation)
            self.candidates = replace(few.candidates, rotation=rotation, translation=translation)

    def merge(self, found: Candidates) -> None:
        """Take up the poses of a batch or a look.

        They are weighed where a pose of before exceeds chance, which would else displace a better one beside it.
        """
        if (self.candidates.log10_false_alarms < 0).any():
            found, _ = weighed_leaders(found, self.scene, self.sets)
        self.candidates, self.new = merged([self.candidates, found], self.scene), False

    def leaders(self) -> Candidates:
        """The best candidates as a verdict needs them; what chance says of them is kept."""
        self.candidates, leaders = weighed_leaders(self.candidates, self.scene, self.sets)
        return leaders

    def is_settled(self) -> bool:
        """Whether a verdict could be confident of one of the candidates: only then is there need to weigh them."""
        each, rule = (self.candidates[k : k + 1] for k in range(len(self.candidates))), self.scene.settings.evidence
        return any(is_settled(one, self.sets, rule, batches=self.batches) for one in each)

    def different(self, parts: list[Candidates]) -> Candidates:
        """The best poses of several sets of them, no two turned by less than `settings.beside_deg`."""
        rule, together = self.scene.settings, Candidates.concatenated(parts)
        return best_distinct(together, self.scene, rule.beside_poses, degrees=rule.beside_deg, shift=math.inf)

    def certain(self, leaders: Candidates) -> SearchResult | None:
        """The result, if it is confident and holds on all bearings too."""
        if not is_certain(leaders, self.sets, self.scene.settings.evidence, batches=self.batches, new=self.new):
            return None
        result = self._judged(self.candidates, 1, new=False)
        return result if result.verdict == "confident" else None

    def result(self) -> SearchResult:
        """The verdict on the best candidates, annealed to the end on all points."""
        return self._judged(self.candidates, self.scene.settings.finished, new=self.new)

    def _judged(self, poses: Candidates, annealed: int, *, new: bool) -> SearchResult:
        scene, sets, rule = self.scene, self.sets, self.scene.settings.evidence
        ends = finish(scene, poses, annealed) if len(poses) else poses
        if sets.prior is not None and len(ends):  # of a pose before and after, that which chance explains less
            ends, _ = weighed_leaders(ends, scene, sets)
            ends = best_distinct(Candidates.concatenated([ends, poses]), scene, scene.settings.kept)
        result = judged(in_user_frame(ends, scene), sets, batches=self.batches, new=new, rule=rule)
        if self.few.log10_false_alarms < result.log10_false_alarms:
            return replace(self.few, batches=self.batches)
        return against_repetitions(result, sets, lambda: scene, rule)


def against_repetitions(
    result: SearchResult, sets: PointSets, entered: Callable[[], Scene], rule: Evidence, *, exhaustive: bool = False
) -> SearchResult:
    """A confident result once more, beside the poses that a repeated structure would confuse with it; if one of these
    is better, so is that one."""
    if result.verdict != "confident":
        return result
    best, scale = result.best, max(result.residual, sets.image.scales[0])
    repeated, compared = repeated_poses(sets, *best, scale, rule)
    if not len(repeated[0]):
        return result
    scene = entered()
    starts = Candidates.unscored(*scene.enter(*repeated))
    starts = replace(starts, scale=np.full(len(starts), scale, np.float32))
    ends = finish(scene, starts)  # none after the deadline
    rivals = with_false_alarms(in_user_frame(ends if len(ends) else starts, scene), sets)
    behind = decades_behind(sets, best, repeated, (rivals.rotation, rivals.translation), scale)
    behind = np.maximum(behind, 0) if compared else np.zeros(len(rivals))
    alarms = np.minimum(rivals.log10_false_alarms, result.log10_false_alarms + behind)
    candidates = Candidates.concatenated([result.candidates, replace(rivals, log10_false_alarms=alarms)])
    beside = judged(candidates, sets, batches=result.batches, exhaustive=exhaustive, rule=rule)
    if np.array_equal(beside.best[1], best[1]):
        return beside
    return against_repetitions(beside, sets, entered, rule, exhaustive=exhaustive)
