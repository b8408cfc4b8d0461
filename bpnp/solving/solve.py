"""Pose from two point sets in one call: `solve`, and `solve_many` for many problems."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from bpnp.cameras import Camera, camera_from
from bpnp.loops.parallel import Clock, Deadline
from bpnp.search.enumeration.search import is_enumerable
from bpnp.search.problem import Problem, UnknownFocal
from bpnp.solving.arguments import (
    Labels,
    about,
    check_inside,
    checked_prior,
    checked_seed,
    device_from,
    each_camera,
    each_of,
    each_set,
    pixels_from,
    positive,
    source_from,
)
from bpnp.solving.focal_length import solved_with_focal_length, unknown_camera
from bpnp.solving.infinity import solve_directions
from bpnp.solving.inputs import problem_from
from bpnp.solving.rig import solve_rig
from bpnp.solving.solution import Solution
from bpnp.solving.sources import Options, Progress, solutions_of

if TYPE_CHECKING:
    import torch

SECONDS, SECONDS_OF_MANY = 10.0, 5.0  # that a problem may take, of `solve` and of `solve_many`


def solve(
    points2d: Any,
    points3d: Any,
    camera: Any = None,
    *,
    image_size: Any = None,
    focal_error: float | int | None = None,
    distortion: bool = False,
    normals3d: Any = None,
    labels2d: Any = None,
    labels3d: Any = None,
    scores2d: Any = None,
    scores3d: Any = None,
    solver: "str | Path | torch.nn.Module" = "auto",
    prior: Any = None,
    inlier_threshold: float | int | None = None,
    clutter: float | int | None = None,
    at_infinity: bool = False,
    rig: Sequence[Any] | None = None,
    scale: bool = False,
    seed: int = 0,
    time_limit: float | int | None = None,
    device: "str | torch.device | None" = None,
    progress: Progress | None = None,
) -> Solution:
    """Camera pose from 2D and 3D points that nobody has matched.

    points2d: (m, 2) pixels with a `camera`; without one normalised image coordinates, or (m, 3) unit bearings. numpy or
        torch; also OpenCV's (m, 1, 2) arrays, rows of four or more numbers that begin with x and y, and lists of
        cv2.KeyPoint, which get their half pixel but with OpenCV's (K, distortion): elsewhere (0.5, 0.5) is the centre
        of the first pixel, as in COLMAP.
    points3d: (n, 3) points of the scene, in any unit; also a cloud or mesh of trimesh or Open3D.
    camera: 3x3 matrix K; OpenCV's (K, distortion); (COLMAP model, parameters) or (model, width, height, parameters); or
        a pycolmap.Camera.
        Distortion is undone; pixels for which that cannot be done are left out and counted in `stats.dropped2d`.
    image_size: width and height of the image, pixels, where the focal length is unknown: it is found with the pose, the
        principal point taken to be in the middle. `Solution.camera` is what was found. focal_error: standard deviation
        of the focal length of `camera` where that is rough, as a share of it, such as 0.1. Radial distortion
        is then unknown too, unless `camera` has it: a coefficient is fitted where it is significantly better, with
        distortion=True always.
    normals3d: (n, 3) outward unit normals: a point that faces away from the camera is not seen.
    labels2d, labels3d: (m,) and (n,) integers, such as colours, classes or identities: only points of one label are
        matched; -1 fits any. Or probabilities (m, c) and (n, c) of c classes, whose rows add up to 1, such as a
        network's: a match counts as much more as its classes agree better than those of a mean one.
    scores2d, scores3d: (m,) and (n,) probabilities, above 0 and up to 1, that a point has a partner, such as from the
        strength of a keypoint, or the number of views that see a point; only their ratios matter. The search and the
        verdict weigh the points with them.
    solver: "search", which needs no training; "auto", the same, which asks a packaged matcher for poses to start from
        when it is in doubt: "matcher-maps" with a `PosePrior`, such as the pose of a map's view of the same place, and
        "matcher-sfm" without a prior, if 2D points times 3D points are at most four million; a module from `Batch` to
        `Prediction`; or a checkpoint of a BPnPNet or a Matcher. Of a Matcher and many points not its own poses count,
        but those that a search finds from poses of triples of matches drawn from its assignment, and nowhere else.
    prior: a `PosePrior`; a pose, known to 10 degrees: a `Solution`, (R, t), [R | t] of shape (3, 4) or (4, 4), a
        pycolmap.Rigid3d; a `GravityPrior`, or a BPnPNet or Matcher (or its checkpoint) whose pose is tried first.
    inlier_threshold: largest reprojection error of a match, in pixels with a camera, else in units of the normalised
        image (radians for bearings). By default three times the scale of the residuals. Few points are also searched
        within this radius, by default within 3 pixels. Labels that pair each point with one other need no radius.
    clutter: fraction of the points that has no partner, if it is known. The search and the verdict expect it.
    at_infinity: `points3d` are unit directions, such as of stars: the rotation alone is found, and the translation is
        zero. Pixels of a fisheye may lie 90 degrees and more off its axis. Points with the largest `scores2d` are tried
        first. An `image_size` or `focal_error` is for an unknown focal length here too. See docs/stars.md.
    rig: cam_from_rig, (3, 4), (4, 4) or (R, t), of each of several cameras that are fixed to each other. `points2d` and
        `labels2d` are then lists with one array each, `camera` too or one for all; the pose is rig_from_world, in the
        unit of the rig and of the scene, and `matches` count the 2D points of one camera after those of the other.
    scale: whether the scene has a unit of its own, such as a COLMAP model's, while the rig's is known: `Solution.scale`
        of it is found with the pose, rig = scale R p + t, t in the unit of the rig. Its cameras have to be apart.
    time_limit: seconds for all of it, 10 by default, math.inf for no limit. At the limit each stage of the search ends
        with the poses that it has, and the best of them is returned.
    device: where a module computes, on a copy; by default where it is. The search always runs on the CPU.
    progress: called with (problem, batch of starts, seconds); many problems are then solved in this process alone.

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
    normals_and_labels: dict[str, Any] = {"normals3d": normals3d, "labels2d": labels2d, "labels3d": labels3d}
    scores: dict[str, Any] = {"scores2d": scores2d, "scores3d": scores3d}
    options = Options(
        inlier_threshold=positive("inlier_threshold", inlier_threshold, finite=True),
        clutter=clutter,
        seed=checked_seed(seed),
        time_limit=positive("time_limit", SECONDS if time_limit is None else time_limit),
    )
    beside: dict[str, Any] = {
        "solver": None if solver in ("auto", "search") else solver,
        "prior": prior,
        "device": device,
    }
    if scale and rig is None:
        raise ValueError("expected a `rig` with `scale=True`, got none: one camera does not see the unit of a scene")
    if at_infinity:
        beside |= {"distortion": distortion or None, "scores3d": scores3d, "clutter": clutter, "rig": rig}
        _refuse(normals_and_labels | beside, "at_infinity")
        rough = image_size is not None or focal_error is not None
        unknown = unknown_camera(camera, image_size, focal_error) if rough else None
        return solve_directions(pixels_from(points2d, camera), points3d, camera, unknown, scores2d, options)
    if rig is not None:
        lens = {"image_size": image_size, "focal_error": focal_error, "distortion": distortion or None}
        _refuse(scores | beside | lens, "rig")
        return solve_rig(points2d, points3d, camera, rig, normals_and_labels, options, scale=scale)
    arrays: dict[str, Any] = {name: [values] for name, values in (normals_and_labels | scores).items()}
    return solve_many(
        [points2d],
        [points3d],
        camera,
        image_size=image_size,
        focal_error=focal_error,
        distortion=distortion,
        solver=solver,
        prior=prior,
        inlier_threshold=inlier_threshold,
        clutter=clutter,
        seed=seed,
        time_limit=options.time_limit,
        device=device,
        progress=progress,
        **arrays,
    )[0]


