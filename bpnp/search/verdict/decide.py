"""Verdict on the best pose of a search.

The criterion is the number of false alarms (NFA, `bpnp.search.verdict.false_alarms`): the expected number of poses
that fit as well if image and scene are unrelated.

- "confident": log10 NFA is at most `Evidence.false_alarms`. The margin to every competing pose is at least
  `Evidence.margin` decades. log10 of the probability that the search missed a better optimum is at most
  `Evidence.missed` (`bpnp.search.verdict.completeness`).
- "ambiguous": The best pose fits better than chance (log10 NFA below 0), but one of the three conditions does not
  hold. Points that do not fix the rotation or the focal length give this verdict too.
- "failed": No pose was found, or none fits better than chance.
"""

import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from bpnp.search.config import DEFAULT, Evidence
from bpnp.search.hypotheses import Hypotheses
from bpnp.search.problem import Problem
from bpnp.search.propose.collinear import find_line
from bpnp.search.propose.repetitions import matched_points, registered
from bpnp.search.propose.symmetries import Motions
from bpnp.search.verdict import reasons
from bpnp.search.verdict.competitors import (
    CandidatesOfCameras,
    other_camera,
    other_pose,
    rough_residuals,
    unrelated_competitor,
)
from bpnp.search.verdict.completeness import log10_missed
from bpnp.search.verdict.false_alarms import alarms_of
from bpnp.search.verdict.reasons import CLAUSES, CONFIDENT, Objection, focal_length_not_fixed, objection
from bpnp.search.verdict.uncertainty import error_bounds, is_redundant, linearised, systematic_misfit

Verdict = Literal["confident", "ambiguous", "failed"]
HALF_TURN = 180.0  # a larger bound does not constrain a rotation [degrees; derived]
REFINED = math.inf  # number of local searches that the exact refinement of an enumeration replaces


