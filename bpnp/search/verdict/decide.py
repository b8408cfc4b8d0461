"""Verdict on the best pose of a search; nothing else makes or changes one.

The criterion is the number of false alarms (NFA, `bpnp.search.verdict.false_alarms`): the expected number of poses
that fit as well if image and scene are unrelated.

- "confident": log10 NFA is at most `MOST_FALSE_ALARMS`. The margin to every competing pose is at least
  `LEAST_MARGIN` decades. log10 of the probability that the search missed a better optimum is at most
  `MOST_MISSED` (`bpnp.search.verdict.completeness`). No rival objects (`bpnp.search.verdict.contest`).
- "ambiguous": The best pose fits better than chance (log10 NFA below 0), but one of these conditions does not hold.
  Points that do not fix the rotation or the focal length give this verdict too.
- "failed": No pose was found, or none fits better than chance, or a given pose is refuted by a confident one.
"""

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from bpnp.search.hypotheses import Hypotheses
from bpnp.search.possible_matches import MATCH_REACH, score_pose
from bpnp.search.problem import Problem, in_bulk
from bpnp.search.propose.repetitions import WHOLE_SCENE
from bpnp.search.propose.symmetries import mirror_pose
from bpnp.search.verdict import reasons
from bpnp.search.verdict.competitors import (
    CandidatesOfCameras,
    Partners,
    distance_between,
    other_camera,
    other_pose,
    partners,
    rough_residuals,
    unrelated_competitor,
)
from bpnp.search.verdict.completeness import Symmetry, missed
from bpnp.search.verdict.false_alarms import alarms_of, directions_of, likeliest_scale
from bpnp.search.verdict.limits import LEAST_MARGIN, MOST_FALSE_ALARMS, MOST_MISSED
from bpnp.search.verdict.reasons import CONFIDENT, NO_POSE, Objection, focal_length_not_fixed, objection
from bpnp.search.verdict.uncertainty import (
    Linearised,
    Misfit,
    error_bounds,
    is_redundant,
    linearised,
    systematic_misfit,
)

Verdict = Literal["confident", "ambiguous", "failed"]
LOOSEST_ROTATION = 30.0  # a rotation with a larger 99.9 % bound is not known [degrees; convention]
# The distance has the same error, and from `SAME.shift` on the pose is a different one.
FOCAL_BOUND = 0.05  # largest 99.9 % bound of a fitted focal length, as a fraction [fraction; derived]
# The same for an object: a scene of at most `WHOLE_SCENE` points that is no map, such as LEDs. Its rotation is correct
# long before its distance. The reason gives the bound.
FOCAL_BOUND_OF_OBJECT = 1.0  # [fraction; convention]
REFINED = math.inf  # number of local searches that the exact refinement of an enumeration replaces


class _Led:
    """Candidates; the first one is the leader."""

    candidates: Hypotheses

    @property
    def residual(self) -> float:
        """Scale of the residuals of the leader, radians; infinite without one."""
        return float(self.candidates.scale[0]) if len(self.candidates) else math.inf

    @property
    def log10_false_alarms(self) -> float:
        """log10 NFA of the leader; infinite without one."""
        return float(self.candidates.log10_false_alarms[0]) if len(self.candidates) else math.inf