def _refuse(options: Mapping[str, Any], kind: str) -> None:
    """Raise ValueError for what such a problem says nothing of, or cannot have."""
    for name, value in options.items():
        if value is not None:
            raise ValueError(f"expected no `{name}` with `{kind}`, got {value!r:.60}; try without one of them")


def solve_many(
    points2d: Any,
    points3d: Any,
    camera: Any = None,
    *,
    image_size: Any = None,
    focal_error: float | int | None = None,
    distortion: bool = False,
    normals3d: Any = None,
    labels2d: Any = None,
    labels3d: Any = None,
    scores2d: Any = None,
    scores3d: Any = None,
    solver: "str | Path | torch.nn.Module" = "auto",
    prior: Any = None,
    inlier_threshold: float | int | None = None,
    clutter: float | int | None = None,
    seed: int = 0,
    time_limit: float | int | None = None,
    device: "str | torch.device | None" = None,
    progress: Progress | None = None,
) -> list[Solution]:
    """`solve` for many problems; a solution depends on nothing but its own, unless few-point ones share an image.

    Where several devices are looked for in the same image points, no point is matched to two of them: the surest
    device keeps its own, and another that claimed some of them is solved again without (`stats.taken2d`).

    points2d: a sequence of arrays (m_i, 2). points3d, normals3d, labels2d, labels3d, scores2d, scores3d: the same, or
    one array that all problems share. camera, prior: one for all, or a list with one each. time_limit: seconds a
    problem, 5 by default. Everything else as for `solve`. On a GPU a module solves problems of similar size together.
    Raises ValueError as `solve`, before anything is solved; it names the problem.

    >>> scene = np.random.default_rng(0).normal(size=(60, 3))
    >>> images = [(scene + [x, 0, 6])[:, :2] / (scene + [x, 0, 6])[:, 2:] for x in (0, 1)]
    >>> [round(float(solution.translation[0]), 3) + 0.0 for solution in solve_many(images, scene)]
    [0.0, 1.0]
    """
    begun = Clock.now()
    images = each_set("points2d", points2d, None)
    count = len(images)
    seconds = positive("time_limit", SECONDS_OF_MANY if time_limit is None else time_limit)
    options = Options(
        source_from(solver),
        solver == "auto",
        positive("inlier_threshold", inlier_threshold, finite=True),
        None if clutter is None else float(clutter),
        checked_seed(seed),
        seconds,
        device_from(device),
        progress,
        until=Deadline(begun + seconds) if count == 1 and seconds is not None else Deadline(),
    )
    known = {
        "normals3d": each_set("normals3d", normals3d, count),
        "labels2d": each_set("labels2d", labels2d, count, _axes_of_labels(labels2d)),
        "labels3d": each_set("labels3d", labels3d, count, _axes_of_labels(labels3d)),
        "scores2d": each_set("scores2d", scores2d, count, 1),
        "scores3d": each_set("scores3d", scores3d, count, 1),
    }
    scenes, cameras = each_set("points3d", points3d, count), each_camera(camera, count)
    priors = [checked_prior(each) for each in each_of("prior", prior, count)]
    pixels = [pixels_from(points, image_size or one) for points, one in zip(images, cameras, strict=True)]

    def problem(i: int, lens: Camera | None, focal: UnknownFocal | None = None) -> Problem:
        arrays = {name: values[i] for name, values in known.items()}
        with about(f"problem {i}" if count > 1 else None):
            return problem_from(pixels[i], scenes[i], lens, prior=priors[i], focal=focal, **arrays)

    if distortion or (image_size or focal_error) is not None:
        unknown = [unknown_camera(one, image_size, focal_error, distortion) for one in cameras]
        for points in pixels if image_size is not None else ():
            check_inside(points, image_size)
        problems = {i: problem(i, one.reference, one.focal(one.reference)) for i, one in enumerate(unknown)}

        def again(i: int, taken: Labels | None = None) -> Solution:
            def at(lens: Camera, focal: UnknownFocal) -> Problem:
                whole = problem(i, lens, focal)
                return whole if taken is None else whole.without(taken)

            return solved_with_focal_length(at, unknown[i], options)

        solutions = {i: again(i) for i in problems}
    else:
        problems = {i: problem(i, None if one is None else camera_from(one)) for i, one in enumerate(cameras)}

        def again(i: int, taken: Labels | None = None) -> Solution:
            return solutions_of({i: problems[i] if taken is None else problems[i].without(taken)}, options)[i]

        solutions = solutions_of(problems, options)
    share_points(problems, solutions, again)
    return [solutions[i] for i in range(count)]


