"""When a search stops, and what it says about its best pose: all of it is here.

The currency is the number of false alarms (`bpnp.search.evidence.false_alarms`): how many poses would fit as well if
the image had nothing to do with the scene. "confident": fewer than `Evidence.false_alarms`; every different pose has at
least 1 / `Evidence.lead` times as many, and explains clearly fewer of the image points (`evidence.rivals`); the same
one taken roughly has no fewer; no search elsewhere is missing; and the matches fix the rotation. "ambiguous": better
than chance, but one of the conditions is not met. "failed": no pose, or none better than chance.
"""

import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from bpnp.distinct_poses import turned_by
from bpnp.search.candidates import Candidates, in_user_frame
from bpnp.search.evidence.false_alarms import alarms_of
from bpnp.search.evidence.rivals import contested_by
from bpnp.search.evidence.thresholds import Evidence
from bpnp.search.evidence.uncertainty import linearised, rotation_bound, systematic_misfit
from bpnp.search.point_sets import PointSets
from bpnp.search.scene import Scene
from bpnp.search.settings import DEFAULT

Verdict = Literal["confident", "ambiguous", "failed"]


@dataclass(frozen=True, eq=False)
class SearchResult:
    """What is known of one pair's pose.

    candidates: distinct poses in the user's coordinates, float64, best first. batches: of starts that were tried.
    verdict: see the head of this file. reason: of the verdict, in words.
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

    @property
    def log10_false_alarms(self) -> float:
        """Of the best pose; infinite if there is none."""
        return float(self.candidates.log10_false_alarms[0]) if len(self.candidates) else math.inf


def with_false_alarms(candidates: Candidates, sets: PointSets) -> Candidates:
    """The candidates, in the user's coordinates, with their false alarms; those that have them already keep them."""
    alarms, rough = candidates.log10_false_alarms.copy(), candidates.log10_rough.copy()
    new = np.isnan(alarms)
    if not new.any():
        return candidates
    unknown = candidates[new]
    alarms[new], rough[new] = alarms_of(sets, unknown.rotation, unknown.translation, unknown.scale)
    return replace(candidates, log10_false_alarms=alarms, log10_rough=rough)


def weighed(candidates: Candidates, sets: PointSets, rule: Evidence = DEFAULT.evidence) -> Candidates:
    """The candidates, in the user's coordinates, with their false alarms; the best first, the others as they were.

    Best is the first one whose false alarms exceed the fewest by less than the lead that a verdict asks for: among
    poses that chance cannot tell apart, the order of the search, which is that of the likelihood, decides.
    """
    if not len(candidates):
        return candidates
    candidates = with_false_alarms(candidates, sets)
    alarms = candidates.log10_false_alarms
    first = int(np.flatnonzero(alarms <= alarms.min() + rule.lead)[0])
    order = np.r_[first, np.delete(np.arange(len(alarms)), first)]
    return candidates[order]


def weighed_leaders(candidates: Candidates, scene: Scene, sets: PointSets) -> tuple[Candidates, Candidates]:
    """The candidates of a scene, of which the first ones have their false alarms; and those as a verdict needs them."""
    count = scene.settings.finished if sets.prior is None else scene.settings.kept
    leaders = with_false_alarms(in_user_frame(candidates[:count], scene), sets)
    known = {
        name: np.concatenate([getattr(leaders, name), getattr(candidates, name)[count:]])
        for name in ("log10_false_alarms", "log10_rough")
    }
    return replace(candidates, **known), weighed(leaders, sets, scene.settings.evidence)


def lead(candidates: Candidates, sets: PointSets, rule: Evidence = DEFAULT.evidence) -> tuple[float, int]:
    """Decades by which the best pose has fewer false alarms than the next different one, and the place of that one.

    Different: turned by more than `other_deg`, or the middle of the scene moved by more than `other_shift` of its
    distance. Infinite and -1 if there is none.
    """
    same = sets.same_pose(candidates.rotation, candidates.translation, rule.other_deg, rule.other_shift)
    others = np.flatnonzero(~same)
    if not len(others):
        return math.inf, -1
    nearest = int(others[np.argmin(candidates.log10_false_alarms[others])])
    return float(candidates.log10_false_alarms[nearest] - candidates.log10_false_alarms[0]), nearest


def is_certain(
    candidates: Candidates,
    sets: PointSets,
    rule: Evidence = DEFAULT.evidence,
    *,
    exhaustive: bool = False,
    batches: int = 0,
    new: bool = False,
) -> bool:
    """Whether weighed candidates leave no doubt about the first: the verdict "confident".

    exhaustive: whether every pose that fits some points was looked at. Otherwise a better one may have been missed,
    unless enough batches of starts found this one, or its matches are unique. new: whether the last batch bettered it;
    if it leaves many points unmatched it may lie beside a better one, which starts around it find in the next batch.
    """
    if not len(candidates):
        return False
    doubtful = new and candidates.matched[0] < rule.well_matched
    found = exhaustive or (is_settled(candidates, sets, rule, batches=batches) and not doubtful)
    chance = float(candidates.log10_false_alarms[0]) <= rule.false_alarms
    return chance and found and not is_rough(candidates) and lead(candidates, sets, rule)[0] >= rule.lead


