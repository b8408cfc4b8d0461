"""Verification of a given pose: `verify`."""

import math
import time
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from bpnp.argument_types import ArrayLike, PointsLike, PoseLike
from bpnp.arrays import Array, Labels
from bpnp.cameras import CameraLike, camera_from
from bpnp.runtime import NEVER, Deadline, default_float_errors
from bpnp.search.arguments import (
    cameras_from,
    checked_pose,
    checked_seed,
    numbers,
    pose_of,
    positive,
    seconds_from,
    split_distortion,
)
from bpnp.search.assemble import OneCamera, Solved, assembled
from bpnp.search.given_pose import given_pose
from bpnp.search.hypotheses import Hypotheses
from bpnp.search.inputs import problem_from
from bpnp.search.measured import Measured
from bpnp.search.pose_model import PoseModel
from bpnp.search.problem import Problem
from bpnp.search.solution import Solution
from bpnp.search.solvers import TIME_LIMIT, Options, at_deadline, without_pose
from bpnp.search.verdict.decide import decide, match_count
from bpnp.search.verdict.uncertainty import linearised, pose_covariance


@default_float_errors
def verify(
    points2d: PointsLike,
    points3d: PointsLike,
    rotation: PoseLike | ArrayLike,
    translation: ArrayLike | None = None,
    camera: CameraLike | None = None,
    distortion: ArrayLike | None = None,
    *,
    normals3d: ArrayLike | None = None,
    labels2d: ArrayLike | None = None,
    labels3d: ArrayLike | None = None,
    scores2d: ArrayLike | None = None,
    scores3d: ArrayLike | None = None,
    matches: ArrayLike | None = None,
    independent: bool = False,
    refine: bool = True,
    inlier_threshold: float | int | None = None,
    seed: int = 0,
    time_limit: float | int | None = None,
) -> Solution:
    """Verify a given pose and estimate its uncertainty.

    The pose is "confident" if it is significant and no competing pose is about as likely. The competing poses are the
    nearby optimum, the mirror image of a flat scene or of a distant mirror-symmetric one, repetitions of the scene,
    another body among the points that it leaves, and other focal lengths. No search is run: use `solve` if a better
    pose may exist far away.

    Args:
        points2d: (m, 2) pixels with a `camera`, else normalised image coordinates, or (m, 3) bearings; as for `solve`.
        points3d: (n, 3) scene points in any unit; as for `solve`.
        rotation: (3, 3) rotation matrix or OpenCV's rotation vector of the pose, camera = R p + t. Or the whole pose,
            without a `translation`: a `Solution`, (R, t), (rvec, tvec), [R | t] of shape (3, 4) or (4, 4), or a
            pycolmap.Rigid3d.
        translation: (3,) or (3, 1) translation of the pose, in the unit of the scene. None if `rotation` is a pose.
        camera: Camera of the pixels, as for `solve`; None for normalised coordinates and bearings.
        distortion: OpenCV's coefficients of a `camera` that is K or [fx, fy, cx, cy]; None without.
        normals3d: (n, 3) outward unit normals; None if all points are visible from all sides.
        labels2d: (m,) integers or (m, c) class probabilities, as for `solve`.
        labels3d: (n,) integers or (n, c) class probabilities, as for `solve`.
        scores2d: (m,) probabilities in (0, 1] that a point has a correspondence, as for `solve`.
        scores3d: (n,) probabilities in (0, 1], as `scores2d`.
        matches: (k, 2) indices into points2d and points3d; an index out of range, or a point in two matches, raises.
            The pose is judged on these matches alone; some of them may be wrong. A match of a 2D point that cannot be
            undistorted is left out without a message. None if the matches are unknown.
        independent: True for a pose from elsewhere, such as a survey or another sensor. It is the only pose that was
            tested, so that few points are enough: about one match more than the three that determine a pose. Default
            False: it was found on these points, by `solve` or by any other search, and has as many tests as a search;
            `matches` are then chosen among all points too. Give True with matches that have evidence of their own, such
            as descriptors.
        refine: True, the default, to return and judge the nearby optimum. The optimum counts as the same pose if it is
            rotated by at most 2 degrees and shifts the centroid of the scene by at most a twentieth of its distance, or
            if it is within the uncertainty of the pose. False to return the given pose. The verdict is then "ambiguous"
            if the nearby optimum fits significantly better, and `covariance` is that of the optimum plus the outer
            product of the step to it.
        inlier_threshold: Largest reprojection error of a match, as for `solve`.
        seed: Seed of the perturbed copies of the pose from which it is refined, default 0.
        time_limit: Seconds, 10 by default; math.inf for no limit. At the limit not all competing poses have been
            tested, and the verdict is "ambiguous" at best.

    Returns:
        Solution with this pose, and with its competing poses in `candidates`. It is "failed" if the pose is not
            significant, or if a competing pose is more likely by a factor of 1,000; `matches` may then be empty.

    Raises:
        ValueError: The input is invalid, as for `solve`, `rotation` is not a rotation, there is no `translation`, or
            `matches` are not pairs of indices.

    >>> import numpy as np
    >>> import bpnp
    >>> rng = np.random.default_rng(0)
    >>> scene = rng.normal(size=(60, 3))
    >>> camera = scene + [0, 0, 6]  # R = I, t = (0, 0, 6)
    >>> image = rng.permutation(camera[:, :2] / camera[:, 2:])
    >>> bpnp.verify(image, scene, np.eye(3), [0.02, 0, 6.1]).verdict
    'confident'
    >>> bpnp.verify(image, scene, np.eye(3), [0, 1, 6]).verdict
    'failed'
    """
    limit = seconds_from(time_limit, TIME_LIMIT)
    threshold = positive("inlier_threshold", inlier_threshold, finite=True)
    pose = checked_pose("", *_parts_of(rotation, translation))
    camera, fits_distortion = split_distortion(cameras_from(camera, 1), distortion)
    if fits_distortion:
        raise ValueError("`distortion` is True, but `verify` fits none; give OpenCV's coefficients, or leave it out")
    problem = problem_from(
        points2d,
        points3d,
        None if camera is None else camera_from(camera),
        normals3d=normals3d,
        labels2d=labels2d,
        labels3d=labels3d,
        scores2d=scores2d,
        scores3d=scores3d,
    )
    given = None if matches is None else _checked_matches(matches, problem)
    judged = problem if given is None else _of_matches(problem, given, independent=independent)
    limits: dict[str, Any] = {"inlier_threshold": threshold, "seed": checked_seed(seed), "time_limit": limit}
    limits["independent"] = independent
    solution = verify_problem(judged, *pose, refine=refine, **limits).solution
    if given is None:
        return solution
    return replace(
        solution,
        matches=given[solution.matches[:, 0]],
        inlier_ratio=solution.inlier_count / max(len(given), 1),
        stats=replace(solution.stats, dropped2d=problem.measured.dropped),
        points2d=problem.measured.plane,
        points3d=problem.all3d,
        normals3d=problem.normals3d,
    )