@dataclass(frozen=True, eq=False)
class Case(_Led):
    """What is known of the best pose of a search, the leader: its rivals, and how complete the search was."""

    candidates: Hypotheses  # in the frame of the problem; `Case.of` moves the leader to the front
    problem: Problem  # of a rig, that of the camera with the most evidence
    failure: Objection = NO_POSE  # why there are no candidates, if there are none
    local_searches: float | int = 0  # around the leader, that found nothing better; `REFINED` for an enumeration
    exhaustive: bool = False  # every pose that fits some points was examined: the miss probability is 0
    iterations: int = 0  # of the search
    is_fitted: bool = False  # the leader is a least-squares fit to its matches
    cameras: CandidatesOfCameras = ()  # candidates and points of every camera of a rig
    distinct: float = 1.0  # matched scene points over matches, below 1 if several cameras see some
    objections: tuple[Objection, ...] = ()  # what rivals found that are no poses of this camera
    claim: Hypotheses | None = None  # (1,) pose in question, if it was given
    note: str = ""  # added to the reason of a confident pose
    of_rig: Hypotheses | None = None  # the candidates as poses of a rig
    motions: Symmetry | None = None  # those of the scene that other cases of the problem have registered

    @classmethod
    def of(cls, candidates: Hypotheses, problem: Problem, **known: object) -> "Case":
        """Return a case with the candidates ranked by `rank_poses`."""
        return cls(rank_poses(candidates, problem), problem, **known)  # type: ignore[arg-type]

    @classmethod
    def without_pose(cls, problem: Problem, failure: Objection = NO_POSE, *, exhaustive: bool = False) -> "Case":
        """Return a case without candidates."""
        return cls(Hypotheses.empty(), problem, failure, exhaustive=exhaustive)

    def among(self, rivals: Hypotheses) -> "Case":
        """Return the case with rivals among the candidates; objections to another leader do not count."""
        ranked = rank_poses(Hypotheses.concatenate([self.candidates, rivals]), self.problem)
        case = replace(self, candidates=ranked)
        return case if case.has_leader_of(self) else replace(case, objections=())

    def against(self, one: Objection | None) -> "Case":
        """Return the case with an objection to the leader; the same one for None."""
        return self if one is None else replace(self, objections=(*self.objections, one))

    def has_leader_of(self, other: "Case") -> bool:
        """Return True if another case has the same leader."""
        return bool(np.array_equal(self.candidates.translation[:1], other.candidates.translation[:1]))

    @property
    def pose(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Rotation (3, 3) and translation (3,) of the leader."""
        return self.candidates.pose()

    @cached_property
    def match_scale(self) -> float:
        """Scale of the residuals at which points match within `Problem.match_radius`, radians."""
        return max(self.residual, self.problem.match_radius / MATCH_REACH)

    @cached_property
    def explained(self) -> Partners:
        """Scene points that the leader shows at the image points."""
        return partners(MATCH_REACH, self.problem, *self.pose, self.match_scale)

    @cached_property
    def directions(self) -> NDArray[np.float64]:
        """Directions (n, 3) in which the leader sees the scene points; NaN for those that do not face the camera."""
        return directions_of(self.problem, *self.pose)

    @property
    def match_count(self) -> float:
        """Expected number of matches of the leader."""
        return match_count(self.candidates)

    @cached_property
    def symmetry(self) -> Symmetry:
        """Motions of the scene that map matched points."""
        return self.motions or Symmetry(self.problem)

    @cached_property
    def is_flat(self) -> bool:
        """True if the scene, without far points, is flat: it may slide along a curve, and shows no focal length."""
        return mirror_pose(self.problem.points3d[in_bulk(self.problem.points3d)], *self.pose) is not None

    @cached_property
    def missed(self) -> float:
        """log10 of the probability that the search missed a better optimum than the leader."""
        return -math.inf if self.exhaustive else self._missed(with_matches=True)

    @cached_property
    def is_settled(self) -> bool:
        """True if more search would not help: no test fails, or nothing was missed even if matches are no evidence."""
        if self.exhaustive or not len(self.candidates):
            return self.exhaustive
        return self._shortcoming is None or self._missed(with_matches=False) <= MOST_MISSED

    @cached_property
    def is_certain(self) -> bool:
        """True if the leader passes the cheap tests: the NFA, the miss probability, other poses, rough residuals."""
        if self.log10_false_alarms > MOST_FALSE_ALARMS:
            return False
        return all(one.margin >= LEAST_MARGIN for one in self._competitors) and self.missed <= MOST_MISSED

    @property
    def is_rough(self) -> bool:
        """True if the points fit better with residuals larger than those of the leader."""
        return self.objection is not None and self.objection.code == "rough_residuals"

    @property
    def objection(self) -> Objection | None:
        """Reason against the leader; None if it is confident. What rivals found is more specific than other tests."""
        if self.objections and not fits_by_chance(self.log10_false_alarms):
            return self.objections[0]
        return self._shortcoming

    @cached_property
    def bounds(self) -> tuple[float, float]:
        """99.9 % bounds of the rotation, degrees, and of the focal length, a fraction; the latter is 0 if given."""
        turned, share = error_bounds(self.problem, self.linear, self.match_count)
        return math.degrees(turned), share

    @cached_property
    def _shortcoming(self) -> Objection | None:
        """Test that the leader fails; costly ones run only if the verdict depends on them."""
        alarms = self.log10_false_alarms
        if not len(self.candidates):
            return self.failure
        if fits_by_chance(alarms):
            return objection("chance", what="no pose fits")
        if self.is_certain:
            return self._not_fixed or min(self._doubts, default=None)
        if near := [one for one in self._competitors if one.margin < LEAST_MARGIN]:
            return min(near)
        if alarms > MOST_FALSE_ALARMS:
            return objection("insignificant", alarms=reasons.nfa(alarms), most=MOST_FALSE_ALARMS)
        return objection("incomplete", what="pose", probability=reasons.miss_probability(self.missed))

    def _missed(self, *, with_matches: bool) -> float:
        """Compute `missed`, with or without the evidence of the matches."""
        if fits_by_chance(self.log10_false_alarms):
            return 0.0
        decades = -self.log10_false_alarms / max(self.distinct * self.match_count, 1.0) if with_matches else 0.0
        known = self.problem, self.symmetry, self.local_searches
        return missed(self.candidates, *known, decades_a_match=decades)

    @cached_property
    def linear(self) -> Linearised | None:
        """The leader and its possible matches, linearised; None without a match."""
        return linearised(self.problem, *self.pose, self.residual)

    @cached_property
    def misfit(self) -> Misfit:
        """Largest change of the leader that its residuals support significantly."""
        return systematic_misfit(self.linear, self.match_count)

    @cached_property
    def _competitors(self) -> list[Objection]:
        """Best other pose in each camera, and the pose itself at rough residuals."""
        others = [other_pose(*each) for each in self._cameras]
        return [one for one in (*others, rough_residuals(self.candidates, self.problem)) if one is not None]

    @property
    def _cameras(self) -> CandidatesOfCameras:
        return self.cameras or [(self.candidates, self.problem)]

    @property
    def _not_fixed(self) -> Objection | None:
        """Unknown that the points do not determine."""
        (off, share), count = self.bounds, self.match_count
        if off > LOOSEST_ROTATION or not (self.cameras or is_redundant(self.problem, count)):
            return objection("rotation_not_fixed", count=count, what="the rotation")
        most = FOCAL_BOUND_OF_OBJECT if is_object(self.problem) else FOCAL_BOUND
        return focal_length_not_fixed(share) if share > most else None

    @property
    def _doubts(self) -> list[Objection]:
        """Other cameras that the residuals support, and far poses that explain other points."""
        doubts = other_camera(self.misfit), unrelated_competitor(self._cameras)
        return [one for one in doubts if one is not None and one.margin < LEAST_MARGIN]


@dataclass(frozen=True, eq=False)
class SearchResult(_Led):
    """Result of the search for the pose of one problem."""

    candidates: Hypotheses  # distinct poses, best first, in the frame of the problem, or of the rig
    verdict: Verdict
    reason: str  # a plain sentence
    code: str  # kind of the reason: "confident" or a key of `reasons.CLAUSES`
    iterations: int  # of the search
    is_settled: bool = False  # more search would not change the verdict
    is_fitted: bool = False  # the best pose is a least-squares fit to its matches

    @property
    def best(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Rotation (3, 3) and translation (3,) of the best pose; NaN if there is none."""
        if not len(self.candidates):
            return np.full((3, 3), math.nan), np.full(3, math.nan)
        return self.candidates.pose()


def decide(case: Case) -> SearchResult:
    """Return the verdict on the leader of a case, or on its claim.

    A claim is "failed" if the leader is another pose without an objection, or if an objection is a pose that is more
    likely by `LEAST_MARGIN`; it is "ambiguous" if the leader is another pose.
    """
    candidates, one, refuted = case.candidates, case.objection, False
    if case.claim is not None:
        place = int(np.flatnonzero((candidates.translation == case.claim.translation[0]).all(-1))[0])
        alarms = float(case.claim.log10_false_alarms[0])
        if place and not fits_by_chance(alarms):
            away = distance_between(case.problem, case.claim.pose(), case.pose)
            refuted, margin = one is None, alarms - case.log10_false_alarms
            one = objection("better_pose", margin, away=away)
        elif fits_by_chance(alarms):
            one = objection("chance", what="the pose fits no")
        elif refuting := [each for each in case.objections if -math.inf < each.margin <= -LEAST_MARGIN]:
            refuted, one = True, min(refuting)
        candidates = candidates[np.r_[place, np.delete(np.arange(len(candidates)), place)]]
    verdict: Verdict = "confident"
    if one is None:
        code = CONFIDENT
        reason = reasons.confident(case.log10_false_alarms, LEAST_MARGIN, *case.bounds)
        notes = [reasons.TRUSTED_CAMERA] if not case.cameras and case.problem.focal is None and case.is_flat else []
        reason = "; ".join([reason, *notes, *([case.note] if case.note else [])])
    else:
        verdict, code = "failed" if refuted or one.code in reasons.FAILURES else "ambiguous", one.code
        reason = one.sentence(float(candidates.log10_false_alarms[0])) if len(candidates) else one.clause
    if case.of_rig is not None:
        candidates = replace(candidates, rotation=case.of_rig.rotation, translation=case.of_rig.translation)
    return SearchResult(candidates, verdict, reason, code, case.iterations, case.is_settled, case.is_fitted)


def fits_by_chance(log10_false_alarms: float) -> bool:
    """Return True if a pose fits no better than chance: its NFA is at least 1.

    It is exactly 1 for a single tested pose that sees no more points than fix it.
    """
    return log10_false_alarms >= 0


def add_false_alarms(candidates: Hypotheses, problem: Problem) -> Hypotheses:
    """Compute the NFA of the candidates that lack it; the order stays."""
    alarms, rough = candidates.log10_false_alarms.copy(), candidates.log10_rough.copy()
    new = np.isnan(alarms)
    if not new.any():
        return candidates
    unknown = candidates[new]
    alarms[new], rough[new] = alarms_of(problem, unknown.rotation, unknown.translation, unknown.scale)
    return replace(candidates, log10_false_alarms=alarms, log10_rough=rough)


def weighed_pose(problem: Problem, rotation: NDArray[np.float64], translation: NDArray[np.float64]) -> Hypotheses:
    """Return a pose (1,) without refinement, at the scale of residuals with the most evidence."""
    scale = likeliest_scale(problem, rotation, translation)
    score, count = score_pose(problem, rotation, translation, scale)
    pose = Hypotheses.from_poses(
        rotation[None],
        translation[None],
        log_likelihood=np.array([score]),
        match_count=np.array([count]),
        scale=np.array([scale]),
    )
    return add_false_alarms(pose, problem)


def rank_poses(candidates: Hypotheses, problem: Problem) -> Hypotheses:
    """Compute the NFA of the candidates and move the best one to the front; the others keep their order.

    The best is the first one in the order of the search whose log10 NFA is within `LEAST_MARGIN` of the smallest.
    The order of the search is that of the likelihood. It decides among poses that the NFA cannot separate.
    """
    if not len(candidates):
        return candidates
    candidates = add_false_alarms(candidates, problem)
    alarms = candidates.log10_false_alarms
    first = int(np.flatnonzero(alarms <= alarms.min() + LEAST_MARGIN)[0])
    order = np.r_[first, np.delete(np.arange(len(alarms)), first)]
    return candidates[order]


def match_count(candidates: Hypotheses) -> float:
    """Return the expected number of matches of the best pose."""
    return float(candidates.match_count[0])


def is_object(problem: Problem) -> bool:
    """Return True if the scene is an object: few points without the viewing cones of a map."""
    return problem.cosines3d is None and len(problem.points3d) <= WHOLE_SCENE
