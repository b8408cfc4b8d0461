"""Verification of the pose of a view: against the points that other views see, and against the rest of the map."""

from dataclasses import replace

import numpy as np

from bpnp.maps.localize import Photo, points_in_view, problem_near, with_ids
from bpnp.maps.twins import best_rival
from bpnp.maps.views import Cones, View
from bpnp.poses import MIN_POINTS
from bpnp.search.config import DEFAULT
from bpnp.search.evidence import reasons
from bpnp.solving.solution import Solution
from bpnp.solving.verify import verify_problem


def verify_pose(photo: Photo, view: View, *, time_limit: float) -> Solution:
    """Verify the pose of a view with the points of a map that was built without it.

    The pose is judged on the points in view (`verify_problem`). It is then compared with poses elsewhere in the map
    that explain the same image points (`bpnp.maps.twins`).

    Args:
        photo: Keypoints of the view, its camera, and the points and views of the map without it.
        view: View with the pose.
        time_limit: Seconds for `verify_problem`; math.inf for no limit.

    Raises:
        ValueError: There are fewer than 4 keypoints, or fewer than 4 map points in view.
    """
    if len(photo.keypoints) < MIN_POINTS:
        raise ValueError(f"{view.name} has {len(photo.keypoints)} keypoints; at least {MIN_POINTS} are needed")
    place, lead = photo.place, DEFAULT.evidence.lead
    seen = points_in_view(place, photo.camera, view, photo.keypoints)
    if len(seen) < MIN_POINTS:
        raise ValueError(
            f"{view.name} can see {len(seen)} points that two other views see; at least {MIN_POINTS} are needed"
        )
    cones = Cones(place.cones.axes[seen], place.cones.cosines[seen])
    region = replace(place, points3d=place.points3d[seen], point_ids=place.point_ids[seen], cones=cones)
    problem = problem_near(region, photo.keypoints, photo.camera, None)
    solution = verify_problem(problem, view.rotation, view.translation, seed=photo.seed, time_limit=time_limit)
    solution = with_ids(solution, region)
    if solution.verdict == "failed":
        return solution
    rival = best_rival(photo, solution, [])
    if rival is None or rival[0] >= lead:
        return solution
    behind, other = rival
    off = np.linalg.norm(other.centre - solution.centre)
    what = f"a pose {off:.3g} scene units away, elsewhere in the map, explains the image points "
    what += "about as well" if behind > -lead else f"better (by {-behind:.1f} decades)"
    return replace(
        solution,
        verdict="ambiguous" if behind > -lead else "failed",
        reason=reasons.against(what, solution.log10_false_alarms),
        candidates=(solution.candidates[0], other, *solution.candidates[1:]),
    )
