"""Verification of a given pose: its significance, its competing poses and the optimum near it.

One pose was tried, so the number of tests is one. If the optimum near the pose is judged instead, it is the number of
poses that are as near to the given one as this optimum.

The competing poses are proposed from the pose and from the scene; no search is run. Some are the optima that annealing
reaches from the pose, from perturbed copies, and from its mirror image in front of a flat scene. Others come from the
motions and reflections that map the scene onto itself, and from other focal lengths
(`bpnp.search.verdict.contest`). A better pose elsewhere is not searched for.
"""

import math
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from bpnp.poses import SAME, rotation_angle
from bpnp.runtime import NEVER, Deadline, one_blas_thread
from bpnp.search.enumeration.search import is_enumerable
from bpnp.search.hypotheses import Hypotheses, merge_hypotheses, to_problem_frame, to_scene_frame
from bpnp.search.pose_model import PoseModel
from bpnp.search.possible_matches import score_pose
from bpnp.search.problem import EQUALLY_NEAR_SIGMAS, Problem, in_bulk
from bpnp.search.propose.density_map import perturb_each
from bpnp.search.propose.repetitions import competing_poses
from bpnp.search.propose.symmetries import mirror_pose
from bpnp.search.refine.annealing import FINISHED_POSES, MIDDLE, anneal_on_points, anneal_to_end, finish
from bpnp.search.search_frame import SearchFrame
from bpnp.search.settings import DEFAULT
from bpnp.search.starts import PosePrior
from bpnp.search.verdict.contest import contest, rivals_of
from bpnp.search.verdict.covariance import FAR_SQUARED
from bpnp.search.verdict.decide import Case, add_false_alarms
from bpnp.search.verdict.false_alarms import likeliest_scale
from bpnp.search.verdict.limits import MOST_FALSE_ALARMS
from bpnp.search.verdict.reasons import Unfinished, objection
from bpnp.search.verdict.uncertainty import linearised, local_covariance

Array = NDArray[np.float64]
ONE_POSE = "only this pose and its competitors were tested, no better one was searched for"


@one_blas_thread
def given_pose(
    problem: Problem,
    rotation: Array,
    translation: Array,
    *,
    refine: bool = True,
    seed: int = 0,
    deadline: Deadline = NEVER,
) -> tuple[Case, Hypotheses]:
    """Return what is known of a given pose, or of the optimum near it.

    Args:
        problem: Points of the problem.
        rotation: (3, 3) of the pose.
        translation: (3,) of the pose, scene units.
        refine: Judge the optimum near the pose instead. It differs by less than the tolerance of the verdict, or by
            less than the uncertainty of the pose.
        seed: Random seed of the perturbed copies of the pose.
        deadline: When to stop proposing poses.

    Returns:
        The verdict, with the judged pose as the first candidate; and the optimum (1,) near the given pose, or (0,)
        if there is none.
    """
    one = replace(problem, log10_tried=0.0)
    claim = _unrefined(one, rotation, translation)
    scene, few = SearchFrame(one, seed, DEFAULT, deadline), is_enumerable(problem)
    others = _proposed(problem, claim, scene)
    if few:  # as in an enumeration, whose candidates are refined
        scale = float(claim.scale[0])
        copies = competing_poses(one, rotation, translation, scale)[:2]
        if len(copies[0]):
            others = Hypotheses.concatenate([others, anneal_to_end(scene, *copies, scale)])
    deadline.passed(Unfinished.competing_poses)  # noted: then not all of them were refined
    others = _with_new_false_alarms(others, one)
    others = others[np.argsort(others.log10_false_alarms, kind="stable")]
    same = np.array([_is_same(one, claim, others[k : k + 1]) for k in range(len(others))], np.bool_)
    optimum = others[same][:1]
    better = len(optimum) and optimum.log10_false_alarms[0] <= claim.log10_false_alarms[0]
    if refine and better:
        scale = float(optimum.scale[0])
        distance = float(np.linalg.norm(rotation @ problem.centre3d + translation))
        prior = PosePrior(
            rotation, translation, math.degrees(scale) / EQUALLY_NEAR_SIGMAS, scale * distance / EQUALLY_NEAR_SIGMAS
        )
        near = replace(problem, prior=prior).log10_prior_fraction(*optimum.pose())
        one = replace(problem, log10_tried=max(PoseModel.of(problem).log10_tests([problem]) + near, 0.0))
        claim = optimum
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


def _proposed(problem: Problem, claim: Hypotheses, scene: SearchFrame) -> Hypotheses:
    """Return the distinct poses that annealing reaches from a pose (1,).

    It starts from the pose, from perturbed copies, and from its mirror image in front of a flat scene.
    """
    start = to_scene_frame(claim, scene)
    wide = MIDDLE[-1].last_scale * scene.spread
    bulk = problem.points3d[in_bulk(problem.points3d)]
    mirrored = mirror_pose(bulk, *claim.pose())
    starts = [start, perturb_each(scene, start)]
    if mirrored is not None:
        starts.append(to_scene_frame(Hypotheses.from_poses(mirrored[0][None], mirrored[1][None]), scene))
    around = Hypotheses.concatenate(starts)
    parts = [anneal_on_points(scene, start, wide), anneal_on_points(scene, around, wide), finish(scene, start)]
    poses = finish(scene, merge_hypotheses(parts, scene), FINISHED_POSES)
    return to_problem_frame(poses, scene)


def _with_new_false_alarms(candidates: Hypotheses, problem: Problem) -> Hypotheses:
    """Return the candidates with their false alarms recomputed for the number of tests of the problem."""
    return add_false_alarms(candidates.unweighed(), problem)


def _unrefined(problem: Problem, rotation: Array, translation: Array) -> Hypotheses:
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