def _axes_of_labels(labels: Any) -> int:
    """Of the labels of one problem: two if they are one array of class probabilities, for all problems."""
    return 2 if getattr(labels, "ndim", 1) == 2 and "float" in str(labels.dtype) else 1


def share_points(
    problems: Mapping[int, Problem], solutions: dict[int, Solution], again: Callable[[int, Labels], Solution]
) -> None:
    """Leave each image point to one of the few-point problems that have the same image points.

    The problem with the fewest false alarms keeps its matches. A later one that claimed one of their points is solved
    again without these; its `stats.taken2d` counts them. A failed pose keeps none.

    Args:
        problems: By their numbers.
        solutions: Of the problems; changed in place.
        again: Solves a problem, given its number, without some of its 2D points, given their indices (k,).
    """
    groups: dict[bytes, list[int]] = {}
    for i, problem in problems.items():
        if len(problems) > 1 and problem.degenerate is None and is_enumerable(problem):
            groups.setdefault(problem.image_points.tobytes() + repr(problem.camera).encode(), []).append(i)
    for members in groups.values():
        taken: set[int] = set()
        for i in sorted(members, key=lambda i: (solutions[i].log10_false_alarms, i)):
            if taken.intersection(solutions[i].matches[:, 0].tolist()):
                solutions[i] = again(i, np.array(sorted(taken)))
            if solutions[i].verdict != "failed":
                taken.update(solutions[i].matches[:, 0].tolist())
