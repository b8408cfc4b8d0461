"""Pose of a photo in a map from its keypoints, without descriptors: a queue of views, and one loop over it.

Each step searches near one view of the map. A promising pose is refined on all map points in view, judged on them, and
compared with poses elsewhere in the map that explain the same image points. The loop ends with a confident pose, with
an empty queue, or at the time limit.
"""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bpnp.cameras import Camera, camera_from
from bpnp.maps.aliasing import Competitor, best_competitor, explained_keypoints, judge_against, significant
from bpnp.maps.all_points import judge_on_all_points, refine_on_all_points
from bpnp.maps.photo_problem import Photo, with_ids
from bpnp.maps.viewed_points import Place, Region, ViewedPoints
from bpnp.runtime import NEVER, Clock, Deadline
from bpnp.search.arguments import checked_prior
from bpnp.search.assemble import Solved, with_unfinished
from bpnp.search.focal_length import UnknownCamera, solve_with_focal_length
from bpnp.search.problem import Problem, UnknownFocal
from bpnp.search.propose.density_map import EVERYWHERE
from bpnp.search.settings import DEFAULT, SearchSettings
from bpnp.search.solution import Candidate, Solution
from bpnp.search.solvers import Options, solve_problems
from bpnp.search.verdict import reasons
from bpnp.search.verdict.decide import Case
from bpnp.search.verdict.limits import LEAST_MARGIN
from bpnp.search.verdict.reasons import objection

# Half of the 2,000 largest SIFT keypoints have a map point, an eighth of the next ones.
MOST_KEYPOINTS = 2048  # largest number of keypoints that are used [keypoints; measured, the photos are not recorded]
ITERATIONS = 1  # iterations of a search near a view [iterations; not tuned]
LONGER_ITERATIONS = 16  # iterations of a longer search near a promising view [iterations; not tuned]
PROMISING_VIEWS = 3  # number of views that get a longer search if none is confident [views; not tuned]
LIKELY_ALARMS = -20.0  # largest log10 NFA with which a view is searched longer before the next one [decades; not tuned]
JUDGING_SECONDS = 1.5  # time to judge a photo's pose on all points of a map, at most half of a limit [seconds; cost]

# The search stays near the view's pose, not near the best pose of an unsuccessful earlier search.
# A search in a fourth of the time finds four fifths as many poses, so that short searches near many views pay.
BRIEF = replace(DEFAULT, near=(EVERYWHERE,)).limited(ITERATIONS)
ONCE, LONGER = DEFAULT.limited(ITERATIONS), DEFAULT.limited(LONGER_ITERATIONS)
RANKS = {"failed": 0, "ambiguous": 1, "confident": 2}


class ViewSolution(NamedTuple):
    """The solution of a search near a view."""

    place: Place  # view, its points and the camera of the search
    solved: Solved
    is_judged: bool  # refined and judged on all points

    @property
    def solution(self) -> Solution:
        return self.solved.solution

    @property
    def rank(self) -> tuple[int, float]:
        """Sort key, see `rank`."""
        return rank(self.solution)


@dataclass(frozen=True)
class MapSolution:
    """Solution of a photo near the views of a map."""

    solution: Solution
    is_complete: bool  # false if the time limit ended the loop without a confident pose


def localize(
    maps: Sequence[ViewedPoints], photo: Photo, views: Sequence[str] | None, options: Options, time_limit: float
) -> MapSolution:
    """Estimate the pose of a photo in a map; see `SceneMap.localize`.

    The last of `maps` is the map; those before it have rotated views and are tried first, each in half of the time that
    is left. `views` are tried in their order, best first; None stands for all. `time_limit` is in seconds, math.inf for
    no limit. Raise ValueError if no view sees 4 or more points.
    """
    start, deadline, tried = Clock.now(), Deadline.after(time_limit).before(JUDGING_SECONDS), set[str]()
    results = list[MapSolution]()
    for k, scene in enumerate(maps):
        until = deadline if k + 1 == len(maps) else replace(deadline.share(1 / 2), unfinished=set())
        results.append(_localize_in(scene, photo, views, options._replace(time_limit=time_limit, until=until), tried))
        if results[-1].solution.verdict == "confident":
            break
    solution = max((result.solution for result in results), key=rank)
    is_complete = solution.verdict == "confident" or all(result.is_complete for result in results)
    if not is_complete:
        count = len(maps[-1].views if views is None else views)
        deadline.unfinished.add(reasons.Unfinished.views)
        solution = replace(solution, reason=reasons.unfinished(solution.reason, time_limit, len(tried), count))
        solution = with_unfinished(solution, deadline)
    return MapSolution(replace(solution, seconds=Clock.now() - start), is_complete)


