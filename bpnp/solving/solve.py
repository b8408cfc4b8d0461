"""Pose from two point sets in one call: `solve`, and `solve_many` for many pairs."""

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

from bpnp.search.enumeration.search import is_few
from bpnp.solving.arguments import Prior, checked_prior, device_from, each_camera, each_of, each_set, source_from
from bpnp.solving.problem import Problem, problem_from
from bpnp.solving.solution import Solution
from bpnp.solving.sources import Options, Progress, solutions_of


def solve(
    points2d: Any,
    points3d: Any,
    camera: Any = None,
    *,
    normals3d: Any = None,
    labels2d: Any = None,
    labels3d: Any = None,
    scores2d: Any = None,
    scores3d: Any = None,
    solver: str | Path | nn.Module = "auto",
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
        torch; also OpenCV's (m, 1, 2) arrays and keypoints, and rows of four or more numbers that begin with x and y.
    points3d: (n, 3) points of the scene, in any unit.
    camera: 3x3 matrix K; (COLMAP model, parameters) or (model, width, height, parameters); or a pycolmap.Camera.
        Distortion is undone; pixels for which that cannot be done are left out and counted in `stats.dropped2d`.
    normals3d: (n, 3) outward unit normals: a point that faces away from the camera is not seen.
    labels2d, labels3d: (m,) and (n,) integers, such as colours, classes or identities: only points of one label are
        matched; -1 fits any.
    scores2d, scores3d: (m,) and (n,) probabilities, above 0 and up to 1, that a point has a partner, such as from the
        strength of a keypoint, or the number of views that see a point; only their ratios matter much.
    solver: "search", which needs no training; "auto", the same, which asks a packaged matcher for poses to start from
        when it is in doubt: "matcher-maps" with a `PosePrior`, such as the pose of a map's view of the same place, and
        "matcher-sfm" without a prior, of up to four million pairs of points; a module from `Batch` to `Prediction`; or
        a checkpoint of a BPnPNet or a Matcher. Of a Matcher and many points not its own poses count, but those that a
        search finds from poses of triples of pairs drawn from its assignment, and from nowhere else.
    prior: a `PosePrior`, a `GravityPrior`, or a BPnPNet or Matcher (or its checkpoint) whose pose is tried first.
    inlier_threshold: largest reprojection error of a match, in pixels with a camera, else in units of the normalised
        image (radians for bearings). By default three times the residuals' own scale.
    clutter: share of the points that has no partner, if known: it is expected throughout, and a pose that matches most
        of the other points is believed sooner.
    time_limit: seconds a pair, for the module of `prior` and the search together. At the limit each stage of the search
        ends with the poses that it has, and the best of them is returned; matching it to all points comes after.
    device: where a module computes, on a copy; by default where it is. The search always runs on the CPU.
    progress: called with (pair, batch of starts, seconds).

    A pose that is not to be trusted has the verdict "failed"; so have points from which none follows (on one line, or
    fewer than four different ones). Raises ValueError for input that is not usable: wrong or swapped shapes, NaN, fewer
    than 4 points (3 with a `GravityPrior`), a singular camera, an unknown option. A module that is given is left as it
    is.

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
        [points2d], [points3d], camera, normals3d=[normals3d], labels2d=[labels2d], labels3d=[labels3d],
        scores2d=[scores2d], scores3d=[scores3d], solver=solver, prior=prior, inlier_threshold=inlier_threshold,
        clutter=clutter, seed=seed, time_limit=time_limit, device=device, progress=progress,
    )[0]  # fmt: skip


def solve_many(
    points2d: Any,
    points3d: Any,
    camera: Any = None,
    *,
    normals3d: Any = None,
    labels2d: Any = None,
    labels3d: Any = None,
    scores2d: Any = None,
    scores3d: Any = None,
    solver: str | Path | nn.Module = "auto",
    prior: Any = None,
    inlier_threshold: float | int | None = None,
    clutter: float | int | None = None,
    seed: int = 0,
    time_limit: float | int | None = None,
    device: str | torch.device | None = None,
    progress: Progress | None = None,
) -> list[Solution]:
    """`solve` for many pairs; a solution depends on nothing but its own pair, unless few-point pairs share an image.

    Where several devices are looked for in the same image points, no point is matched to two of them: the surest
    device keeps its own, and another that claimed some of them is solved again without (`stats.taken2d`).

    points2d: a sequence of arrays (m_i, 2). points3d: one of (n_i, 3), or one array (n, 3) that all pairs share.
    normals3d, labels2d, labels3d, scores2d, scores3d: sequences with one array a pair, or one that all pairs share.
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
    options = Options(
        source_from(solver), solver == "auto", _float(inlier_threshold), _float(clutter), seed, _float(time_limit),
        device_from(device), progress,
    )  # fmt: skip
    sets2d = each_set("points2d", points2d, None)
    count = len(sets2d)
    known = {"normals3d": normals3d, "labels2d": labels2d, "labels3d": labels3d, "scores2d": scores2d,
             "scores3d": scores3d}  # fmt: skip
    annotations = {name: each_set(name, values, count, 1 + (name == "normals3d")) for name, values in known.items()}
    arguments = zip(
        sets2d,
        each_set("points3d", points3d, count),
        each_camera(camera, count),
        map(checked_prior, each_of("prior", prior, count)),
        strict=True,
    )
    problems = {
        i: problem_from(
            x, p, lens, **{name: values[i] for name, values in annotations.items()}, prior=one,
            where=f" in pair {i}" if count > 1 else "",
        )
        for i, (x, p, lens, one) in enumerate(arguments)
    }  # fmt: skip
    solutions = solutions_of(problems, options)
    shared_lights(problems, solutions, lambda i, problem: solutions_of({i: problem}, options)[i])
    return [solutions[i] for i in range(count)]


def _float(value: float | int | None) -> float | None:
    return None if value is None else float(value)


def shared_lights(
    problems: Mapping[int, Problem], solutions: dict[int, Solution], solve_again: Callable[[int, Problem], Solution]
) -> None:
    """Where few-point pairs have the same image points, leave each point to one pair; `solutions` is changed.

    The pair with the fewest false alarms keeps its matches. A later one that claimed one of their points is solved
    again, by `solve_again`, without these; its `stats.taken2d` says how many points that are. A failed pose keeps none.
    """
    if len(problems) < 2:
        return
    groups: dict[bytes, list[int]] = {}
    for i, problem in problems.items():
        if problem.degenerate is None and is_few(problem.sets):
            groups.setdefault(problem.image.tobytes() + repr(problem.camera).encode(), []).append(i)
    for members in groups.values():
        taken: set[int] = set()
        for i in sorted(members, key=lambda i: (solutions[i].log10_false_alarms, i)):
            claimed = set(solutions[i].matches[:, 0].tolist())
            if claimed & taken:
                solutions[i] = solve_again(i, problems[i].without(np.array(sorted(taken))))
                claimed = set(solutions[i].matches[:, 0].tolist())
            if solutions[i].verdict != "failed":
                taken |= claimed
