"""Pose of a photo from its keypoints without descriptors: search near one view of a map, and fit to all map points."""

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bpnp.cameras import Camera, camera_from
from bpnp.loops.parallel import one_blas_thread
from bpnp.maps.views import Cones, View
from bpnp.poses import MIN_POINTS
from bpnp.search.annealing import finish, polished
from bpnp.search.competitors import other_lens, settle
from bpnp.search.config import DEFAULT, Evidence
from bpnp.search.evidence.alternatives import competing_pose
from bpnp.search.hypotheses import Hypotheses, to_problem_frame
from bpnp.search.problem import Problem, UnknownFocal, faces
from bpnp.search.raster_search import search_beside
from bpnp.search.scene import Scene
from bpnp.search.starts import PosePrior
from bpnp.search.verdict import judged
from bpnp.solving.arguments import checked_prior
from bpnp.solving.focal_length import AROUND, UnknownCamera, fit_camera, solved_with_focal_length
from bpnp.solving.inputs import problem_from
from bpnp.solving.matches import finished
from bpnp.solving.solution import Candidate, Solution, add_objection
from bpnp.solving.sources import Options, solutions_of

Array = NDArray[np.float64]
MOST_KEYPOINTS = 2048  # half of the 2,000 largest SIFT keypoints have a map point, an eighth of the next ones
VIEW_DEGREES = 15.0  # about the largest angle per axis between photos that share a third of their points
VIEW_SHARE = 0.2  # about the largest shift of the viewed points, as a fraction of their distance
# The search stays near the view's pose, not near the best pose of an unsuccessful earlier search.
# A search in a fourth of the time finds four fifths as many poses, so that short searches near many views pay.
BRIEF = replace(DEFAULT, near=(DEFAULT.everywhere,)).limited(1)
ONCE, LONGER = DEFAULT.limited(1), DEFAULT.limited(16)
COMPETITORS = 4  # competing poses of an ambiguous solution that are judged with it on all points
PROMISING = 3  # views that get a longer search if none is confident
LIKELY = -20.0  # log10 NFA below which a view gets a longer search before the next view
RANKS = {"failed": 0, "ambiguous": 1, "confident": 2}


@dataclass(frozen=True, eq=False)
class Region:
    """Map points that one view, or several, see, and the view to search near.

    Attributes:
        view: View to search near.
        points3d: (k, 3) scene points.
        point_ids: (k,) ids of the points in the COLMAP model.
        cones: Cones of directions from which the points are visible.
        distance: Median distance from the view to its own points, scene units.
    """

    view: View
    points3d: Array
    point_ids: NDArray[np.int64]
    cones: Cones
    distance: float

    def prior(self) -> PosePrior:
        """Return a prior at the view's pose, as wide as the poses of photos of one place differ."""
        return PosePrior(self.view.rotation, self.view.translation, VIEW_DEGREES, VIEW_SHARE * self.distance)


def problem_near(
    region: Region, keypoints: Any, camera: Any, prior: Any, focal: UnknownFocal | None = None, *, views: int = 1
) -> Problem:
    """Return the problem of a photo's keypoints and the points of one region.

    Args:
        region: Points to match.
        keypoints: (m, 2) pixels.
        camera: Camera of the photo.
        prior: Prior of the pose; None for none.
        focal: Prior of the focal length; None if it is known.
        views: Number of views that are tried, which the NFA counts as tests. Default 1.
    """
    lens, (axes, cosines) = camera_from(camera), region.cones
    known: dict[str, Any] = {"normals3d": axes, "cosines3d": cosines, "prior": prior, "focal": focal}
    problem = problem_from(keypoints, region.points3d, lens, **known)
    return replace(problem, log10_views=math.log10(views))


