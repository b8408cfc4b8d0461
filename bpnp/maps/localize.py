"""The pose of a photo from its keypoints without descriptors: near one view of a map, which of several is best, and
fitted to all points of the map that its camera sees."""

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bpnp.cameras import camera_from
from bpnp.loops.parallel import one_blas_thread
from bpnp.maps.views import Cones, View
from bpnp.search.annealing import finish, polished
from bpnp.search.candidates import Candidates, in_user_frame
from bpnp.search.evidence.alternatives import Alternative, fits_as_well
from bpnp.search.evidence.rivals import against_rivals, doubted, other_camera
from bpnp.search.point_sets import UnknownFocal
from bpnp.search.raster_search import search_beside
from bpnp.search.scene import Scene
from bpnp.search.settings import DEFAULT
from bpnp.search.starts import PosePrior
from bpnp.search.verdict import judged
from bpnp.solving.arguments import checked_prior
from bpnp.solving.focal_length import UnknownCamera, solved_with_focal_length
from bpnp.solving.matches import finished
from bpnp.solving.problem import Problem, problem_from
from bpnp.solving.solution import Candidate, Solution
from bpnp.solving.sources import Options, solutions_of

Array = NDArray[np.float64]
MOST_KEYPOINTS = 2048  # the strongest; of the 2,000 largest SIFT keypoints half have a point, of the next an eighth
VIEW_DEGREES = 15.0  # about the largest angle per axis between photos of which one sees a third of the other's points
VIEW_SHARE = 0.2  # the same of the shift of what they look at, in distances to it
# The view's pose is the one to look near, not the best pose of a view that was tried in vain.
# A search of a fourth of the time meets four fifths as many poses: near one view after the other that is more.
BRIEF = replace(DEFAULT, near=(DEFAULT.everywhere,)).limited(1)
ONCE, LONGER = DEFAULT.limited(1), DEFAULT.limited(16)
PROMISING = 3  # views that are tried longer if none is confident
LIKELY = -20.0  # log10 of the false alarms below which a view is tried longer before the next one
RANKS = {"failed": 0, "ambiguous": 1, "confident": 2}


@dataclass(frozen=True, eq=False)
class Region:
    """Points (k, 3) of the map that one view, or several, see, their ids and cones, and the view to look near.

    distance: from the view to its own points, the median.
    """

    view: View
    points3d: Array
    point_ids: NDArray[np.int64]
    cones: Cones
    distance: float

    def prior(self) -> PosePrior:
        """The view's pose, as wide as photos of one place lie apart."""
        return PosePrior(self.view.rotation, self.view.translation, VIEW_DEGREES, VIEW_SHARE * self.distance)


def problem_near(region: Region, keypoints: Any, camera: Any, prior: Any, focal: UnknownFocal | None = None) -> Problem:
    """A photo's keypoints and the points of one region, with their cones."""
    lens, (axes, cosines) = camera_from(camera), region.cones
    return problem_from(keypoints, region.points3d, lens, normals3d=axes, cosines3d=cosines, prior=prior, focal=focal)


def near_view(region: Region, keypoints: Any, camera: Any, prior: PosePrior | None, options: Options) -> Solution:
    """The best pose of a photo among the points of one region; its matches have their ids in the map."""
    expected = checked_prior(region.prior() if prior is None else prior)
    if isinstance(camera, UnknownCamera):

        def problem_at(lens: Any, focal: UnknownFocal) -> Problem:
            return problem_near(region, keypoints, lens, expected, focal)

        solution = solved_with_focal_length(problem_at, camera, options)
    else:
        solution = solutions_of({0: problem_near(region, keypoints, camera, expected)}, options)[0]
    return with_ids(solution, region)


@dataclass(frozen=True, eq=False)
class Photo:
    """What is localised, among which points, and near which views of the map, by their rank for image points (k, 2);
    `seed` is of the search."""

    keypoints: Array
    camera: Any
    place: Region
    regions: Callable[[NDArray[np.float64]], Iterable[Region]]
    seed: int = 0

    @cached_property
    def problem(self) -> Problem:
        """Of the keypoints and all points of the place."""
        return problem_near(self.place, self.keypoints, self.camera, None)


def with_ids(solution: Solution, region: Region) -> Solution:
    """A solution among the points of a region, with the ids of these in its matches."""
    matches = np.column_stack([solution.matches[:, 0], region.point_ids[solution.matches[:, 1]]])
    return replace(solution, matches=matches, view=region.view.name, point_ids=region.point_ids)