@dataclass(frozen=True, eq=False)
class SearchResult:
    """Result of the search for the pose of one problem.

    Attributes:
        candidates: Distinct poses in the frame of the problem, float64, best first.
        verdict: Confident, ambiguous or failed, as defined at the head of this file.
        reason: Reason of the verdict, a plain sentence.
        batches: Number of iterations of the search.
        code: Kind of the reason, "confident" or a key of `bpnp.search.verdict.reasons.CLAUSES`.
        settled: True if more search would not change the verdict. A better optimum is then excluded without the
            evidence of the matches.
    """

    candidates: Hypotheses
    verdict: Verdict
    reason: str
    batches: int
    code: str
    settled: bool = False

    def add_objection(self, one: Objection, verdict: Verdict = "ambiguous") -> "SearchResult":
        """Return a copy that is ambiguous, or failed, for a reason."""
        return replace(self, verdict=verdict, reason=one.sentence(self.log10_false_alarms), code=one.code)

    def as_insignificant(self, most: float) -> "SearchResult":
        """Return a copy that is ambiguous, since its log10 NFA is above `most`."""
        reason = reasons.insignificant(self.log10_false_alarms, most)
        return replace(self, verdict="ambiguous", reason=reason, code="insignificant")

    @property
    def best(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Rotation (3, 3) and translation (3,) of the best pose; NaN if there is none."""
        if not len(self.candidates):
            return np.full((3, 3), math.nan), np.full(3, math.nan)
        return self.candidates.pose()

    @property
    def residual(self) -> float:
        """Scale of the residuals of the best pose, radians; infinite if there is none."""
        return float(self.candidates.scale[0]) if len(self.candidates) else math.inf

    @property
    def log10_false_alarms(self) -> float:
        """log10 NFA of the best pose; infinite if there is none."""
        return float(self.candidates.log10_false_alarms[0]) if len(self.candidates) else math.inf


def fits_by_chance(log10_false_alarms: float) -> bool:
    """Return True if a pose fits no better than chance: its NFA is at least 1.

    It is exactly 1 for a single tested pose that sees no more points than fix it.
    """
    return log10_false_alarms >= 0


def add_false_alarms(candidates: Hypotheses, problem: Problem) -> Hypotheses:
    """Compute the NFA of the candidates that lack it.

    Args:
        candidates: Poses in the frame of the problem.
        problem: Points of the problem.

    Returns:
        Candidates in the same order.
    """
    alarms, rough = candidates.log10_false_alarms.copy(), candidates.log10_rough.copy()
    new = np.isnan(alarms)
    if not new.any():
        return candidates
    unknown = candidates[new]
    alarms[new], rough[new] = alarms_of(problem, unknown.rotation, unknown.translation, unknown.scale)
    return replace(candidates, log10_false_alarms=alarms, log10_rough=rough)


def rank_poses(candidates: Hypotheses, problem: Problem, settings: Evidence = DEFAULT.evidence) -> Hypotheses:
    """Compute the NFA of the candidates and move the best one to the front.

    The best is the first one in the order of the search whose log10 NFA is within `Evidence.margin` of the smallest.
    The order of the search is that of the likelihood. It decides among poses that the NFA cannot separate.

    Args:
        candidates: Poses in the frame of the problem, best first.
        problem: Points of the problem.
        settings: Constants of the verdict.

    Returns:
        Candidates with their NFA; the others keep their order.
    """
    if not len(candidates):
        return candidates
    candidates = add_false_alarms(candidates, problem)
    alarms = candidates.log10_false_alarms
    first = int(np.flatnonzero(alarms <= alarms.min() + settings.margin)[0])
    order = np.r_[first, np.delete(np.arange(len(alarms)), first)]
    return candidates[order]


def match_count(candidates: Hypotheses) -> float:
    """Return the expected number of matches of the best pose."""
    return float(candidates.match_count[0])


def missed(
    candidates: Hypotheses,
    problem: Problem,
    local_searches: float | int,
    settings: Evidence,
    *,
    independent: bool = True,
    distinct: float = 1.0,
) -> float:
    """Return log10 of the probability that the search missed a better optimum.

    Args:
        candidates: Poses in the frame of the problem with their NFA, best first.
        problem: Points of the problem.
        local_searches: Number of local searches around the first candidate that found nothing better. `REFINED` for an
            enumeration, whose exact refinement leaves no better pose nearby.
        settings: Constants of the verdict.
        independent: False to leave out the evidence of the matches.
        distinct: Number of matched scene points over that of matches, below 1 if several cameras of a rig see some.

    Returns:
        The logarithm; 0 if the first candidate is not significant. If a motion maps the matched points onto others,
        matches of a wrong pose are not independent coincidences. Only basin counts reduce the value then.
    """
    alarms = float(candidates.log10_false_alarms[0]) if len(candidates) else math.inf
    if fits_by_chance(alarms):
        return 0.0
    decades = -alarms / max(distinct * match_count(candidates), 1.0) if independent else 0.0
    basin_count = count_starts(candidates, problem, settings)
    value = log10_missed(basin_count, decades, local_searches, settings)
    if value <= settings.missed and decades:
        fewer = replace(settings, independent=independent_matches(candidates, problem, settings))
        value = log10_missed(basin_count, decades, local_searches, fewer)
    if value > settings.missed or not is_symmetric(candidates, problem, settings):
        return value
    basin_count = count_starts(candidates, problem, settings, symmetric=True)
    # A prior reduces the probability of a better pose elsewhere.
    fraction = problem.log10_prior_fraction(*candidates.pose())
    return min(log10_missed(basin_count, 0.0, local_searches, settings, symmetric=True) + fraction, 0.0)


def cached_motions(candidates: Hypotheses, problem: Problem, settings: Evidence) -> Motions:
    """Return the motions that map the matched points of the first candidate onto other scene points.

    The result is stored in `Problem.registered` and reused for equal poses.
    """
    pose = candidates.pose()
    for rotation, translation, motions in problem.registered:
        if problem.same_as(pose, rotation[None], translation[None], settings.same)[0]:
            return motions
    scale = max(float(candidates.scale[0]), float(problem.image.scales[0]))
    motions = registered(problem, *pose, scale, settings)
    problem.registered.append((*pose, motions))
    return motions


def is_symmetric(candidates: Hypotheses, problem: Problem, settings: Evidence) -> bool:
    """Return True if a motion maps a large part of the matched points onto other scene points.

    The motion could by itself explain a better pose. The fraction is compared with `Evidence.repetitions`. Motions of
    another scale could not if there is a baseline.
    """
    motions = cached_motions(candidates, problem, settings)
    fraction = motions.fraction[motions.scale == 1] if problem.baseline else motions.fraction
    return float(fraction.max(initial=0)) >= settings.repetitions.symmetric


def independent_matches(candidates: Hypotheses, problem: Problem, settings: Evidence) -> int:
    """Return the number of matches that must be independent coincidences if the first candidate is wrong.

    It is `Evidence.independent`, unless most matched points lie on a line of the scene. Wrong poses then share these
    matches, one of the other points fixes the rotation about the line, and only the rest are coincidences.
    """
    scale = max(float(candidates.scale[0]), float(problem.image.scales[0]))
    points = problem.points3d[matched_points(problem, *candidates.pose(), scale)]
    line = find_line(points)
    if line is None:
        return settings.independent
    return int(np.clip((line.distances(points) > line.radius).sum() - 1, 0, settings.independent))


def count_starts(candidates: Hypotheses, problem: Problem, settings: Evidence, *, symmetric: bool = False) -> int:
    """Return the basin count of the first candidate and of all poses equal to it.

    Args:
        candidates: Poses in the frame of the problem, best first.
        problem: Points of the problem.
        settings: Constants of the verdict.
        symmetric: Also count the poses that the motions of the scene confuse with the first one. Each is compared with
            it separately; a better pose elsewhere has the same number of copies.
    """
    first = candidates.rotation[:1], candidates.translation[:1]
    if symmetric:
        copies = cached_motions(candidates, problem, settings).competitors(first[0][0], first[1][0])
        first = np.concatenate([first[0], copies[0]]), np.concatenate([first[1], copies[1]])
    counted = np.zeros(len(candidates), bool)
    for rotation, translation in zip(*first, strict=True):
        counted |= problem.same_as((rotation, translation), candidates.rotation, candidates.translation, settings.same)
    return int(candidates.basin_count[counted].sum())


def judge(
    candidates: Hypotheses,
    problem: Problem,
    *,
    batches: int,
    local_searches: float | int = 0,
    exhaustive: bool = False,
    settings: Evidence = DEFAULT.evidence,
    rig: CandidatesOfCameras = (),
    distinct: float = 1.0,
) -> SearchResult:
    """Compute the verdict on the candidates.

    Args:
        candidates: Poses in the frame of the problem, best first.
        problem: Points of the problem.
        batches: Number of iterations of the search.
        local_searches: Number of local searches around the best pose that found nothing better.
        exhaustive: True if every pose that fits some points was examined; the miss probability is then 0.
        settings: Constants of the verdict.
        rig: Candidates, best first, and points of every camera of a rig; empty for a single camera.
        distinct: As for `missed`.

    Returns:
        Candidates, best first, with the verdict and its reason.
    """
    if not len(candidates):
        return no_pose(batches=batches, settled=exhaustive)
    candidates = rank_poses(candidates, problem, settings)
    alarms = float(candidates.log10_false_alarms[0])
    settled = exhaustive or missed(candidates, problem, local_searches, settings, independent=False) <= settings.missed
    result = SearchResult(candidates, "confident", "", batches, CONFIDENT, settled)
    if fits_by_chance(alarms):
        return result.add_objection(objection("chance", what="no pose fits"), "failed")
    unseen = -math.inf if exhaustive else missed(candidates, problem, local_searches, settings, distinct=distinct)
    # Costly tests run only if the verdict depends on them.
    per_camera = rig or [(candidates, problem)]
    against = [*(other_pose(*each, settings) for each in per_camera), rough_residuals(candidates)]
    certain = alarms <= settings.false_alarms and unseen <= settings.missed
    off = share = math.nan
    if certain and all(one is None or one.margin >= settings.margin for one in against):
        count = match_count(candidates)
        linear = linearised(problem, *candidates.pose(), float(candidates.scale[0]))
        turned, share = error_bounds(problem, linear, count)
        off = math.degrees(turned)
        if off >= HALF_TURN or not (rig or is_redundant(problem, count)):
            return result.add_objection(objection("rotation_not_fixed", count=count, what="the rotation"))
        if share > (settings.focal_few if is_object(problem, settings) else settings.focal):
            return result.add_objection(focal_length_not_fixed(share))
        against += [
            other_camera(systematic_misfit(linear, count, settings), settings),
            unrelated_competitor(per_camera, settings),
        ]
    objections = [one for one in against if one is not None and one.margin < settings.margin]
    if certain and not objections:
        return replace(result, reason=reasons.confident(alarms, settings.margin, off, share), settled=True)
    if objections:
        return result.add_objection(min(objections))
    if alarms > settings.false_alarms:
        return result.as_insignificant(settings.false_alarms)
    return result.add_objection(objection("incomplete", what="pose", probability=reasons.miss_probability(unseen)))


def is_object(problem: Problem, settings: Evidence) -> bool:
    """Return True if the scene points are those of an object.

    An object has few points, and they have no viewing cones, unlike those of a map.
    """
    return problem.cosines3d is None and len(problem.points3d) <= settings.repetitions.whole


def is_certain(candidates: Hypotheses, problem: Problem, settings: Evidence = DEFAULT.evidence) -> bool:
    """Return True if the first candidate of an enumeration passes the cheap tests of the verdict.

    The tests are the NFA, the margin to the best different pose, rough residuals and the miss probability.
    """
    if not len(candidates) or float(candidates.log10_false_alarms[0]) > settings.false_alarms:
        return False
    other = other_pose(candidates, problem, settings)
    if (other is not None and other.margin < settings.margin) or rough_residuals(candidates) is not None:
        return False
    return missed(candidates, problem, REFINED, settings) <= settings.missed


def no_pose(
    reason: str = CLAUSES["no_pose"], batches: int = 0, *, code: str = "no_pose", settled: bool = False
) -> SearchResult:
    """Return a failed result without candidates.

    Args:
        reason: Reason, a sentence.
        batches: Number of iterations of the search.
        code: Kind of the reason, a key of `CLAUSES`.
        settled: True if more search would not find a pose. Default False.
    """
    return SearchResult(Hypotheses.empty(), "failed", reason, batches, code, settled)


def degenerate_points(why: str) -> SearchResult:
    """Return a failed result for points that fix no pose."""
    return no_pose(objection("degenerate", why=why).clause, code="degenerate", settled=True)
