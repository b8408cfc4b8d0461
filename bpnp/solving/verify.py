"""A pose from elsewhere: is it right, and how well is it known? `verify`."""

import math
import time
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from bpnp.cameras import camera_from
from bpnp.loops.parallel import Deadline
from bpnp.search.candidates import Candidates
from bpnp.search.evidence.claimed import judge_claim
from bpnp.search.evidence.uncertainty import linearised, pose_covariance
from bpnp.search.verdict import match_count
from bpnp.solving.arguments import Array, Labels, checked_pose, numbers, positive
from bpnp.solving.matches import finished, without_pose
from bpnp.solving.problem import Problem, chosen, degenerate_points, problem_from
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
    """Whether a pose that comes from elsewhere is right, and how well it is known.

    The verdict is that of `solve`, with one difference: this pose alone was tried, not all that the points allow, so
    that chance is excluded by far fewer points: by about one match beyond the three that fix a pose.

    **What is promised.** Against the pose speak the poses within some 10 degrees and a tenth of the distance, which are
    searched; the mirror image of a flat scene; repetitions in the scene; another focal length; and of few points, that
    `solve` would enumerate, every other pose. Of many points a few hundred starts are drawn from anywhere, which is
    *no search*: "confident" means that the points do not agree by chance and that nothing that was met fits as well.
    Ask `solve` where a scene may look the same from somewhere far away.

    rotation, translation: (3, 3), (3,), camera = R p + t, in the scene's unit. points2d, points3d, camera, normals3d,
        labels, scores, inlier_threshold, seed: as for `solve`.
    matches: (k, 2) places in points2d and points3d that belong together: the pose is judged on these alone, some of
        which may be wrong; no point in two of them.
    refine: the pose of the solution is the optimum beside the given one, and the verdict is on it. It stays the same
        pose: turned by at most 2 degrees and the middle of the scene moved by at most a twentieth of its distance, or
        within what the points leave open. False: the pose as it is, "ambiguous" where the optimum beside it fits
        significantly better; `covariance` is that of the optimum and the way to it.
    time_limit: seconds, 10 by default, math.inf for no limit.

    "failed": no better than chance, or another pose that was met is likelier by three decades and without alternative;
    there may be no matches then. `candidates`: the pose, and the other ones.
    Raises ValueError as `solve`, and for what is no rotation.

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
    begun = time.perf_counter()
    deadline = Deadline.after(positive("time_limit", SECONDS if time_limit is None else time_limit))
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
    if judged.degenerate is not None:
        return without_pose(judged, judged.degenerate, threshold)
    moved = translation + rotation @ judged.origin
    result, optimum = judge_claim(judged.sets, rotation, moved, refine=refine, seed=seed, deadline=deadline)
    solution = finished(judged, result, time.perf_counter() - begun, threshold)
    if not refine and solution.verdict != "failed" and len(optimum):
        solution = replace(solution, covariance=_of_unrefined(judged, optimum, rotation, moved))
    if given is None:
        return solution
    return replace(
        solution,
        matches=given[solution.matches[:, 0]],
        inlier_ratio=solution.inlier_count / len(given),
        points2d=problem.points2d,
        points3d=problem.points3d,
    )


def _checked_matches(values: Any, problem: Problem) -> Labels:
    """Places (k, 2) of a 2D and a 3D point, each in one match; of those that the camera can see."""
    matches, counts = numbers("matches", values), (len(problem.points2d), len(problem.points3d))
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
    """The matched points alone, each with a label that its partner alone has."""
    (i, j), own = matches.T, np.arange(len(matches))
    usable = np.searchsorted(problem.usable, i)
    sets = replace(chosen(problem.sets, usable, j), labels2d=own, labels3d=own, odds2d=None, classes3d=None)
    return replace(
        problem,
        sets=sets,
        usable=own,
        image=problem.image[usable],
        points2d=problem.points2d[i],
        points3d=problem.points3d[j],
        degenerate=problem.degenerate or degenerate_points(sets.bearings, problem.points3d[j]),
    )


def _of_unrefined(problem: Problem, optimum: Candidates, rotation: Array, translation: Array) -> Array:
    """Covariance (6, 6) of a pose of which an optimum beside it is known: that of the optimum, and the way to it."""
    best, shift, scale = optimum.rotation[0], optimum.translation[0], float(optimum.scale[0])
    linear = linearised(problem.sets, best, shift, scale)
    covariance = pose_covariance(problem.sets, linear, match_count(optimum, problem.sets), problem.origin)
    if covariance is None:
        return np.full((6, 6), math.nan)
    origin = shift - translation - (best - rotation) @ problem.origin
    way = np.r_[Rotation.from_matrix(best @ rotation.T).as_rotvec(), origin]
    return np.asarray(covariance + np.outer(way, way))
