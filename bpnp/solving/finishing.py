"""From what a search found to a `Solution`: a last fit, matches, and the inliers of every candidate."""

import math
import time
from functools import partial
from typing import Any

import numpy as np

from bpnp.geometry import MIN_POINTS
from bpnp.search.evidence.uncertainty import linearised, pose_covariance
from bpnp.search.verdict import SearchResult
from bpnp.solving.matches import count_one_to_one, fit_pose, mutual_nearest, one_to_one
from bpnp.solving.problem import Array, Problem
from bpnp.solving.solution import Candidate, Solution, SolutionStats

SCALES = 3.0  # of the residuals: the threshold of an inlier, if none is given
FIT_ROUNDS = 5
SIGNIFICANT = 22.5  # chi-squared with 6 degrees of freedom, one in a thousand


def finished(problem: Problem, result: SearchResult, seconds: float, inlier_threshold: float | None) -> Solution:
    """Matches, a last fit to them, and the inliers of every candidate."""
    start, found = time.perf_counter(), result.candidates
    if not len(found):
        return without_pose(problem, result.reason, inlier_threshold, seconds)
    threshold = inlier_threshold or SCALES * result.residual * problem.per_radian
    poses = list(zip(found.rotation, found.translation, strict=True))
    if result.batches:  # an enumerated pose is a least-squares fit in float64 already
        poses[0] = _fitted(problem, *poses[0], threshold)
    projected, *others = (problem.view(*pose) for pose in poses)
    matches = one_to_one(problem.image, projected, threshold, problem.allowed)
    counts = [count_one_to_one(problem.image, seen, threshold, problem.allowed) for seen in others]
    error, error_deg = _errors(problem, *poses[0], projected, matches)
    candidates = tuple(
        Candidate(rotation, translation - rotation @ problem.origin, score, count, alarms)
        for (rotation, translation), score, count, alarms in zip(
            poses, found.score.tolist(), [len(matches), *counts], found.log10_false_alarms.tolist(), strict=True
        )
    )
    return Solution(
        rotation=candidates[0].rotation,
        translation=candidates[0].translation,
        matches=np.stack([problem.usable[matches[:, 0]], matches[:, 1]], -1),
        inlier_count=len(matches),
        inlier_ratio=len(matches) / min(len(problem.points2d), len(problem.points3d)),
        inlier_threshold=threshold,
        reprojection_error=error,
        reprojection_error_deg=error_deg,
        unit=problem.unit,
        covariance=_covariance(problem, *poses[0], result),
        candidates=candidates,
        verdict=result.verdict,
        reason=result.reason,
        log10_false_alarms=result.log10_false_alarms,
        stats=SolutionStats(result.batches, result.residual, result.verdict == "confident", *problem.left_out),
        seconds=seconds + time.perf_counter() - start,
        points2d=problem.points2d,
        points3d=problem.points3d,
        camera=problem.camera,
    )


def _covariance(problem: Problem, rotation: Array, translation: Array, result: SearchResult) -> Array:
    """Of the pose, in the user's coordinates; NaN for one that is a guess."""
    sets, count = problem.sets, float(result.candidates.matched[0]) * min(len(problem.bearings), len(problem.points3d))
    linear = None if result.verdict == "failed" else linearised(sets, rotation, translation, result.residual)
    covariance = pose_covariance(sets, linear, count, problem.origin)
    return np.full((6, 6), math.nan) if covariance is None else covariance


def without_pose(problem: Problem, reason: str, inlier_threshold: float | None, seconds: float = 0.0) -> Solution:
    dropped, taken = problem.left_out
    return Solution(
        inlier_threshold=math.nan if inlier_threshold is None else inlier_threshold,
        unit=problem.unit,
        verdict="failed",
        reason=reason,
        stats=SolutionStats(dropped2d=dropped, taken2d=taken),
        seconds=seconds,
        points2d=problem.points2d,
        points3d=problem.points3d,
        camera=problem.camera,
    )


def _fitted(problem: Problem, rotation: Array, translation: Array, threshold: float) -> tuple[Array, Array]:
    """Least squares on mutually nearest pairs, where that explains them significantly better than the search's pose.

    The search weighs all pairs by their probability, which is the better estimate unless its steps in float32 were too
    coarse for the data. At an optimum of the same precision n log(S / S_min), S the sum of n squared residuals, is
    distributed as chi-squared with 6 degrees of freedom.
    """
    for _ in range(FIT_ROUNDS):
        pairs = mutual_nearest(problem.image, problem.view(rotation, translation), threshold, problem.allowed)
        if len(pairs) < MIN_POINTS:
            break
        target, points = problem.image[pairs[:, 0]], problem.local3d[pairs[:, 1]]
        project = partial(problem.project, points=points)
        trial = fit_pose(project, target, rotation, translation, scale=threshold)
        before, after = (float(((project(*pose) - target) ** 2).sum()) for pose in ((rotation, translation), trial))
        if not before > after * math.exp(SIGNIFICANT / target.size):
            break
        rotation, translation = trial
    return rotation, translation


def _errors(
    problem: Problem, rotation: Array, translation: Array, projected: Array, matches: Any
) -> tuple[float, float]:
    """Mean reprojection error of the matches, in the problem's unit and in degrees; NaN without a match."""
    if not len(matches):
        return math.nan, math.nan
    i, j = matches.T
    distance = np.linalg.norm(problem.image[i] - projected[j], axis=-1)
    camera = problem.local3d[j] @ rotation.T + translation
    sine = np.linalg.norm(np.cross(problem.bearings[i], camera), axis=-1)
    angle = np.degrees(np.arctan2(sine, (problem.bearings[i] * camera).sum(-1)))
    return float(distance.mean()), float(angle.mean())
