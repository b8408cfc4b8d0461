"""Verification of the pose of a view: against the points that other views see, and against the rest of the map."""

from collections.abc import Callable, Iterable
from dataclasses import replace

from bpnp.arrays import Array
from bpnp.cameras import camera_from
from bpnp.maps.aliasing import best_competitor, explained_keypoints, judge_against
from bpnp.maps.photo_problem import Photo, with_ids
from bpnp.maps.viewed_points import Region
from bpnp.maps.views import View
from bpnp.poses import MIN_POINTS
from bpnp.runtime import Deadline
from bpnp.search.assemble import Solved, with_unfinished
from bpnp.search.solution import Solution
from bpnp.search.verdict.reasons import Unfinished, objection, undecided
from bpnp.search.verify import verify_problem


def verify_pose(
    photo: Photo, view: View, region: Region, regions: Callable[[Array], Iterable[Region]], *, time_limit: float
) -> Solution:
    """Verify the pose of a view with the points of a map that was built without it (`region`).

    The pose is judged on the points in view (`verify_problem`), in at most half of the time limit in seconds. It is
    then compared with poses elsewhere in the map, in `regions` ranked for keypoints (k, 2), that explain the same image
    points (`bpnp.maps.aliasing`). Raise ValueError for fewer than 4 keypoints, or fewer than 4 map points in view.
    """
    deadline = Deadline.after(time_limit)
    if len(photo.keypoints) < MIN_POINTS:
        raise ValueError(f"{view.name} has {len(photo.keypoints)} keypoints; at least {MIN_POINTS} are needed")
    seen = region.in_view(view.rotation, view.translation, camera_from(photo.camera), photo.keypoints)
    if len(seen) < MIN_POINTS:
        raise ValueError(
            f"{view.name} can see {len(seen)} points that two other views see; at least {MIN_POINTS} are needed"
        )
    in_view = region.part(seen)
    problem = photo.problem(in_view, photo.camera)
    until = deadline.share(1 / 2)
    case, solution = verify_problem(
        problem,
        view.rotation,
        view.translation,
        independent=True,
        seed=photo.seed,
        time_limit=time_limit,
        until=until,
    )
    solution = with_ids(solution, in_view)
    if solution.verdict == "failed":
        return solution
    explained = regions(explained_keypoints(photo, solution))
    competitor = None if deadline.passed() else best_competitor(photo, region, solution, [], explained, deadline)
    compared = judge_against(Solved(case, solution), competitor)
    if compared.solution.verdict != "confident" or not deadline.passed(Unfinished.competing_poses):
        return with_unfinished(compared.solution, deadline)
    untested = compared.against(objection("untested")).solution
    return with_unfinished(replace(untested, reason=undecided(untested.reason, time_limit)), deadline)
