"""Poses nearby that fit better than the best one: it may lie beside an optimum that has other matches.

An enumeration refines its poses with the matches that they have. Where parts of a scene repeat, such as two boards, or
its points lie on a curve, these matches hold the pose back; annealing gives them up at wide scales.
"""

from dataclasses import replace

from bpnp.runtime import NEVER, Deadline
from bpnp.search.hypotheses import Hypotheses, merge_hypotheses, to_problem_frame, to_scene_frame
from bpnp.search.problem import Problem, in_bulk
from bpnp.search.propose.density_map import perturb_each
from bpnp.search.propose.symmetries import mirror_pose
from bpnp.search.refine.annealing import FINISHED_POSES, MIDDLE, anneal_on_points, finish
from bpnp.search.search_frame import SearchFrame
from bpnp.search.verdict.decide import Case, add_false_alarms
from bpnp.search.verdict.limits import LEAST_MARGIN, MOST_MISSED
from bpnp.search.verdict.reasons import Unfinished, objection
from bpnp.search.verdict.rivals import SceneOf, left_by

# Number of image points and of scene points that the best pose leaves from which a better one may exist nearby.
FEWEST_LEFT = 6  # [points; not tuned]
FEWEST_LEFT_FLAT = 1  # the same for a flat scene, whose points may slide along a curve [points; derived]


def nearby(case: Case, *, scene_of: SceneOf, deadline: Deadline = NEVER) -> Case:
    """Return a case with the poses that annealing reaches from the leader of an enumeration, and from copies of it.

    A search with annealing has looked near its leader before (`Case.missed`), and so has the test of a given pose;
    an enumeration to the end, or known matches, leave nothing better.
    """
    problem = case.problem
    if not case.is_fitted or case.exhaustive or case.claim is not None:
        return case
    if min(left_by(case)) < (FEWEST_LEFT_FLAT if case.is_flat else FEWEST_LEFT):
        return case
    is_repeated = len(case.symmetry.of(case.candidates).scale) > 0
    if not (case.is_flat or is_repeated) and replace(case, local_searches=0).missed <= MOST_MISSED:
        return case
    if deadline.ended(Unfinished.competing_poses):
        return case.against(objection("untested"))
    moved = Hypotheses.from_poses(*case.symmetry.of(case.candidates).competitors(*case.pose))
    found = annealed_around(problem, case.candidates[:1], scene_of(), moved)
    late = deadline.passed(Unfinished.competing_poses)  # then not all of them were refined
    found = add_false_alarms(found, problem)
    close = found[found.log10_false_alarms < case.log10_false_alarms + LEAST_MARGIN]
    return (case.among(close) if len(close) else case).against(objection("untested") if late else None)


def annealed_around(
    problem: Problem, pose: Hypotheses, scene: SearchFrame, others: Hypotheses | None = None
) -> Hypotheses:
    """Return the distinct poses that annealing reaches from a pose (1,) and from others.

    It starts from the pose, from perturbed copies, and from its mirror image in front of a flat scene.
    """
    start = to_scene_frame(pose, scene)
    wide = MIDDLE[-1].last_scale * scene.spread
    mirrored = mirror_pose(problem.points3d[in_bulk(problem.points3d)], *pose.pose())
    starts = [start, perturb_each(scene, start)]
    if mirrored is not None:
        starts.append(to_scene_frame(Hypotheses.from_poses(mirrored[0][None], mirrored[1][None]), scene))
    if others is not None:
        starts.append(to_scene_frame(others, scene))
    around = Hypotheses.concatenate(starts)
    parts = [anneal_on_points(scene, start, wide), anneal_on_points(scene, around, wide), finish(scene, start)]
    poses = finish(scene, merge_hypotheses(parts, scene), FINISHED_POSES)
    return to_problem_frame(poses, scene)
