"""Pose from two point sets in one call: `solve`, and `solve_many` for many pairs."""

import math
import time
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

from bpnp.geometry import MIN_POINTS
from bpnp.search.verdict import SearchResult
from bpnp.solving.arguments import device_from, each_camera, each_of, each_set, source_from
from bpnp.solving.matches import count_one_to_one, fit_pose, mutual_nearest, one_to_one
from bpnp.solving.priors import Prior, checked_prior
from bpnp.solving.problem import Array, Problem, problem_from
from bpnp.solving.solution import Candidate, Solution, SolutionStats, no_pose
from bpnp.solving.sources import Options, Progress, results_of

SCALES = 3.0  # of the residuals: the threshold of an inlier, if none is given
FIT_ROUNDS = 5
SIGNIFICANT = 22.5  # chi-squared with 6 degrees of freedom, one in a thousand


def solve(
    points2d: Any,
    points3d: Any,
    camera: Any = None,
    *,
    solver: str | Path | nn.Module = "search",
    prior: Prior | str | Path | None = None,
    inlier_threshold: float | int | None = None,
    clutter: float | int | None = None,
    seed: int = 0,
    time_limit: float | int | None = None,
    device: str | torch.device | None = None,
    progress: Progress | None = None,
) -> Solution:
    """Camera pose from 2D and 3D points that nobody has matched.

    points2d: (m, 2) pixels with a `camera`; without one normalised image coordinates, or (m, 3) unit bearings. numpy or
        torch.
    points3d: (n, 3) points of the scene, in any unit.
    camera: 3x3 matrix K; (COLMAP model, parameters) or (model, width, height, parameters); or a pycolmap.Camera.
        Distortion is undone; pixels for which that cannot be done are left out and counted in `stats.dropped2d`.
    solver: "search", which needs no training; a module from `Batch` to `Prediction`; or a checkpoint of a
        BPnPNet or a Matcher.
    prior: a `PosePrior`, a `GravityPrior`, or a BPnPNet or Matcher (or its checkpoint) whose pose is tried first.
    inlier_threshold: largest reprojection error of a match, in pixels with a camera, else in units of the normalised
        image (radians for bearings). By default three times the residuals' own scale.
    clutter: share of the points that has no partner, if known; other shares are then not tried.
    time_limit: seconds a pair, for the module of `prior` and the search together. At the limit each stage of the search
        ends with the poses that it has, and the best of them is returned; matching it to all points comes after.
    device: where a module computes, on a copy; by default where it is. The search always runs on the CPU.
    progress: called with (pair, batch of starts, seconds).

    A pose that is not to be trusted has the verdict "failed"; so have points from which none follows (on one line, or
    fewer than four different ones). Raises ValueError for input that is not usable: wrong or swapped shapes, NaN, fewer
    than 4 points, a singular camera, an unknown option. A module that is given is left as it is.

    >>> rng = np.random.default_rng(0)
    >>> scene = rng.normal(size=(60, 3))
    >>> camera = scene + [0, 0, 6]  # R = I, t = (0, 0, 6)
    >>> image = rng.permutation(camera[:, :2] / camera[:, 2:])
    >>> solution = solve(image, scene)
    >>> solution.verdict, solution.inlier_count
    ('confident', 60)
    >>> bool(np.allclose(solution.translation, [0, 0, 6], atol=1e-6))
    True
    """
    return solve_many(
        [points2d], [points3d], camera, solver=solver, prior=prior, inlier_threshold=inlier_threshold, clutter=clutter,
        seed=seed, time_limit=time_limit, device=device, progress=progress,
    )[0]  # fmt: skip