def near_view(region: Region, keypoints: Any, camera: Any, prior: Any, options: Options, *, views: int = 1) -> Solution:
    """Return the best pose of a photo among the points of one region.

    Args:
        region: Points, and the view to search near.
        keypoints: (m, 2) pixels.
        camera: Camera, or an `UnknownCamera`.
        prior: Prior of the photo's pose; None for the view's pose.
        options: Options of the search.
        views: Number of views that are tried, which the NFA counts as tests. Default 1.
    """
    expected = checked_prior(region.prior() if prior is None else prior)
    if isinstance(camera, UnknownCamera):

        def problem_at(lens: Any, focal: UnknownFocal) -> Problem:
            return problem_near(region, keypoints, lens, expected, focal, views=views)

        solution = solved_with_focal_length(problem_at, camera, options)
    else:
        solution = solutions_of({0: problem_near(region, keypoints, camera, expected, views=views)}, options)[0]
    return with_ids(solution, region)


@dataclass(frozen=True, eq=False)
class Photo:
    """A photo to localise, and the part of the map to localise it in.

    Attributes:
        keypoints: (m, 2) pixels.
        camera: Camera of the photo.
        place: Points to match, and the view to search near.
        regions: Returns regions of the map, ranked for keypoints (k, 2).
        seed: Seed of the search, default 0.
    """

    keypoints: Array
    camera: Any
    place: Region
    regions: Callable[[NDArray[np.float64]], Iterable[Region]]
    seed: int = 0

    @cached_property
    def problem(self) -> Problem:
        """Problem of the keypoints and all points of the place."""
        return problem_near(self.place, self.keypoints, self.camera, None)


def with_ids(solution: Solution, region: Region) -> Solution:
    """Return a solution with the point ids of a region and the name of its view."""
    return replace(solution, view=region.view.name, point_ids=region.point_ids)


def in_picture(problem: Problem, pose: Solution | Candidate) -> NDArray[np.bool_]:
    """Return a mask (n,) of the scene points visible from a pose, within the bounding box of the image points."""
    seen, image = problem.project_scene(*problem.from_user(pose.rotation, pose.translation)), problem.image_points
    inside = (seen >= image.min(0)) & (seen <= image.max(0))  # not NaN
    return np.asarray(inside.all(-1))


def points_in_view(place: Region, camera: Any, pose: Solution | View, keypoints: Array) -> NDArray[np.int64]:
    """Return the indices of the points visible from a pose, within the bounding box of the keypoints (m, 2), pixels."""
    in_camera = place.points3d @ pose.rotation.T + pose.translation
    ahead = (in_camera[:, 2] > 0) & faces(place.cones.axes, place.cones.cosines, in_camera, pose.rotation)
    indices = np.flatnonzero(ahead)
    seen = camera_from(camera).project(in_camera[indices])
    inside = ((seen >= keypoints.min(0)) & (seen <= keypoints.max(0))).all(-1)  # not NaN
    return indices[inside]


def strongest_of(scores: Any, shape: tuple[int, ...]) -> NDArray[np.int64]:
    """Return the indices of the strongest keypoints, ascending; raise ValueError unless each keypoint has a score."""
    if np.shape(scores) != shape:
        raise ValueError(f"expected `scores` of shape {shape}, one a keypoint, got {np.shape(scores)}")
    return np.sort(np.argsort(-np.asarray(scores), kind="stable")[:MOST_KEYPOINTS])


def among_all(solution: Solution, used: NDArray[np.int64], keypoints: Any) -> Solution:
    """Return a solution of some keypoints (`used`) with its matches and points expressed among all keypoints."""
    matches = np.column_stack([used[solution.matches[:, 0]], solution.matches[:, 1]])
    points2d = camera_from(solution.camera).normalise(np.asarray(keypoints, np.float64))
    return replace(solution, matches=matches, points2d=points2d)


def rank(solution: Solution) -> tuple[int, float]:
    """Sort key: confident before ambiguous before failed, then fewer false alarms."""
    return RANKS[solution.verdict], -solution.log10_false_alarms