def is_settled(candidates: Candidates, sets: PointSets, rule: Evidence = DEFAULT.evidence, *, batches: int) -> bool:
    """Whether enough batches of starts found the first candidate, or its matches are unique."""
    well_matched = batches >= rule.hits and candidates.matched[0] >= rule.well_matched
    repeated = int(candidates.hits[0]) >= (rule.well_matched_hits if well_matched else rule.hits)
    return repeated or is_unique(candidates, sets, rule)


def is_rough(candidates: Candidates) -> bool:
    """Whether the points agree with the best pose better at scales far beyond that of its residuals: what its matches
    say of it beyond a rough alignment is then no more than chance."""
    return bool(candidates.log10_rough[0] < candidates.log10_false_alarms[0])


def is_unique(candidates: Candidates, sets: PointSets, rule: Evidence = DEFAULT.evidence) -> bool:
    """Whether the matched share of the best pose exceeds a floor, and several times what chance matches within 2 s.

    A pose at which a part of the scene is aligned is no coincidence, but its residuals are too large for this.
    """
    by_chance = len(sets.points3d) / sets.image.solid_angle * math.pi * (2 * float(candidates.scale[0])) ** 2
    return bool(candidates.matched[0] > max(rule.matched, rule.over_chance * by_chance))


def is_exhausted(candidates: Candidates, scene: Scene, stalled: float) -> bool:
    """Whether a search should end though no pose is certain: batches keep ending at the best one, or stall.

    stalled: starts since it was bettered, in full batches. It has to be plausible: its residuals about the spacing of
    the bearings or less, and enough points matched; otherwise the right pose has not been met yet.
    """
    rule = scene.settings.evidence
    if not len(candidates) or (int(candidates.hits[0]) < rule.enough_hits and stalled < rule.stalled):
        return False
    spacing = 0.5 * math.sqrt(scene.solid_angle / len(scene.offsets))
    return bool(candidates.scale[0] < rule.plausible_scale * spacing and candidates.matched[0] > rule.plausible_matched)


def judged(
    candidates: Candidates, sets: PointSets, *, batches: int, exhaustive: bool = False, new: bool = False,
    rule: Evidence = DEFAULT.evidence,
) -> SearchResult:  # fmt: skip
    """The verdict on candidates in the user's coordinates, best first. exhaustive, new: as in `is_certain`."""
    if not len(candidates):
        return no_pose("no pose was found", batches)
    candidates = weighed(candidates, sets, rule)
    alarms, (ahead, other) = float(candidates.log10_false_alarms[0]), lead(candidates, sets, rule)
    chance = f"unrelated points are expected to fit as well under {_number(alarms)} of all poses"
    count = float(candidates.matched[0]) * min(len(sets.bearings), len(sets.points3d))
    certain = is_certain(candidates, sets, rule, exhaustive=exhaustive, batches=batches, new=new)
    off, bent, rival = math.inf, False, -1
    if certain:
        pairs = linearised(sets, candidates.rotation[0], candidates.translation[0], float(candidates.scale[0]))
        off = math.degrees(rotation_bound(sets, pairs, count))
        misfit = systematic_misfit(pairs, count)
        bent = math.degrees(misfit.turn) > rule.other_deg or misfit.shift > rule.other_shift
        rival = contested_by(candidates, sets, rule)
    if certain and off <= rule.loose_deg and not bent and rival < 0:
        return SearchResult(candidates, "confident", f"{chance}, and no different pose comes near", batches)
    if alarms > 0:
        return SearchResult(candidates, "failed", f"no pose fits better than chance: {chance}", batches)
    degrees = math.degrees(turned_by(candidates.rotation[0], candidates.rotation[other if rival < 0 else rival]))
    if ahead < rule.lead:
        reason = f"{chance}, but a pose {degrees:.0f} deg away fits about as well ({_number(ahead)} times the number)"
    elif alarms > rule.false_alarms:
        reason = f"{chance}: too many to be sure"
    elif is_rough(candidates):
        reason = f"{chance}, but the points agree with it better at residuals far larger than those of its matches"
    elif bent:
        reason = (
            f"{chance}, but with another focal length or other proportions of the scene they fit significantly better, "
            f"{math.degrees(misfit.turn):.0f} deg and {100 * misfit.shift:.0f} % of the distance away"
        )
    elif rival >= 0:
        reason = f"{chance}, but a pose {degrees:.0f} deg away explains so many other points that both may be chance"
    elif certain:
        reason = f"{chance}, but so few and near matches leave its rotation loose: it may be {off:.1f} deg off"
    else:
        reason = f"{chance}, but too few batches of starts came upon this pose to be sure that no better one was missed"
    return SearchResult(candidates, "ambiguous", reason, batches)


def no_pose(reason: str, batches: int = 0) -> SearchResult:
    """Of points that fix no pose, or for which none was found."""
    return SearchResult(Candidates.unscored(np.empty((0, 3, 3)), np.empty((0, 3))), "failed", reason, batches)


def _number(log10: float) -> str:
    """10^x in words that can be read at a glance."""
    return f"{10**log10:.2g}" if -3 < log10 < 5 else f"1e{log10:.0f}"
