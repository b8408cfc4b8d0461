"""Poses that a search has found so far."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from bpnp.poses import SAME, close_poses
from bpnp.search.hypotheses import (
    KEPT_CANDIDATES,
    SAME_DEG,
    SAME_SHIFT,
    Hypotheses,
    merge_hypotheses,
    to_problem_frame,
    to_scene_frame,
)
from bpnp.search.loop import Step
from bpnp.search.pose_model import PoseModel
from bpnp.search.problem import Problem
from bpnp.search.refine.annealing import FINE_BEARINGS, FINISHED_POSES, finish
from bpnp.search.search_frame import SearchFrame
from bpnp.search.verdict.completeness import Symmetry
from bpnp.search.verdict.contest import rivals_of
from bpnp.search.verdict.decide import Case, add_false_alarms, rank_poses
from bpnp.search.verdict.limits import LEAST_MARGIN, MOST_MISSED
from bpnp.search.verdict.rivals import Rival


class Pool:
    """Distinct poses of a scene, best first, from all iterations of a search."""

    def __init__(self, scene: SearchFrame, problem: Problem, enumerated: Case) -> None:
        # enumerated: case of the enumeration of few points, whose poses are the first candidates.
        self.scene, self.problem, self.enumerated = scene, problem, enumerated
        self.iterations, self._judged_log10 = 0, 0.0
        self._is_thinned = len(problem.bearings) > FINE_BEARINGS
        self._tests = PoseModel.of(problem).log10_tests([problem])
        self.symmetry = Symmetry(problem)  # motions of the scene that were registered with matched points
        self.forget()
        if len(enumerated.candidates):
            self.candidates = to_scene_frame(enumerated.candidates, scene)

    def forget(self) -> None:
        """Drop all poses."""
        # locally_best: significant poses whose local search found nothing better.
        self.candidates = self.locally_best = Hypotheses.empty(dtype=np.float32)
        self.searched_around: list[Hypotheses] = []  # other poses whose surroundings were searched
        self.missed = 0.0  # log10 of the probability that the search missed a better optimum

    def add(self, step: Step, found: Hypotheses) -> None:
        """Add the poses of an iteration, in the frame of the scene.

        Their NFA is computed first: a significant pose may be close to a likelier one that is not significant. A local
        search was unsuccessful if the best NFA does not fall by `LEAST_MARGIN` decades.
        """
        before = self.log10_false_alarms
        self.iterations += 1
        self.candidates = self._with_false_alarms(
            merge_hypotheses([self.candidates, self._with_false_alarms(found)], self.scene), 1
        )
        if (
            step.around is not None
            and self.log10_false_alarms > before - LEAST_MARGIN
            and not self.scene.deadline.passed()
        ):
            self.locally_best = Hypotheses.concatenate([self.locally_best, step.around])
        self.missed = self._missed()
        if self.missed > MOST_MISSED:  # otherwise `case` computes the NFA of the others
            self.candidates = self._with_false_alarms(self.candidates)
            self.candidates = self.candidates[np.argsort(-self.candidates.sort_key, kind="stable")]
            self.missed = self._missed()

    def may_be_decided(self) -> bool:
        """Return True if the best pose may be confident, or match more points than before."""
        bettered = self._is_thinned and self.log10_false_alarms < self._judged_log10 - LEAST_MARGIN
        return bettered or self.missed <= MOST_MISSED

    def _with_false_alarms(self, candidates: Hypotheses, count: int | None = None) -> Hypotheses:
        """Compute the NFA of the promising poses among the first `count` candidates.

        None for `count` means as many as a verdict needs.
        """
        if count is None:
            count = FINISHED_POSES if self.problem.prior is None else KEPT_CANDIDATES
        places = np.flatnonzero(self._promising(candidates[:count]))
        first = add_false_alarms(to_problem_frame(candidates[places], self.scene), self.problem)
        alarms, rough = candidates.log10_false_alarms.copy(), candidates.log10_rough.copy()
        alarms[places], rough[places] = first.log10_false_alarms, first.log10_rough
        return replace(candidates, log10_false_alarms=alarms, log10_rough=rough)

    def _promising(self, candidates: Hypotheses) -> NDArray[np.bool_]:
        """Return a mask of the poses that may be significant.

        Their likelihood is at most 3 T decades below that of scene points spread evenly over the view. T is log10 of
        the number of tests.
        """
        nats = candidates.log_likelihood - math.log(2 * math.pi / self.scene.solid_angle)
        return np.asarray(nats * len(self.problem.bearings) > -3 * math.log(10) * self._tests)

    def leaders(self) -> Hypotheses:
        """Return the candidates with an NFA, in the frame of the problem, the best one first."""
        judged = self.candidates[~np.isnan(self.candidates.log10_false_alarms)]
        return rank_poses(to_problem_frame(judged, self.scene), self.problem)

    @property
    def best_key(self) -> float:
        """Largest sort key of the candidates; -inf if there are none."""
        return float(self.candidates.sort_key.max(initial=-math.inf))

    @property
    def log10_false_alarms(self) -> float:
        """log10 of the smallest NFA of the candidates; infinite if none has one."""
        return float(np.nanmin(self.candidates.log10_false_alarms, initial=np.inf))

    def local_searches(self, leaders: Hypotheses) -> int:
        """Return the number of local searches around the first of these poses that found nothing better."""
        if not len(leaders) or not len(self.locally_best):
            return 0
        around = to_problem_frame(self.locally_best, self.scene)
        same = self.problem.same_as(leaders.pose(), around.rotation, around.translation, SAME)
        return int(same.sum())

    def is_searched(self, pose: Hypotheses) -> bool:
        """Return True if the surroundings of a pose (1,), or of one equal to it, were searched before."""
        together = Hypotheses.concatenate([pose, *self.searched_around])
        poses = together.rotation, together.translation * self.scene.shift_weight
        return bool(close_poses(*poses, 0, SAME_DEG, SAME_SHIFT)[1:].any())

    def _missed(self) -> float:
        """Compute `missed` from the current candidates."""
        return self._case_of(self.leaders()).missed

    def _case_of(self, leaders: Hypotheses) -> Case:
        return Case(
            leaders,
            self.problem,
            local_searches=self.local_searches(leaders),
            iterations=self.iterations,
            motions=self.symmetry,
        )

    @property
    def rivals(self) -> Sequence[Rival]:
        """What to ask about the best pose, in order."""
        return rivals_of(lambda: self.scene, self.scene.deadline)

    def case(self, *, ended: bool = True) -> Case:
        """Return what is known of the best candidates, or the case of the enumeration if it has fewer false alarms.

        After the last iteration the `FINISHED_POSES` best candidates are annealed on all points, before only the best
        one.
        """
        scene, problem = self.scene, self.problem
        self._judged_log10 = min(self._judged_log10, self.log10_false_alarms)
        annealed = FINISHED_POSES if ended else 1
        ends = finish(scene, self.candidates, annealed) if len(self.candidates) else self.candidates
        if len(ends) and problem.prior is not None:  # keep the version of each pose with the smaller NFA
            ends = self._with_false_alarms(ends)
            ends = merge_hypotheses([ends, self.candidates.as_dependent()], scene)
        case = self._case_of(rank_poses(to_problem_frame(ends, scene), problem))
        if self.enumerated.log10_false_alarms < case.log10_false_alarms:
            return replace(self.enumerated, iterations=self.iterations)
        return case
