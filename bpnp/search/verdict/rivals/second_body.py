"""A second body: another pose of the scene that the image points left by the best one show.

Furniture that was moved, a second device, a reflection: several poses are then right, each for some of the image
points, and the one with the most matches need not be that of the scene. The image points that the best pose leaves are
enumerated again: with the scene points that it leaves, which may be a body of its own, and with all of them, since a
reflection shows them twice.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from bpnp.arrays import Indices
from bpnp.poses import SAME
from bpnp.runtime import NEVER, Deadline
from bpnp.search.few_points.enumeration import enumerate_poses, is_enumerable
from bpnp.search.hypotheses import Hypotheses
from bpnp.search.image_statistics import Outline
from bpnp.search.possible_matches import MATCH_REACH
from bpnp.search.problem import Problem
from bpnp.search.verdict.competitors import distance_between, partners
from bpnp.search.verdict.decide import Case, fits_by_chance, weighed_pose
from bpnp.search.verdict.false_alarms import alarms_of
from bpnp.search.verdict.reasons import Objection, Unfinished, objection

FEWEST_LEFT = 5  # number of points that can show a significant pose: two more than fix it [points; derived]
# Largest number of hypotheses of the points that are left: for a body of its own; for an image of the same points; and
# for one of points with normals: fewer are seen.
MOST_OF_OTHERS, MOST_AGAIN, MOST_FACING = 100_000, 40_000, 2_000  # [hypotheses; cost]
FAR_BODY = 3.0  # distance of another body's pose [tolerances of the same pose; not tuned]
# Decades by which a candidate may be behind a second body that leads; in an enumeration these are `NEAR_NATS`.
NEAR_DECADES = 10.0  # [decades; calibration]
# Fraction of the second pose's matches with scene points of the first from which it shows the same points again.
SHOWN_TWICE = 0.25  # [fraction; not tuned]
# A body of its own: largest number of other scene points in its outline, over that of its points.
MOST_BETWEEN = 0.5  # [fraction; calibration, moved furniture]
COMPARED_BODIES = 4  # number of poses of the rest whose false alarms are computed [poses; cost]


def second_body(case: Case, *, deadline: Deadline = NEVER) -> Case:
    """Return a case against which a second pose far away speaks, which is then among its candidates.

    The second pose is the best of one search of unrelated points with an NFA below 1 once in a thousand cases. The
    first pose is that of most of the scene if it shows more than half of the points that face the camera. It has no
    such lead over an image of the same points. A pose that shows all of one small part and nothing else leaves too
    much: the other body may be seen too little to be found.
    """
    problem = case.problem
    if problem.is_shared or problem.cosines3d is not None or not is_enumerable(problem):
        return case
    first = case.explained
    rest = np.setdiff1d(np.arange(len(problem.bearings)), problem.image.chosen[first.near])
    if len(rest) < FEWEST_LEFT:
        return case
    shown, every = np.unique(first.points[first.near]), np.arange(len(problem.points3d))
    facing = np.isfinite(case.directions[:, 0])
    searches = [(every, MOST_AGAIN) if problem.normals3d is None else (shown, MOST_FACING)]
    if 2 * len(shown) <= facing.sum():
        searches.insert(0, (np.setdiff1d(every, shown), MOST_OF_OTHERS))
    for scene, most in searches:
        if len(scene) < FEWEST_LEFT:
            continue
        if deadline.ended(Unfinished.competing_poses):
            return case.against(objection("untested"))
        left = replace(problem.choose(rest, scene), log10_tried=None)
        pose = _significant(case, left, most, deadline)
        if not len(pose):
            continue
        second = partners(MATCH_REACH, left, *pose.pose(), case.match_scale)
        again = np.intersect1d(scene[second.points[second.near]], shown)
        if 2 * len(shown) > facing.sum() and len(again) < SHOWN_TWICE * second.near.sum():
            continue
        counts = {"first": int(first.near.sum()), "second": int(second.near.sum()), "count": len(problem.bearings)}
        away = distance_between(problem, case.pose, pose.pose())
        both = case.among(weighed_pose(problem, *pose.pose()))
        if not both.has_leader_of(case):  # it has more matches, and is asked in turn
            near = both.candidates.log10_false_alarms <= both.log10_false_alarms + NEAR_DECADES
            return both if case.claim is not None else replace(both, candidates=both.candidates[near])
        return both.against(objection("second_body", 0.0, away=away, **counts))
    return case if problem.labels3d is not None else case.against(_one_part(case, shown, facing, len(rest)))


def _one_part(case: Case, shown: Indices, facing: NDArray[np.bool_], left: int) -> Objection | None:
    """Return an objection if the shown points (k,), at most half of those that face the camera (n,), are one part."""
    if 2 * len(shown) > facing.sum():
        return None
    seen, others = case.directions, np.setdiff1d(np.flatnonzero(facing), shown)
    between = Outline(case.problem.image, seen[shown]).contains(seen[others]).sum()
    if between > MOST_BETWEEN * len(shown):
        return None
    return objection("one_part", count=int(case.explained.near.sum()), others=len(others), left=left)


def _significant(case: Case, left: Problem, most: int, deadline: Deadline) -> Hypotheses:
    """Return the best pose (1,) of the points that are left, (0,) if it is near the first one or fits by chance."""
    found = enumerate_poses(left, radius=case.problem.match_radius, deadline=deadline.final, most=most).poses
    far = ~case.problem.same_as(case.pose, found.rotation, found.translation, SAME.times(FAR_BODY))
    poses = found[np.flatnonzero(far)[:COMPARED_BODIES]]
    if not len(poses):
        return poses
    scales = np.maximum(poses.scale, case.problem.image.scales[0])
    alarms = alarms_of(left, poses.rotation, poses.translation, scales).own
    k = int(np.argmin(alarms))
    return poses[:0] if fits_by_chance(float(alarms[k])) else poses[k : k + 1]