def solve_many(
    points2d: Any,
    points3d: Any,
    camera: Any = None,
    *,
    solver: str | Path | nn.Module = "search",
    prior: Any = None,
    inlier_threshold: float | int | None = None,
    clutter: float | int | None = None,
    seed: int = 0,
    time_limit: float | int | None = None,
    device: str | torch.device | None = None,
    progress: Progress | None = None,
) -> list[Solution]:
    """`solve` for many pairs; a solution depends on nothing but its own pair.

    points2d: a sequence of arrays (m_i, 2). points3d: one of (n_i, 3), or one array (n, 3) that all pairs share.
    camera, prior: one for all, or a list with one each. time_limit: seconds a pair. On a GPU a module
    solves pairs of similar size together. Raises ValueError as `solve`, before anything is solved; it names the pair.

    >>> scene = np.random.default_rng(0).normal(size=(60, 3))
    >>> images = [(scene + [x, 0, 6])[:, :2] / (scene + [x, 0, 6])[:, 2:] for x in (0, 1)]
    >>> [round(float(solution.translation[0]), 3) + 0.0 for solution in solve_many(images, scene)]
    [0.0, 1.0]
    """
    for name, value in (("inlier_threshold", inlier_threshold), ("time_limit", time_limit)):
        if value is not None and not 0 < value < math.inf:
            raise ValueError(f"expected a positive `{name}`, got {value}")
    sets2d = each_set("points2d", points2d, None)
    sets3d = each_set("points3d", points3d, len(sets2d))
    cameras = each_camera(camera, len(sets2d))
    priors = {i: checked_prior(given) for i, given in enumerate(each_of("prior", prior, len(sets2d)))}
    module, threshold = source_from(solver), _float(inlier_threshold)
    options = Options(_float(clutter), seed, _float(time_limit), device_from(device), progress)
    problems = [
        problem_from(x, p, lens, where=f" in pair {i}" if len(sets2d) > 1 else "")
        for i, (x, p, lens) in enumerate(zip(sets2d, sets3d, cameras, strict=True))
    ]
    dropped = [len(problem.points2d) - len(problem.usable) for problem in problems]
    solvable = {i: problem for i, problem in enumerate(problems) if problem.degenerate is None}
    solutions = {
        i: _failed(problem, problem.degenerate, threshold, dropped[i])
        for i, problem in enumerate(problems)
        if problem.degenerate is not None
    }
    for i, result, seconds in results_of(module, solvable, priors, options):
        solutions[i] = _finished(problems[i], result, seconds, threshold, dropped[i])
    return [solutions[i] for i in range(len(problems))]


def _float(value: float | int | None) -> float | None:
    return None if value is None else float(value)


def _finished(
    problem: Problem, result: SearchResult, seconds: float, inlier_threshold: float | None, dropped: int
) -> Solution:
    """Matches, a last fit to them, and the inliers of every candidate."""
    start, found = time.perf_counter(), result.candidates
    if not len(found):
        return _failed(problem, result.reason, inlier_threshold, dropped)
    threshold = inlier_threshold or SCALES * result.residual * problem.per_radian
    rotation, translation = _fitted(problem, *result.best, threshold)
    projected = problem.project(rotation, translation, problem.local3d)
    matches = one_to_one(problem.image, projected, threshold)
    counts = [len(matches)] + [
        count_one_to_one(problem.image, problem.project(r, t, problem.local3d), threshold)
        for r, t in zip(found.rotation[1:], found.translation[1:], strict=True)
    ]
    rotations = [rotation, *found.rotation[1:]]
    translations = [
        t - r @ problem.origin for r, t in zip(rotations, [translation, *found.translation[1:]], strict=True)
    ]
    error, error_deg = _errors(problem, rotation, translation, projected, matches)
    return Solution(
        rotation=rotation,
        translation=translations[0],
        matches=np.stack([problem.usable[matches[:, 0]], matches[:, 1]], -1),
        inlier_count=len(matches),
        inlier_ratio=len(matches) / min(len(problem.points2d), len(problem.points3d)),
        inlier_threshold=threshold,
        reprojection_error=error,
        reprojection_error_deg=error_deg,
        unit=problem.unit,
        candidates=tuple(
            Candidate(*values)
            for values in zip(
                rotations, translations, found.score.tolist(), counts, found.log10_false_alarms.tolist(), strict=True
            )
        ),
        verdict=result.verdict,
        reason=result.reason,
        log10_false_alarms=result.log10_false_alarms,
        stats=SolutionStats(result.batches, result.residual, result.verdict == "confident", dropped),
        seconds=seconds + time.perf_counter() - start,
        points2d=problem.points2d,
        points3d=problem.points3d,
    )


def _fitted(problem: Problem, rotation: Array, translation: Array, threshold: float) -> tuple[Array, Array]:
    """Least squares on mutually nearest pairs, where that explains them significantly better than the search's pose.

    The search weighs all pairs by their probability, which is the better estimate unless its steps in float32 were too
    coarse for the data. At an optimum of the same precision n log(S / S_min), S the sum of n squared residuals, is
    distributed as chi-squared with 6 degrees of freedom.
    """
    for _ in range(FIT_ROUNDS):
        projected = problem.project(rotation, translation, problem.local3d)
        pairs = mutual_nearest(problem.image, projected, threshold)
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


def _failed(problem: Problem, reason: str, inlier_threshold: float | None, dropped: int) -> Solution:
    rotation, translation = no_pose()
    return Solution(
        rotation=rotation,
        translation=translation,
        matches=np.empty((0, 2), np.int64),
        inlier_count=0,
        inlier_ratio=0.0,
        inlier_threshold=math.nan if inlier_threshold is None else inlier_threshold,
        reprojection_error=math.nan,
        reprojection_error_deg=math.nan,
        unit=problem.unit,
        candidates=(),
        verdict="failed",
        reason=reason,
        log10_false_alarms=math.inf,
        stats=SolutionStats(dropped2d=dropped),
        seconds=0.0,
        points2d=problem.points2d,
        points3d=problem.points3d,
    )
