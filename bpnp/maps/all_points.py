"""Refinement of a pose that was found with the points of one view, on all map points in view, and its verdict."""

import math
from dataclasses import dataclass, replace

import numpy as np

from bpnp.arrays import Array
from bpnp.cameras import camera_from
from bpnp.maps.photo_problem import Photo, with_ids
from bpnp.maps.viewed_points import Region
from bpnp.poses import MIN_POINTS, SAME
from bpnp.runtime import NEVER, Deadline, one_blas_thread
from bpnp.search.assemble import OneCamera, Solved, assembled
from bpnp.search.focal_length import AROUND, UnknownCamera, fit_camera
from bpnp.search.hypotheses import Hypotheses, to_problem_frame
from bpnp.search.problem import Problem, UnknownFocal
from bpnp.search.propose.density_map import LOCAL, search_around
from bpnp.search.refine.annealing import FINISHED_POSES, anneal_to_end, finish
from bpnp.search.search_frame import SearchFrame
from bpnp.search.settings import DEFAULT
from bpnp.search.solution import Solution
from bpnp.search.verdict.competitors import competing_pose
from bpnp.search.verdict.completeness import AGAIN_FAILS, LOOK_FAILS
from bpnp.search.verdict.contest import contest, rivals_of
from bpnp.search.verdict.decide import Case, decide
from bpnp.search.verdict.limits import LEAST_MARGIN, MOST_MISSED
from bpnp.search.verdict.reasons import Unfinished
from bpnp.search.verdict.rivals.lens import lens

JUDGED_COMPETITORS = 4  # competing poses of an ambiguous solution that are judged with it on all points [poses; cost]


@dataclass(frozen=True, eq=False)
class Refined:
    """A pose refined on all map points in view."""

    region: Region
    problem: Problem  # problem of the keypoints and these points, with the fitted camera
    pose: tuple[Array, Array]  # refined rotation (3, 3) and translation (3,), in the frame of the problem
    # The pose, its competing poses and the optima of local searches around it, in the frame of the problem.
    poses: Hypotheses
    scene: SearchFrame  # normalised points of the problem


@one_blas_thread
def refine_on_all_points(solution: Solution, photo: Photo, whole: Region, deadline: Deadline = NEVER) -> Refined | None:
    """Refine a pose that was found with the points of one view on all map points in view, and an unknown focal length.

    The competing poses of a pose that is not confident yet are refined as well. Local searches around it propose more:
    one for a confident pose whose residuals grow, since a coarse optimum may have a finer one nearby; for others as
    many as exclude a better pose nearby. The result is None without a pose, or if fewer points are in view than it has
    matches.
    """
    if not solution.found:
        return None
    pose, scale = (solution.rotation, solution.translation), solution.stats.residual
    found = camera_from(solution.camera)
    seen = whole.in_view(*pose, found, photo.keypoints)
    if len(seen) < max(len(solution.matches), MIN_POINTS):
        return None
    region, camera = whole.part(seen), photo.camera

    def problem_at(known: object, focal: UnknownFocal | None = None) -> Problem:
        return photo.problem(region, known, focal=focal)

    if isinstance(camera, UnknownCamera):
        camera = camera.seen_by(problem_at(camera.reference))
        fitted = fit_camera(problem_at, camera, found, pose, scale, photo.seed, AROUND, deadline=deadline)
        problem, poses = fitted.problem, fitted.poses
        rotation, shift = poses.pose()
    else:
        problem = problem_at(camera)
        rotation, shift = problem.from_user(*pose)
        least = problem.image.scales[0]
        poses = anneal_to_end(
            SearchFrame(problem, photo.seed, DEFAULT, deadline), rotation[None], shift[None], max(scale, least)
        )
    scene, confident = SearchFrame(problem, photo.seed, DEFAULT, deadline), solution.verdict == "confident"
    local_searches = int(poses.scale[0] > scale) if confident else local_searches_for_certainty()
    significant = [one for one in solution.candidates[1:] if one.log10_false_alarms < 0]
    others = [] if confident else significant[:JUDGED_COMPETITORS]
    if others:
        turns, shifts = problem.from_user(
            np.stack([one.rotation for one in others]), np.stack([one.translation for one in others])
        )
        competing = anneal_to_end(scene, turns, shifts, max(scale, problem.image.scales[0]))
        poses = Hypotheses.concatenate([poses, competing])
    start = Hypotheses.from_poses(*scene.enter(rotation[None], shift[None]))
    for _ in range(local_searches):
        if deadline.passed(Unfinished.competing_poses):
            break
        local = finish(scene, search_around(scene, start, LOCAL), FINISHED_POSES)
        poses = Hypotheses.concatenate([poses, to_problem_frame(local, scene)])
    return Refined(region, problem, (rotation, shift), poses, scene)


@one_blas_thread
def judge_on_all_points(own: Solved, refined: Refined | None) -> Solved:
    """Return the refined solution if its NFA is smaller, or if it is confident and the given one was not.

    Otherwise return the given solution, against a competing pose among all points.
    """
    if refined is None:
        return own
    problem, solution, confident = refined.problem, own.solution, own.case.objection is None
    deadline = refined.scene.deadline
    alone = Case.of(refined.poses, problem, exhaustive=True, iterations=1)
    case = contest(alone, rivals_of(lambda: refined.scene, deadline))
    behind = case.log10_false_alarms - solution.log10_false_alarms
    rotation, translation = case.pose
    if confident and not problem.same_as(refined.pose, rotation[None], translation[None], SAME)[0]:
        return own if behind >= LEAST_MARGIN else own.against(competing_pose(problem, refined.pose, case.pose, behind))
    if behind < 0 or (not confident and case.objection is None):
        found = assembled(OneCamera(problem), decide(case), seconds=solution.seconds, deadline=deadline)
        stats = replace(found.stats, iterations=solution.stats.iterations)
        candidates = (*found.candidates, *solution.candidates[1:])
        return Solved(case, with_ids(replace(found, stats=stats, candidates=candidates), refined.region))
    if not confident:
        return own
    if alone.objection is not None:  # other cameras have not been tested for it
        case = lens(alone, scene_of=lambda: refined.scene, deadline=deadline)
        return own if case is alone else own.against(case.objections[-1])
    return own.against(case.objection)


def local_searches_for_certainty() -> int:
    """Return the number of local searches that exclude a better pose nearby, whatever its initial poses were."""
    again = (MOST_MISSED - math.log10(LOOK_FAILS)) / math.log10(AGAIN_FAILS)
    return 1 + max(math.ceil(again), 0)
