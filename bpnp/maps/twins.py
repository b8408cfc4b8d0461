"""Competing poses elsewhere in a map: similar places may explain the same image points.

A confident pose is compared with three kinds of poses: those found with the points of other views; its images under
motions that map the scene onto itself (`bpnp.search.evidence.repetitions`); and those that short searches near views of
other points find for the image points that it explains.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bpnp.loops.parallel import one_blas_thread
from bpnp.maps.localize import Photo, Region, in_picture, problem_near
from bpnp.maps.views import Array
from bpnp.poses import same_pose, turned_by
from bpnp.search.annealing import finish, polished
from bpnp.search.config import DEFAULT, Draws, Narrowing, RasterSearch, RasterShape, Screens
from bpnp.search.evidence.reasons import number
from bpnp.search.evidence.repetitions import decades_behind, repeated_poses
from bpnp.search.hypotheses import Hypotheses, to_problem_frame
from bpnp.search.kernels.raster import Raster
from bpnp.search.problem import Problem
from bpnp.search.raster_search import search_beside, search_near
from bpnp.search.scene import Scene
from bpnp.search.starts import PosePrior
from bpnp.search.verdict import weighed
from bpnp.solving.matches import count_one_to_one
from bpnp.solving.solution import Candidate, Solution, candidates_of


@dataclass(frozen=True)
class TwinSettings:
    """Constants of the short searches near views of other points.

    Attributes:
        look: Search near each view. Few of the explained image points are outliers for a competing pose. So fewer, more
            smoothed initial poses suffice than near a view that is tried.
        looks: Largest number of views.
        unseen: Least fraction of a view's points that the pose does not see.
        fewest: Least number of such points, and of image points that the pose explains.
        degrees: Rotation uncertainty of the prior of a search near a competing pose, degrees.
        share: Translation uncertainty of that prior, as a fraction of the distance to the points.
    """

    look: RasterSearch = RasterSearch(
        Draws(2**13, least_starts=2**13),
        Screens((50, 300), (2**11, 2**8)),
        Narrowing(0.1, 0.015, steps=6, points=300),
        annealed=6,
    )
    looks: int = 8
    unseen: float = 0.5
    fewest: int = 12
    degrees: float = 4.0
    share: float = 0.04


TWINS = TwinSettings()


@one_blas_thread
def best_rival(photo: Photo, solution: Solution, met: Sequence[Solution]) -> tuple[float, Candidate] | None:
    """Return the best competing pose for the image points that a solution explains.

    Args:
        photo: Keypoints, and all points of the map.
        solution: Confident pose.
        met: Solutions with the points of other views.

    Returns:
        Margin in decades by which it explains the image points worse, and the pose. None if there is no different pose.
    """
    problem, rule = photo.problem, DEFAULT.evidence
    scale = max(solution.stats.residual, problem.image.scales[0])
    best = problem.from_user(solution.rotation, solution.translation)
    repeated, _ = repeated_poses(problem, *best, scale, rule)
    met_poses = [one for other in met for one in other.candidates if one.log10_false_alarms < 0]
    poses = [problem.from_user(one.rotation, one.translation) for one in met_poses]
    poses += [*zip(repeated.rotation, repeated.translation, strict=True), *_looks(photo, solution, problem)]
    matched = np.median(problem.points_from_user(solution.points3d[solution.matches[:, 1]]), 0)

    def different(rotations: Array, translations: Array) -> NDArray[np.bool_]:
        rotations, translations = np.concatenate([best[0][None], rotations]), np.r_[best[1][None], translations]
        return np.asarray(~same_pose(rotations, rotations @ matched + translations, 0, rule.same)[1:])

    rotations, translations = (np.array([pose[k] for pose in poses]).reshape(-1, *x.shape) for k, x in enumerate(best))
    apart = different(rotations, translations)
    if not apart.any():
        return None
    scene = Scene(problem, photo.seed, DEFAULT)
    ends = polished(scene, rotations[apart], translations[apart], scale)
    ends = ends[different(ends.rotation, ends.translation)]
    if not len(ends):
        return None
    twins = ends.rotation, ends.translation
    behind = decades_behind(problem, best, twins, twins, scale)
    k = int(np.argmin(behind))
    return float(behind[k]), _candidate(problem, solution, ends, k, float(behind[k]))


def _candidate(problem: Problem, solution: Solution, ends: Hypotheses, k: int, behind: float) -> Candidate:
    rotation, translation = ends.rotation[k], ends.translation[k]
    seen = problem.project_scene(rotation, translation)
    inliers = count_one_to_one(problem.image_points, seen, solution.inlier_threshold)
    turn, shift = problem.to_user(rotation[None], translation[None])
    alarms = np.array([solution.log10_false_alarms + behind])
    twin = replace(ends[k : k + 1], rotation=turn, translation=shift, log10_false_alarms=alarms)
    return candidates_of(twin, [inliers])[0]


def _looks(photo: Photo, solution: Solution, problem: Problem) -> Iterator[tuple[Array, Array]]:
    """Yield poses for the explained image points of a solution, near views with mostly other points.

    The views are ranked for these image points.
    """
    places = np.flatnonzero(np.isin(problem.usable, solution.matches[:, 0]))
    explained, looks = photo.keypoints[problem.usable[places]], 0
    seen = _seen(photo, solution)
    rasters: dict[tuple[RasterShape, float], Raster] = {}  # shared, since the image points are the same
    for region in photo.regions(explained) if len(explained) >= TWINS.fewest else ():
        if looks == TWINS.looks:
            return
        unseen = ~np.isin(region.point_ids, seen)
        if unseen.sum() < TWINS.fewest or unseen.mean() < TWINS.unseen:
            continue
        looks += 1
        near = problem_near(region, explained, photo.camera, region.prior())
        scene = Scene(near, photo.seed, DEFAULT)
        scene.rasters = rasters
        assert near.prior is not None
        known = scene.enter_prior(near.prior)
        assert isinstance(known, PosePrior)
        found = _likeliest(finish(scene, search_near(scene, known, TWINS.look)), scene, near)
        if len(found) and found.log10_false_alarms[0] < 0:
            start = Hypotheses.from_poses(*scene.enter(found.rotation, found.translation))
            beside = _likeliest(finish(scene, search_beside(scene, start, DEFAULT.beside)), scene, near)
            for one in (found, beside):
                yield problem.from_user(*near.to_user(one.rotation[0], one.translation[0]))


def _likeliest(poses: Hypotheses, scene: Scene, problem: Problem) -> Hypotheses:
    """Return the pose (1,) with the fewest false alarms, in the frame of the problem."""
    return weighed(to_problem_frame(poses, scene), problem)[:1]


def without_twins(
    photo: Photo,
    solution: Solution,
    met: Sequence[Solution],
    search: Callable[[Region, PosePrior], Solution],
    *,
    again: bool = True,
) -> Solution:
    """Return a confident solution, or an ambiguous one if a competing pose elsewhere explains the image points as well.

    An ambiguous solution has both poses as its first candidates. If the competing pose is more likely by the margin
    `Evidence.lead`, the solution that a search near it finds is used instead.

    Args:
        photo: Keypoints, and all points of the map.
        solution: Confident solution.
        met: Solutions with the points of other views.
        search: Searches in a region near a prior.
        again: Allow the replacement by a solution near the competing pose. Default True.
    """
    rival = best_rival(photo, solution, met)
    if rival is None or rival[0] >= DEFAULT.evidence.lead:
        return solution
    behind, twin = rival
    if again and behind <= -DEFAULT.evidence.lead:
        seen = _seen(photo, twin)
        region = max(photo.regions(photo.keypoints), key=lambda one: int(np.isin(one.point_ids, seen).sum()))
        distance = float(np.linalg.norm(twin.rotation @ np.median(region.points3d, 0) + twin.translation))
        better = search(region, PosePrior(twin.rotation, twin.translation, TWINS.degrees, TWINS.share * distance))
        if better.verdict == "confident":
            return without_twins(photo, better, [*met, solution], search, again=False)
    off = math.degrees(turned_by(solution.rotation, twin.rotation))
    reason = f"a pose {off:.0f} deg away, elsewhere in the map, explains the image points about as well"
    reason += f" ({number(-behind)} times as likely)"
    candidates = solution.candidates[0], twin, *solution.candidates[1:]
    return replace(solution, verdict="ambiguous", reason=reason, candidates=candidates)


def _seen(photo: Photo, pose: Solution | Candidate) -> NDArray[np.int64]:
    """Return the ids of the points visible from a pose, within the bounding box of the image points."""
    return photo.place.point_ids[in_picture(photo.problem, pose)]