def in_picture(problem: Problem, pose: Solution | Candidate) -> NDArray[np.bool_]:
    """Which points (n,) of a problem a pose sees where the image points are."""
    image = problem.view(pose.rotation, pose.translation + pose.rotation @ problem.origin)
    inside = (image >= problem.image.min(0)) & (image <= problem.image.max(0))  # not NaN
    return np.asarray(inside.all(-1))


def strongest_of(scores: Any, shape: tuple[int, ...]) -> NDArray[np.int64]:
    """Places of the strongest keypoints, ascending. Raises ValueError unless each of the keypoints has a score."""
    if np.shape(scores) != shape:
        raise ValueError(f"expected `scores` of shape {shape}, one a keypoint, got {np.shape(scores)}")
    return np.sort(np.argsort(-np.asarray(scores), kind="stable")[:MOST_KEYPOINTS])


def counted(solution: Solution, tries: int) -> Solution:
    """The solution with the false alarms of so many views: each is as many tests again."""
    alarms, most = solution.log10_false_alarms + math.log10(tries), DEFAULT.evidence.false_alarms
    if solution.verdict != "confident" or alarms <= most:
        return replace(solution, log10_false_alarms=alarms)
    reason = f"after {tries} views, 10^{alarms:.1f} poses are expected to fit unrelated points as well"
    return replace(solution, log10_false_alarms=alarms, verdict="ambiguous", reason=reason)


def among_all(solution: Solution, used: NDArray[np.int64], keypoints: Any) -> Solution:
    """The solution of some keypoints with its matches and points among all of them."""
    matches = np.column_stack([used[solution.matches[:, 0]], solution.matches[:, 1]])
    points2d = camera_from(solution.camera).normalise(np.asarray(keypoints, np.float64))
    return replace(solution, matches=matches, points2d=points2d)


def rank(solution: Solution) -> tuple[int, float]:
    """Confident before ambiguous before failed; then the fewest false alarms."""
    return RANKS[solution.verdict], -solution.log10_false_alarms


@one_blas_thread
def on_all_points(solution: Solution, photo: Photo, tries: int) -> Solution:
    """A confident solution after so many views, fitted to all points of a photo's place that its camera sees, and
    judged by them; as it was but for a doubt where they explain the keypoints no better."""
    place, seen = photo.place, in_picture(photo.problem, solution)
    cones = Cones(place.cones.axes[seen], place.cones.cosines[seen])
    region = replace(place, points3d=place.points3d[seen], point_ids=place.point_ids[seen], cones=cones)
    if len(region.points3d) < len(solution.matches):
        return solution
    problem = problem_near(region, photo.keypoints, photo.camera, None)
    scene = Scene(problem.sets, photo.seed, DEFAULT)
    rotation, shift = solution.rotation, solution.translation + solution.rotation @ problem.origin
    scale = max(solution.stats.residual, problem.sets.image.scales[0])
    ends = polished(scene, rotation[None], shift[None], scale)
    if ends.scale[0] > solution.stats.residual:  # a coarse optimum: a finer one may be beside it
        start = Candidates.unscored(*scene.enter(rotation[None], shift[None]))
        beside = finish(scene, search_beside(scene, start, DEFAULT.beside), DEFAULT.finished)
        ends = Candidates.concatenated([ends, in_user_frame(beside, scene)])
    # That no better pose was missed is known of the one that is refined.
    rule = DEFAULT.evidence
    alone = judged(ends, problem.sets, batches=1, exhaustive=True)
    result = against_rivals(alone, problem.sets, lambda: scene, rule, exhaustive=True)
    rotations, shifts = np.stack([rotation, result.best[0]]), np.stack([shift, result.best[1]])
    if not problem.sets.same_pose(rotations, shifts, rule.other_deg, rule.other_shift)[1]:
        behind = result.log10_false_alarms - solution.log10_false_alarms
        return solution if behind >= rule.lead else _doubted(solution, fits_as_well(rotation, result.best[0], behind))
    if result.log10_false_alarms < solution.log10_false_alarms:
        fitted = finished(problem, result, solution.seconds, None)
        stats = replace(fitted.stats, iterations=solution.stats.iterations)
        candidates = (*fitted.candidates, *solution.candidates[1:])
        return counted(with_ids(replace(fitted, stats=stats, candidates=candidates), region), tries)
    if alone.verdict != "confident":  # which other cameras have not been asked of
        other = other_camera(alone, problem.sets, lambda: scene, rule)
        return solution if other is None else _doubted(solution, other)
    confident = result.verdict == "confident"
    return solution if confident else replace(solution, verdict=result.verdict, reason=result.reason)


def _doubted(solution: Solution, other: Alternative) -> Solution:
    return replace(solution, verdict="ambiguous", reason=doubted(solution.reason, other))