def _localize_in(
    scene: ViewedPoints, photo: Photo, views: Sequence[str] | None, options: Options, tried: set[str]
) -> MapSolution:
    """Search near the views of a map until a pose is confident, the queue is empty, or time is over.

    Each view is tried briefly, then once more. A view with a likely pose, and in the end the most promising views, get
    a longer search. The names of the tried views are added to `tried`.
    """
    places = scene.places(views, photo.keypoints, photo.camera, photo.rank_views)
    if not places:
        raise ValueError("no view of the map sees 4 or more points, which a pose needs")
    photo = replace(photo, view_count=len({place.view.name for place in places}))
    queue = deque((place, settings) for settings in (BRIEF, ONCE) for place in places)
    earlier, best, longer = list[Candidate](), list[ViewSolution](), set[str]()
    while queue and not (best and options.until.passed()):
        place, settings = queue.popleft()
        tried.add(place.view.name)
        own = search_near(scene.region(place.view, place.points), photo, place.camera, options, settings)
        found = ViewSolution(place, own, False)
        if own.case.objection is None or own.solution.log10_false_alarms < 0:
            found = judge_in_map(scene, photo, found, earlier, options.until)
        if None in (own.case.objection, found.solved.case.objection):
            return MapSolution(found.solution, found.solution.reason_code not in reasons.UNTESTED)
        earlier += significant(found.solution)
        best = sorted([*best, found], key=lambda one: one.rank, reverse=True)[:PROMISING_VIEWS]
        again = [found] if found.solution.log10_false_alarms < LIKELY_ALARMS and len(longer) < PROMISING_VIEWS else []
        if not queue:  # not significant so far, but perhaps with all points of the map
            best = [judge_in_map(scene, photo, one, earlier, options.until) for one in best]
            best.sort(key=lambda one: one.rank, reverse=True)
            if best[0].solution.verdict == "confident":
                return MapSolution(best[0].solution, True)
            again = best
        for one in reversed(again):
            if one.place.view.name not in longer:
                longer.add(one.place.view.name)
                queue.appendleft((one.place._replace(camera=_camera_near(photo.camera, one.solution)), LONGER))
    if not queue:
        return MapSolution(best[0].solution, True)
    return MapSolution(judge_in_map(scene, photo, best[0], earlier, options.until).solution, False)


def search_near(
    region: Region, photo: Photo, camera: Camera | UnknownCamera, options: Options, settings: SearchSettings
) -> Solved:
    """Return the best pose of a photo among the points of one region."""
    options = options._replace(settings=settings, asks=options.asks and settings is LONGER)
    prior = checked_prior(region.prior() if photo.prior is None else photo.prior)
    if isinstance(camera, UnknownCamera):

        def problem_at(known: Any, focal: UnknownFocal) -> Problem:
            return photo.problem(region, known, prior, focal)

        case, solution = solve_with_focal_length(problem_at, camera, options)
    else:
        case, solution = solve_problems({0: photo.problem(region, camera, prior)}, options)[0]
    return Solved(case, with_ids(solution, region))


def judge_in_map(
    scene: ViewedPoints, photo: Photo, found: ViewSolution, earlier: Sequence[Candidate], until: Deadline = NEVER
) -> ViewSolution:
    """Refine and judge a pose on all map points in view and, if it is confident, against poses elsewhere in the map.

    If a pose elsewhere is more likely by `LEAST_MARGIN`, it is refined and judged in the same way, and used instead
    if it is confident. A pose that was judged before is returned unchanged; one whose competing poses were not all
    tested by the deadline is "ambiguous" at best.
    """
    if found.is_judged:
        return found
    place, own = found.place, found.solved
    deadline = Deadline(until.final)
    if deadline.passed(reasons.Unfinished.competing_poses):
        return ViewSolution(place, _if_tested(own, deadline, until), False)
    whole = scene.region(place.view)
    on_all = judge_on_all_points(own, refine_on_all_points(own.solution, photo, whole, deadline))
    if on_all.case.objection is None:
        earlier = [*earlier, *significant(own.solution)]
        competitor = find_competitor(scene, photo, place, on_all.solution, earlier, deadline)
        if competitor is not None and competitor.margin <= -LEAST_MARGIN:
            better = _judge_competitor(scene, photo, on_all.solution, competitor.pose, deadline)
            if better.case.objection is None:
                earlier = [*earlier, *significant(on_all.solution)]
                competitor = find_competitor(scene, photo, place, better.solution, earlier, deadline)
                on_all = better
        on_all = judge_against(on_all, competitor)
    return ViewSolution(place, _if_tested(on_all, deadline, until), True)