def _parts_of(rotation: Any, translation: Any) -> tuple[Any, Any]:
    """Return rotation and translation, which are given one by one or as a pose."""
    pose = pose_of(rotation, "rotation")
    if translation is None:
        if pose is None or pose[1] is None:
            raise ValueError(
                "`translation` is missing; give rotation and translation, or one pose: a Solution, (R, t), (rvec, "
                "tvec), [R | t] or a pycolmap.Rigid3d"
            )
        return pose
    if pose is not None:
        raise ValueError("`rotation` is a whole pose; leave out `translation`, and give the camera as camera=...")
    return rotation, translation


def verify_problem(
    problem: Problem,
    rotation: Array,
    translation: Array,
    *,
    independent: bool = False,
    refine: bool = True,
    inlier_threshold: float | None = None,
    seed: int = 0,
    time_limit: float = TIME_LIMIT,
    until: Deadline = NEVER,
) -> Solved:
    """Verify a pose of a problem whose points have been checked, in scene units; see `verify`.

    `until` is the deadline of a longer task with this time limit, in seconds.
    """
    begun = time.perf_counter()
    options = Options(time_limit=time_limit, until=until)
    deadline = options.deadline(problem)
    if problem.degenerate is not None:
        return without_pose(problem, problem.degenerate, inlier_threshold)
    claim = problem.from_user(rotation, translation)
    case, optimum = given_pose(problem, *claim, refine=refine, independent=independent, seed=seed, deadline=deadline)
    result = at_deadline(decide(case), options, deadline, time_limit)
    seconds = time.perf_counter() - begun
    camera = OneCamera(problem)
    solution = assembled(camera, result, seconds=seconds, inlier_threshold=inlier_threshold, deadline=deadline)
    if not refine and solution.found:  # to the last digit
        first = replace(solution.candidates[0], translation=translation)
        solution = replace(solution, translation=translation, candidates=(first, *solution.candidates[1:]))
    if not refine and solution.verdict != "failed" and len(optimum):
        solution = replace(solution, covariance=_of_unrefined(problem, optimum, rotation, translation))
    return Solved(case, solution)


