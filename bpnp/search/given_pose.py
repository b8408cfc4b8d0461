"""Verification of a given pose: its significance, its competing poses and the optimum near it.

A pose that was found on the same points is one of the poses of a search, and has as many tests. Of a pose from
elsewhere (`independent`) one was tried; if the optimum near it is judged instead, their number is that of the poses
that are as near to the given one as this optimum.

The competing poses are proposed from the pose and from the scene; no search is run. Some are the optima that annealing
reaches from the pose, from perturbed copies, and from its mirror image in front of a flat scene. Others come from the
motions and reflections that map the scene onto itself, and from the rivals of every pose
(`bpnp.search.verdict.contest`). A better pose elsewhere is not searched for.
"""

import math
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from bpnp.arrays import Array
from bpnp.poses import SAME, rotation_angle
from bpnp.runtime import NEVER, Deadline, one_blas_thread
from bpnp.search.few_points.enumeration import is_enumerable
from bpnp.search.hypotheses import Hypotheses
from bpnp.search.pose_model import PoseModel
from bpnp.search.problem import EQUALLY_NEAR_SIGMAS, Problem
from bpnp.search.propose.repetitions import competing_poses
from bpnp.search.refine.annealing import anneal_to_end
from bpnp.search.search_frame import SearchFrame
from bpnp.search.settings import DEFAULT
from bpnp.search.starts import PosePrior
from bpnp.search.verdict.contest import contest, rivals_of
from bpnp.search.verdict.covariance import FAR_SQUARED
from bpnp.search.verdict.decide import Case, add_false_alarms, weighed_pose
from bpnp.search.verdict.limits import MOST_FALSE_ALARMS
from bpnp.search.verdict.reasons import Unfinished, objection
from bpnp.search.verdict.rivals.nearby import annealed_around
from bpnp.search.verdict.uncertainty import linearised, local_covariance

ONE_POSE = "only this pose and its competitors were tested, no better one was searched for"


@one_blas_thread
def given_pose(
    problem: Problem,
    rotation: Array,
    translation: Array,
    *,
    refine: bool = True,
    independent: bool = False,
    seed: int = 0,
    deadline: Deadline = NEVER,
) -> tuple[Case, Hypotheses]:
    """Return what is known of a given pose, as the claim of a case, and the optimum (1,) or (0,) near it.

    With `refine` the optimum is judged instead. It differs by less than the tolerance of the verdict, or by less than
    the uncertainty of the pose. An `independent` pose was not found on these points. The seed is that of the perturbed
    copies of the pose; the deadline ends proposals.
    """
    one = replace(problem, log10_tried=0.0) if independent else problem
    claim = weighed_pose(one, rotation, translation)
    scene, few = SearchFrame(one, seed, DEFAULT, deadline), is_enumerable(problem)
    others = add_false_alarms(annealed_around(problem, claim, scene), problem)
    is_claim = _are_same(one, claim, _with_new_false_alarms(others, one))
    others = others[is_claim | (others.log10_false_alarms < 0)]  # the others are found on these points
    if few:  # as in an enumeration, whose candidates are refined
        scale = float(claim.scale[0])
        copies = competing_poses(one, rotation, translation, scale)[:2]
        if len(copies[0]):
            others = Hypotheses.concatenate([others, anneal_to_end(scene, *copies, scale)])
    deadline.passed(Unfinished.competing_poses)  # noted: then not all of them were refined
    others = _with_new_false_alarms(others, one)
    others = others[np.argsort(others.log10_false_alarms, kind="stable")]
    same = _are_same(one, claim, others)
    optimum = others[same][:1]
    better = len(optimum) and optimum.log10_false_alarms[0] <= claim.log10_false_alarms[0]
    if refine and better and independent:
        scale = float(optimum.scale[0])
        distance = float(np.linalg.norm(rotation @ problem.centre3d + translation))
        prior = PosePrior(
            rotation, translation, math.degrees(scale) / EQUALLY_NEAR_SIGMAS, scale * distance / EQUALLY_NEAR_SIGMAS
        )
        near = replace(problem, prior=prior).log10_prior_fraction(*optimum.pose())
        one = replace(problem, log10_tried=max(PoseModel.of(problem).log10_tests([problem]) + near, 0.0))
    claim = optimum if refine and better else claim
    competing = others[~same & (others.log10_false_alarms < 0)]  # insignificant poses do not compete
    candidates = _with_new_false_alarms(Hypotheses.concatenate([claim, competing]), one)
    case = Case.of(candidates, one, exhaustive=True, is_fitted=not refine, claim=candidates[:1], note=ONE_POSE)
    rivals = rivals_of(lambda: scene, deadline, enumerated=few)
    if better and not refine:
        rivals.append(partial(_nearby, claim=claim, optimum=optimum))
    return contest(case, rivals), optimum


def _nearby(case: Case, *, claim: Hypotheses, optimum: Hypotheses) -> Case:
    """Return the case against a given pose if the optimum near it fits significantly better.

    Source: S. S. Wilks, The large-sample distribution of the likelihood ratio, Ann. Math. Statist. 1938.
    """
    margin = float(claim.log10_false_alarms[0] - optimum.log10_false_alarms[0])
    if 2 * math.log(10) * margin <= FAR_SQUARED:
        return case
    off = math.degrees(rotation_angle(claim.rotation[0], optimum.rotation[0]))
    return case.against(objection("better_nearby", margin, degrees=off))


def _with_new_false_alarms(candidates: Hypotheses, problem: Problem) -> Hypotheses:
    """Return the candidates with their false alarms recomputed for the number of tests of the problem."""
    return add_false_alarms(candidates.unweighed(), problem)


def _are_same(problem: Problem, claim: Hypotheses, poses: Hypotheses) -> NDArray[np.bool_]:
    """Return which poses (c,) are the given one (1,), within the tolerance or within their uncertainty."""
    return np.array([_is_same(problem, claim, poses[k : k + 1]) for k in range(len(poses))], np.bool_)


def _is_same(problem: Problem, claim: Hypotheses, pose: Hypotheses) -> bool:
    """Return whether a pose (1,) is the given one, within the tolerance or within its uncertainty."""
    if problem.same_as(claim.pose(), pose.rotation, pose.translation, SAME)[0]:
        return True
    turn = claim.rotation[0] @ pose.rotation[0].T
    if pose.log10_false_alarms[0] > MOST_FALSE_ALARMS or np.trace(turn) <= 1:  # over 90 degrees away
        return False
    linear = linearised(problem, *pose.pose(), float(pose.scale[0]))
    covariance = local_covariance(linear)
    if covariance is None:
        return False
    vector = 0.5 * np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    centre, other = (one.rotation[0] @ problem.centre3d + one.translation[0] for one in (claim, pose))
    step = np.r_[vector, centre - other]
    return bool(step @ np.linalg.solve(covariance, step) < FAR_SQUARED)