@one_blas_thread
def on_all_points(solution: Solution, photo: Photo, lens: Camera | UnknownCamera, views: int) -> Solution:
    """Refine a pose on all map points in view, and judge it on them.

    An unknown focal length is fitted to them too. A pose that is not confident yet is compared with its competing
    poses, and with those that local searches around it find. `without_twins` searches for others.

    Args:
        solution: Pose that was found with the points of one view.
        photo: Keypoints, and all points of the map.
        lens: Given camera, or its prior.
        views: Number of views that are tried.

    Returns:
        The refined solution if its NFA is smaller, or if it is confident and the given one was not. Otherwise the given
            solution, or a copy whose verdict is lowered by a competing pose among all points.
    """
    place, camera, rule = photo.place, solution.camera, DEFAULT.evidence
    if not solution.found:
        return solution
    seen = points_in_view(place, camera, solution, photo.keypoints)
    if len(seen) < max(len(solution.matches), MIN_POINTS):
        return solution
    cones = Cones(place.cones.axes[seen], place.cones.cosines[seen])
    region = replace(place, points3d=place.points3d[seen], point_ids=place.point_ids[seen], cones=cones)

    def problem_at(lens: Any, focal: UnknownFocal | None = None) -> Problem:
        return problem_near(region, photo.keypoints, lens, None, focal, views=views)

    pose, scale = (solution.rotation, solution.translation), solution.stats.residual
    if isinstance(lens, UnknownCamera):
        lens = lens.seen_by(problem_at(lens.reference))
        fitted = fit_camera(problem_at, lens, camera_from(camera), pose, scale, photo.seed, AROUND)
        problem, ends = fitted.problem, fitted.poses
        rotation, shift = ends.rotation[0], ends.translation[0]
    else:
        problem = problem_at(lens)
        rotation, shift = problem.from_user(*pose)
        least = problem.image.scales[0]
        ends = polished(Scene(problem, photo.seed, DEFAULT), rotation[None], shift[None], max(scale, least))
    scene, sure = Scene(problem, photo.seed, DEFAULT), solution.verdict == "confident"
    # A coarse optimum may have a finer one nearby.
    looks = int(ends.scale[0] > scale) if sure else looks_for_certainty(rule)
    start = Hypotheses.from_poses(*scene.enter(rotation[None], shift[None]))
    others = [] if sure else [one for one in solution.candidates[1:] if one.log10_false_alarms < 0][:COMPETITORS]
    if others:
        turns, shifts = problem.from_user(
            np.stack([one.rotation for one in others]), np.stack([one.translation for one in others])
        )
        ends = Hypotheses.concatenate([ends, polished(scene, turns, shifts, max(scale, problem.image.scales[0]))])
    for _ in range(looks):
        beside = finish(scene, search_beside(scene, start, DEFAULT.beside), DEFAULT.finished)
        ends = Hypotheses.concatenate([ends, to_problem_frame(beside, scene)])
    alone = judged(ends, problem, batches=1, exhaustive=True, rule=rule)
    result = settle(alone, problem, lambda: scene, rule, exhaustive=True)
    rotations, shifts = np.stack([rotation, result.best[0]]), np.stack([shift, result.best[1]])
    behind = result.log10_false_alarms - solution.log10_false_alarms
    if sure and not problem.same_pose(rotations, shifts, rule.same)[1]:
        other = competing_pose(rotation, result.best[0], behind)
        return solution if behind >= rule.lead else add_objection(solution, other)
    if behind < 0 or (not sure and result.verdict == "confident"):
        found = finished(problem, result, solution.seconds, None)
        stats = replace(found.stats, iterations=solution.stats.iterations)
        candidates = (*found.candidates, *solution.candidates[1:])
        return with_ids(replace(found, stats=stats, candidates=candidates), region)
    if not sure:
        return solution
    if alone.verdict != "confident":  # other cameras have not been tested for it
        lens_objection = other_lens(alone, problem, lambda: scene, rule)
        return solution if lens_objection is None else add_objection(solution, lens_objection)
    if result.verdict == "confident":
        return solution
    return replace(solution, verdict=result.verdict, reason=result.reason, reason_code=result.code)


def looks_for_certainty(rule: Evidence) -> int:
    """Return the number of local searches that exclude a better pose nearby, whatever its initial poses were."""
    again = (rule.missed - math.log10(rule.look_fails)) / math.log10(rule.again_fails)
    return 1 + max(math.ceil(again), 0)