def _checked_matches(values: Any, problem: Problem) -> Labels:
    """Return the (k, 2) indices of matches whose 2D point is usable; raise ValueError if a point is in two matches."""
    matches, counts = numbers("matches", values), (len(problem.measured.plane), len(problem.points3d))
    if matches.ndim != 2 or matches.shape[1] != 2 or (matches != np.round(matches)).any():
        raise ValueError(
            f"`matches` has the shape {matches.shape}; pairs of indices are needed, integers of shape (k, 2)"
        )
    if (matches < 0).any() or (matches >= counts).any():
        low, high = matches.min(0).astype(int).tolist(), matches.max(0).astype(int).tolist()
        raise ValueError(
            f"`matches` has indices from {low} to {high}; there are {counts[0]} 2D and {counts[1]} 3D points"
        )
    for name, side in zip(("2D", "3D"), matches.T.astype(np.int64), strict=True):
        times = np.bincount(side)
        if times.max(initial=0) > 1:
            raise ValueError(
                f"{name} point {times.argmax()} is in {times.max()} of the `matches`; a point has one at most"
            )
    places = matches.astype(np.int64)
    return np.asarray(places[np.isin(places[:, 0], problem.measured.indices)])


def _of_matches(problem: Problem, matches: Labels, *, independent: bool) -> Problem:
    """Return a problem of the matched points alone, with a unique label for each match.

    Unless they are independent, its tests are the poses of a search on all points, each with the choices of k matches,
    C(m, k) n! / (n - k)!.
    """
    (i, j), own = matches.T, np.arange(len(matches))
    matched = problem.choose(np.searchsorted(problem.measured.indices, i), j)
    if not independent:
        sides = len(problem.bearings), len(problem.points3d)
        chosen = [math.lgamma(a + 1) - math.lgamma(a - len(matches) + 1) for a in sides]
        choices = (sum(chosen) - math.lgamma(len(matches) + 1)) / math.log(10)
        tests = PoseModel.of(problem).log10_tests([problem])
        matched = replace(matched, log10_tried=tests, log10_views=problem.log10_views + choices)
    return replace(
        matched,
        labels2d=own,
        labels3d=own,
        odds2d=None,
        classes3d=None,
        measured=Measured(matched.measured.points, own, problem.measured.plane[i], problem.measured.camera),
    )


def _of_unrefined(problem: Problem, optimum: Hypotheses, rotation: Array, translation: Array) -> Array:
    """Return the covariance (6, 6) of an unrefined pose: that of the optimum, plus the step to it squared."""
    best, scale = optimum.rotation[0], float(optimum.scale[0])
    linear = linearised(problem, best, optimum.translation[0], scale)
    covariance = pose_covariance(problem, linear, match_count(optimum))
    if covariance is None:
        return np.full((6, 6), math.nan)
    _, shift = problem.to_user(best, optimum.translation[0])
    way = np.r_[Rotation.from_matrix(best @ rotation.T).as_rotvec(), shift - translation]
    return np.asarray(covariance + np.outer(way, way))