def _if_tested(solved: Solved, deadline: Deadline, until: Deadline) -> Solved:
    """Return a solution, ambiguous if the deadline of its verdict cut off a test; a longer one takes note of it."""
    until.unfinished.update(deadline.unfinished)
    if solved.case.objection is None and deadline.unfinished & reasons.TESTS:
        solved = solved.against(objection("untested"))
    return solved._replace(solution=with_unfinished(solved.solution, deadline))


def find_competitor(
    scene: ViewedPoints,
    photo: Photo,
    place: Place,
    solution: Solution,
    earlier: Sequence[Candidate],
    deadline: Deadline = NEVER,
) -> Competitor | None:
    """Return the best pose elsewhere in the map that explains the same image points as a confident solution."""
    if deadline.passed(reasons.Unfinished.competing_poses):
        return None
    explained = explained_keypoints(photo, solution)
    regions = scene.ranked_regions(camera_from(solution.camera), explained, photo.rank_views)
    return best_competitor(photo, scene.region(place.view), solution, earlier, regions, deadline)


def _judge_competitor(
    scene: ViewedPoints, photo: Photo, solution: Solution, pose: Candidate, deadline: Deadline
) -> Solved:
    """Return the solution of a competing pose of a solution, refined and judged on all map points in view."""
    whole, camera = scene.region(scene.views[0]), camera_from(solution.camera)
    seen = np.zeros(len(scene.points3d), bool)
    seen[whole.in_view(pose.rotation, pose.translation, camera, photo.keypoints)] = True
    whole = replace(whole, view=max(scene.views, key=lambda view: int(seen[view.points].sum())))
    proposed = replace(
        solution,
        rotation=pose.rotation,
        translation=pose.translation,
        matches=np.empty((0, 2), np.int64),
        candidates=(pose,),
        verdict="failed",
        log10_false_alarms=np.inf,
    )
    refined = refine_on_all_points(proposed, photo, whole, deadline)
    return judge_on_all_points(Solved(Case.without_pose(photo.problem(whole, camera)), proposed), refined)


def rank(solution: Solution) -> tuple[int, float]:
    """Sort key: confident before ambiguous before failed, then fewer false alarms."""
    return RANKS[solution.verdict], -solution.log10_false_alarms


def strongest_of(scores: Any, shape: tuple[int, ...]) -> NDArray[np.int64]:
    """Return the indices of the strongest keypoints, ascending; raise ValueError unless each keypoint has a score."""
    if np.shape(scores) != shape:
        raise ValueError(f"`scores` has the shape {np.shape(scores)}, not {shape}, one score per keypoint")
    return np.sort(np.argsort(-np.asarray(scores), kind="stable")[:MOST_KEYPOINTS])


def among_all(solution: Solution, used: NDArray[np.int64], keypoints: Any) -> Solution:
    """Return a solution that was found with some keypoints, `used`, with its matches as indices of all keypoints."""
    matches = np.column_stack([used[solution.matches[:, 0]], solution.matches[:, 1]])
    points2d = camera_from(solution.camera).normalise(np.asarray(keypoints, np.float64))
    return replace(solution, matches=matches, points2d=points2d)


def _camera_near(camera: Camera | UnknownCamera, solution: Solution) -> Camera | UnknownCamera:
    """Return the camera for a longer search near a solution.

    An unknown camera gets the focal length of a significant solution; otherwise all focal lengths are tried.
    """
    if isinstance(camera, UnknownCamera) and solution.log10_false_alarms < 0:
        return camera.near(camera_from(solution.camera))
    return camera
