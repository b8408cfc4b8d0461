"""Search with few points: the steps and the poses of an enumeration, for the loop `bpnp.search.loop.run`.

A closely predicted pose, as in tracking, is tried first; the whole space is searched if it is not certain. With a rough
prediction the whole space is searched if no pose near it is significant. If no pose with the prior gravity is
significant, the search is repeated without it: a hypothesis of two matches has the error of the prior.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from bpnp.runtime import Deadline
from bpnp.search.few_points.enumeration import STAGES, Enumeration, margin
from bpnp.search.few_points.points import predicted_pose
from bpnp.search.hypotheses import KEPT_CANDIDATES, Hypotheses
from bpnp.search.loop import Step
from bpnp.search.possible_matches import score_pose
from bpnp.search.problem import Problem
from bpnp.search.propose.repetitions import competing_poses
from bpnp.search.starts import GravityPrior
from bpnp.search.verdict.completeness import Symmetry
from bpnp.search.verdict.contest import rivals_of
from bpnp.search.verdict.decide import REFINED, Case, add_false_alarms
from bpnp.search.verdict.limits import MOST_FALSE_ALARMS
from bpnp.search.verdict.rivals import Rival, SceneOf

NEAR_NATS = 25.0  # evidence in nats by which a competing pose may be behind the best [nats; calibration]
SMALLEST_SCALE = 1e-5  # smallest scale of the residuals if the pixel size is unknown [radians; numerics]


class EnumeratedPoses:
    """Poses of few points that enumerations have found so far."""

    iterations = 0  # an enumeration does not count as one

    def __init__(self, problem: Problem, scene_of: SceneOf, deadline: Deadline) -> None:
        self.problem, self._scene_of, self._deadline = problem, scene_of, deadline
        # candidates: poses of the earlier enumerations, and of the current one once it has ended or is certain.
        # found: poses of the current enumeration, likeliest first.
        self.found = self.candidates = Hypotheses.empty()
        # is_exhausted: the last enumeration tried every hypothesis.
        # is_certain: as `Case.is_certain`, for the best pose; `Case.is_settled` is about the search.
        self.is_certain = self.is_exhausted = False
        # Without viewing cones, which an enumeration ignores.
        has_cones = problem.cosines3d is not None
        self.enumerated = replace(problem, normals3d=None, cosines3d=None) if has_cones else problem
        self._symmetry = Symmetry(self.enumerated)
        self._case: Case | None = None
        is_tracked = predicted_pose(problem.prior) is not None
        self.begin(self.enumerated, predicted_only=is_tracked and problem.fixing_matches == 2)

    def begin(self, problem: Problem, *, predicted_only: bool = False) -> None:
        """Begin an enumeration of a problem; with `predicted_only` of the predicted pose alone."""
        self.run = Enumeration(problem, problem.match_radius, stages=() if predicted_only else STAGES)
        self._leaders: list[Hypotheses] = []  # poses (1,) whose competing poses were proposed

    def add(self, step: Step, found: Hypotheses) -> None:
        """Take the poses of the current enumeration."""
        self.found = found

    @property
    def has_competitors(self) -> bool:
        """True if the competing poses of the best pose were proposed."""
        if not len(self.found) or not self._leaders:
            return False
        leaders = Hypotheses.concatenate(self._leaders)
        return bool(self.run.problem.same_as(self.found.pose(), leaders.rotation, leaders.translation).any())

    def advance(self, deadline: float) -> Hypotheses:
        """Solve further hypotheses, and return all poses."""
        self.run.advance(deadline)
        return self.run.poses()

    def propose_competitors(self) -> Hypotheses:
        """Refine the competing poses of the best pose, and return all poses."""
        leader = self.found[:1]
        self._leaders.append(leader)
        pose = leader.pose()
        scale = max(float(leader.scale[0]), self.problem.floor or SMALLEST_SCALE)
        rotations, translations, *_ = competing_poses(self.problem, *pose, scale)
        for one in zip(rotations, translations, strict=True):
            self.run.propose(*one, self.run.reach)
        return self.run.poses()

    def may_be_decided(self) -> bool:
        """Return True if the best pose leads by a safe margin and passes the cheap tests of the verdict."""
        run = self.run
        if not (run.is_significant and self.has_competitors and margin(self.found, run.problem) >= run.safe_margin):
            return False
        known = {"local_searches": REFINED, "is_fitted": True, "motions": self._symmetry}
        case = Case.of(self._candidates(), self.enumerated, **known)
        self.is_certain = case.is_certain
        if self.is_certain:
            if not len(self.candidates) and self.problem is self.enumerated:
                self._case = case  # with the tests that were computed for it
            self._keep(case.candidates)
        return self.is_certain

    def end(self) -> None:
        """Keep the poses of an enumeration that has ended without a certain one."""
        self.is_exhausted = self.run.ended == "exhausted"
        self._keep(self._candidates())

    def _keep(self, candidates: Hypotheses) -> None:
        """Add candidates to those of an earlier enumeration with the prior, if there was one."""
        if not len(self.candidates):
            self.candidates = candidates
            return
        every = Hypotheses.concatenate([self.candidates, candidates])
        if isinstance(self.problem.prior, GravityPrior):
            every = add_false_alarms(every, self.enumerated)
            order = np.argsort(every.log10_false_alarms, kind="stable")
        else:
            order = np.argsort(-every.log_likelihood, kind="stable")
        self.candidates = every[order[:KEPT_CANDIDATES]]

    def _candidates(self) -> Hypotheses:
        """Return the poses not far less likely than the best, with the scale and likelihood of the annealing."""
        poses = self.found
        if poses.evidence is None or not len(poses):
            return poses
        poses = poses[poses.evidence >= poses.evidence.max() - NEAR_NATS][:KEPT_CANDIDATES]
        scale = np.maximum(poses.scale, self.problem.floor or SMALLEST_SCALE)
        each = zip(poses.rotation, poses.translation, scale, strict=True)
        likelihood = np.array([score_pose(self.problem, *one)[0] for one in each])
        return replace(poses, scale=scale, log_likelihood=likelihood)

    def is_better_without_prior(self) -> bool:
        """Return True if the enumeration that has ended shall be repeated without the prior."""
        prior = self.problem.prior
        if isinstance(prior, GravityPrior):
            self.candidates = add_false_alarms(self.candidates, self.enumerated)
            return float(self.candidates.log10_false_alarms.min(initial=math.inf)) > MOST_FALSE_ALARMS
        if predicted_pose(prior) is None:
            return False
        return self.problem.fixing_matches == 2 or margin(self.found, self.enumerated) < 0

    @property
    def rivals(self) -> Sequence[Rival]:
        """What to ask about the best pose, in order."""
        return rivals_of(self._scene_of, self._deadline, enumerated=True)

    def case(self, *, ended: bool = True) -> Case:
        """Return what is known of the best pose."""
        if self._case is None:
            self._case = Case.of(
                self.candidates,
                self.problem,
                local_searches=REFINED,
                exhaustive=self.is_exhausted,
                is_fitted=True,
                motions=self._symmetry if self.problem is self.enumerated else None,
            )
        return self._case


class EnumerationPlan:
    """Steps of an enumeration, and of another one without the prior if it is not successful."""

    def __init__(self, poses: EnumeratedPoses, deadline: Deadline) -> None:
        self._poses, self._deadline = poses, deadline
        self._repeated = False

    def next_step(self) -> Step | None:
        """Return the next step: more hypotheses, or the competing poses of the best pose; None at the end."""
        poses, run = self._poses, self._poses.run
        if poses.is_certain:
            return None
        if run.is_significant and not poses.has_competitors and run.ended is None:
            return Step(poses.propose_competitors)
        if run.ended is None and run.is_significant and run.is_long:
            run.ended = "most"
        if run.ended is None:
            return Step(partial(poses.advance, self._deadline.at))
        poses.end()
        if self._repeated or not poses.is_better_without_prior():
            return None
        self._repeated = True
        poses.begin(replace(poses.enumerated, prior=None))
        return Step(partial(poses.advance, self._deadline.at))
