"""Verify a pose from elsewhere: `verify`."""

import math
import time
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from bpnp.cameras import camera_from
from bpnp.loops.parallel import Deadline
from bpnp.search.evidence.claimed import judge_claim
from bpnp.search.evidence.uncertainty import linearised, pose_covariance
from bpnp.search.hypotheses import Hypotheses
from bpnp.search.problem import Problem
from bpnp.search.verdict import match_count
from bpnp.solving.arguments import Array, Labels, checked_pose, checked_seed, numbers, positive
from bpnp.solving.inputs import problem_from
from bpnp.solving.matches import finished, without_pose
from bpnp.solving.solution import Solution

SECONDS = 10.0


def verify(
    points2d: Any,
    points3d: Any,
    rotation: Any,
    translation: Any,
    camera: Any = None,
    *,
    normals3d: Any = None,
    labels2d: Any = None,
    labels3d: Any = None,
    scores2d: Any = None,
    scores3d: Any = None,
    matches: Any = None,
    refine: bool = True,
    inlier_threshold: float | int | None = None,
    seed: int = 0,
    time_limit: float | int | None = None,
) -> Solution:
    """Verify a pose that comes from elsewhere, and compute how well it is known.

    One pose is tested. It is "confident" if it is significant (one pose was tried, not the many of a search, so that
    about one match beyond the three that fix a pose excludes chance) and if no competing pose is about as likely. The
    competing poses are the optimum beside the pose, its mirror image before a flat scene, repetitions of the scene, and
    other focal lengths. No search is made: use `solve` where a better pose may exist far away.

    Args:
        points2d, points3d, camera, normals3d, labels2d, labels3d, scores2d, scores3d: As for `solve`.
        rotation: (3, 3) of the pose, camera = R p + t.
        translation: (3,) of the pose, in the unit of the scene.
        matches: (k, 2) indices of matched points in points2d and points3d, each point in one match. The pose is judged
            on these alone; some of them may be wrong. None: the matches are unknown.
        refine: Return and judge the optimum beside the pose. It is the same pose: turned by at most 2 degrees and the
            middle of the scene moved by at most a twentieth of its distance, or within what the points leave open.
            False: the pose stays as it is. It is "ambiguous" where the optimum beside it fits significantly better, and
            `covariance` is that of the optimum plus the step to it.
        inlier_threshold: Largest reprojection error of a match, as for `solve`.
        seed: Of the copies of the pose from which the optimum is refined.
        time_limit: Seconds, 10 by default; math.inf for no limit.

    Returns:
        The solution of this pose, with its competitors in `candidates`. It is "failed" if the pose is no better than
        chance, or if a competing pose is likelier by three decades; there may be no matches then.

    Raises:
        ValueError: As `solve`, and for a matrix that is no rotation.

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
    limit = positive("time_limit", SECONDS if time_limit is None else time_limit)
    threshold = positive("inlier_threshold", inlier_threshold, finite=True)
    rotation, translation = checked_pose("", rotation, translation)
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
    judged = problem if given is None else _of_matches(problem, given)
    limits: dict[str, Any] = {"inlier_threshold": threshold, "seed": checked_seed(seed), "time_limit": limit}
    solution = verify_problem(judged, rotation, translation, refine=refine, **limits)
    if given is None or judged.degenerate is not None:
        return solution
    return replace(
        solution,
        matches=given[solution.matches[:, 0]],
        inlier_ratio=solution.inlier_count / len(given),
        points2d=problem.all2d,
        points3d=problem.all3d,
    )


def verify_problem(
    problem: Problem,
    rotation: Array,
    translation: Array,
    *,
    refine: bool = True,
    inlier_threshold: float | None = None,
    seed: int = 0,
    time_limit: float | None = SECONDS,
) -> Solution:
    """Verify a pose of a problem whose points have been checked; arguments and result are those of `verify`.

    Args:
        problem: Points, and what is known of them.
        rotation: (3, 3) of the pose.
        translation: (3,) of the pose, scene units.
        refine, inlier_threshold, seed: As for `verify`.
        time_limit: Seconds; None for no limit.
    """
    begun, deadline = time.perf_counter(), Deadline.after(time_limit)
    if problem.degenerate is not None:
        return without_pose(problem, problem.degenerate, inlier_threshold)
    claim = problem.from_user(rotation, translation)
    result, optimum = judge_claim(problem, *claim, refine=refine, seed=seed, deadline=deadline)
    if result.verdict == "confident" and deadline.passed():
        reason = f"not decided in {time_limit:.3g} s: its competitors were not tested"
        result = replace(result, verdict="ambiguous", reason=reason)
    solution = finished(problem, result, time.perf_counter() - begun, inlier_threshold)
    if not refine and solution.found:  # to the last digit
        first = replace(solution.candidates[0], translation=translation)
        solution = replace(solution, translation=translation, candidates=(first, *solution.candidates[1:]))
    if not refine and solution.verdict != "failed" and len(optimum):
        solution = replace(solution, covariance=_of_unrefined(problem, optimum, rotation, translation))
    return solution


def _checked_matches(values: Any, problem: Problem) -> Labels:
    """Places (k, 2) of a 2D and a 3D point, each in one match; of those that the camera can see."""
    matches, counts = numbers("matches", values), (len(problem.all2d), len(problem.points3d))
    if matches.ndim != 2 or matches.shape[1] != 2 or (matches != np.round(matches)).any():
        raise ValueError(f"expected `matches` as integers of shape (k, 2), got shape {matches.shape}")
    if (matches < 0).any() or (matches >= counts).any():
        raise ValueError(f"expected `matches` below {counts}, the numbers of points, got {matches.max(0).tolist()}")
    for name, side in zip(("2D", "3D"), matches.T.astype(np.int64), strict=True):
        times = np.bincount(side)
        if times.max(initial=0) > 1:
            twice = f"{name} point {times.argmax()} in {times.max()}"
            raise ValueError(f"expected each point in one of the `matches`, got {twice}")
    places = matches.astype(np.int64)
    return np.asarray(places[np.isin(places[:, 0], problem.usable)])


def _of_matches(problem: Problem, matches: Labels) -> Problem:
    """Return the matched points alone, each with a label that only its match has."""
    (i, j), own = matches.T, np.arange(len(matches))
    matched = problem.choose(np.searchsorted(problem.usable, i), j)
    return replace(
        matched,
        labels2d=own,
        labels3d=own,
        odds2d=None,
        classes3d=None,
        indices2d=None,
        given2d=problem.all2d[i],
    )


def _of_unrefined(problem: Problem, optimum: Hypotheses, rotation: Array, translation: Array) -> Array:
    """Return the covariance (6, 6) of a user's pose beside a known optimum: that of the optimum, and the way to it."""
    best, scale = optimum.rotation[0], float(optimum.scale[0])
    linear = linearised(problem, best, optimum.translation[0], scale)
    covariance = pose_covariance(problem, linear, match_count(optimum, problem))
    if covariance is None:
        return np.full((6, 6), math.nan)
    _, shift = problem.to_user(best, optimum.translation[0])
    way = np.r_[Rotation.from_matrix(best @ rotation.T).as_rotvec(), shift - translation]
    return np.asarray(covariance + np.outer(way, way))
