"""Camera pose from unmatched 2D and 3D points: `solve` for one problem, `solve_many` for many."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from bpnp.argument_types import ArrayLike, ImageSize, ManyArrays, ManyPoints, PointsLike, PoseLike
from bpnp.arrays import Labels
from bpnp.cameras import Camera, ManyCameras, camera_from
from bpnp.runtime import Clock, Deadline, default_float_errors
from bpnp.search.arguments import (
    ManyPriors,
    PriorLike,
    about,
    check_inside,
    checked_clutter,
    checked_prior,
    checked_seed,
    device_from,
    each_camera,
    each_prior,
    each_set,
    pixels_from,
    positive,
    seconds_from,
    source_from,
    split_distortion,
)
from bpnp.search.few_points.enumeration import is_enumerable
from bpnp.search.focal_length import solve_with_focal_length, unknown_camera
from bpnp.search.inputs import problem_from
from bpnp.search.problem import Problem, UnknownFocal
from bpnp.search.rig.arguments import RigOptions, prepare
from bpnp.search.solution import Solution
from bpnp.search.solvers import TIME_LIMIT, Options, Progress, solve_problems

TIME_LIMIT_OF_MANY = 5.0  # default time limit of each problem of `solve_many` [seconds; convention]

if TYPE_CHECKING:
    import torch

# Arguments of `solve_many` with one value per problem, besides the camera, which may be one for all.
PER_PROBLEM = ("points2d", "points3d", "normals3d", "labels2d", "labels3d", "scores2d", "scores3d", "prior")


def solve(
    points2d: ManyPoints,
    points3d: PointsLike,
    camera: ManyCameras | None = None,
    distortion: ArrayLike | bool | None = False,
    *,
    image_size: ImageSize | None = None,
    focal_error: float | int | None = None,
    normals3d: ArrayLike | None = None,
    labels2d: ManyArrays | None = None,
    labels3d: ArrayLike | None = None,
    scores2d: ManyArrays | None = None,
    scores3d: ArrayLike | None = None,
    solver: "str | Path | torch.nn.Module" = "auto",
    prior: PriorLike | None = None,
    inlier_threshold: float | int | None = None,
    clutter: float | int | None = None,
    rig: Sequence[PoseLike] | None = None,
    scale: bool = False,
    seed: int = 0,
    time_limit: float | int | None = None,
    device: "str | torch.device | None" = None,
    progress: Progress | None = None,
) -> Solution:
    """Estimate the camera pose from 2D and 3D points without correspondences.

    Args:
        points2d: (m, 2) pixels with a `camera`; without one (m, 2) normalised image coordinates or (m, 3) unit
            bearings. NumPy or torch arrays, OpenCV's (m, 1, 2) arrays, and rows of four or more numbers that begin with
            x and y are accepted. The centre of the first pixel is (0.5, 0.5), as in COLMAP. A list of cv2.KeyPoint is
            shifted by half a pixel, except with OpenCV's (K, distortion).
        points3d: (n, 3) scene points in any unit; also a point cloud or mesh of trimesh or Open3D.
        camera: 3x3 matrix K; [fx, fy, cx, cy]; OpenCV's (K, distortion); (COLMAP model, parameters); (model, width,
            height, parameters); or a pycolmap.Camera. Points are undistorted. Pixels that cannot be undistorted are
            dropped and counted in `stats.dropped2d`. None for normalised coordinates and bearings.
        distortion: OpenCV's coefficients k1, k2, p1, p2[, k3[, k4, k5, k6]] of a `camera` that is K or [fx, fy, cx,
            cy]: `solve(points2d, points3d, K, coefficients)` is the same as the camera (K, coefficients). Or True to
            fit a radial coefficient in any case. It needs an `image_size`, or a `focal_error` with a camera that has
            no distortion. Default False: a coefficient is fitted with an unknown focal length and kept only if it is
            significantly better; with a `rig` none is fitted. None is the same as False.
        image_size: (width, height) of the image, pixels, if there is no `camera`. The focal length is then estimated
            with the pose and returned in `Solution.camera`, and the principal point is the image centre. An error with
            a `camera`. None if there is a camera, or no pixels.
        focal_error: Standard deviation of the focal length of `camera`, as a fraction of it between 0 and 1, such as
            0.1. The focal length is then estimated too. An error without a `camera`. None if the focal length is exact.
        normals3d: (n, 3) outward unit normals. A point that faces away from the camera is not visible. None: all points
            are visible from all sides.
        labels2d: (m,) integers, such as colours, classes or identities; only points with equal labels match, and -1
            matches any. Or (m, c) class probabilities whose rows sum to 1, such as those of a network: a match then
            weighs more, the better its classes agree. Give both `labels2d` and `labels3d`, or neither. None: any two
            points may match.
        labels3d: (n,) integers or (n, c) class probabilities, as `labels2d`.
        scores2d: (m,) probabilities in (0, 1] that a point has a correspondence, such as from keypoint strength. They
            weight the points in the search and the verdict. Only their ratios matter. None: all are equal.
        scores3d: (n,) probabilities in (0, 1], as `scores2d`, such as from the number of views that see a point.
        solver: "search" runs the search, which needs no training. "auto", the default, also starts it from poses of a
            packaged matcher if the search is undecided and the problem is not small (see `inlier_threshold`):
            "matcher-maps" with a `PosePrior`, and "matcher-sfm" without a prior and with m n at most four million. Or a
            module from `Batch` to `Prediction`, or a checkpoint of a BPnPNet or a Matcher or the name of packaged
            weights: the pose is then that of the module. With a Matcher and a problem that is not small, the search
            starts only from P3P poses of match triples sampled from the assignment.
        prior: A `PosePrior`; a pose with an uncertainty of 10 degrees, as a `Solution`, (R, t), OpenCV's (rvec, tvec),
            [R | t] of shape (3, 4) or (4, 4), or a pycolmap.Rigid3d; a `GravityPrior`; or a BPnPNet or Matcher, its
            checkpoint, or "learned" for the weights "procedural-so3", whose pose is tried first. None for no prior.
        inlier_threshold: Largest reprojection error of a match, in pixels with a camera, else in normalised image units
            (radians for bearings). Default: three times the scale of the residuals. Small problems, those whose matches
            are enumerated (m n at most 4,000, or 250,000 where a prior lets two matches fix a pose), also use it as
            search radius, by default 3 pixels, or 0.003 without a camera. It is not used if the labels pair each point
            with one other.
        clutter: Expected fraction of the image points without a correspondence, 0 or more and below 1. None if it is
            unknown: several fractions are tried.
        rig: Extrinsics cam_from_rig of each camera of a rig, each a pose as for `prior`.
            `points2d`, `labels2d` and `scores2d` are then lists with one array per camera; `camera` is one for all or a
            list without None. The returned pose is rig_from_world, in the unit of the rig and of the scene, and a
            `prior` is one of this pose. `matches` index the 2D points of all cameras, concatenated. An unknown focal
            length is one factor for all cameras, and `Solution.camera` is then the first camera. `device`, and a
            network as `solver` or `prior`, raise ValueError. None for one camera.
        scale: With `rig`: also estimate the scale of a scene whose unit differs from the rig's, such as a COLMAP model.
            `Solution.scale` satisfies rig = scale R p + t, with t in the unit of the rig. The rig needs a non-zero
            baseline, and a `prior` has no `translation_sigma`. Default False.
        seed: Seed of the search, default 0.
        time_limit: Seconds in total, 10 by default; math.inf for no limit. At the limit each stage ends with its
            current poses, and the best pose is returned. `stats.unfinished` names the stages that were cut short. A
            pose whose competing poses were not all tested is "ambiguous" at best.
        device: Device on which a copy of a module runs; None for the module's own device. The search runs on the CPU.
        progress: Callback with (problem index, batches of initial poses, seconds), called after each batch and after
            the enumeration of a small problem (0 batches). With an unknown focal length both numbers restart at each
            focal length. It is not called if a module computes the poses. None for no callback.

    Returns:
        Solution of the problem. Its `verdict` is "confident", "ambiguous" or "failed" (docs/verdict.md). It is also
            "failed" if the points do not determine a pose (collinear, or fewer than four distinct points). A module
            given as `solver` is not modified.

    Raises:
        ValueError: The input has wrong or swapped shapes, NaN, a singular camera matrix, or options that exclude each
            other. Or there are too few points: fewer than 4 in an image (each image of a `rig`) or in the scene, 3 with
            a `GravityPrior`.

    >>> import numpy as np
    >>> from bpnp import solve
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
    options = dict(locals())
    options |= {name: [options[name]] for name in PER_PROBLEM}
    options["time_limit"] = seconds_from(time_limit, TIME_LIMIT)
    return solve_many(**options)[0]


@default_float_errors
def solve_many(
    points2d: ManyPoints,
    points3d: ManyPoints,
    camera: ManyCameras | None = None,
    distortion: ArrayLike | bool | None = False,
    *,
    image_size: ImageSize | None = None,
    focal_error: float | int | None = None,
    normals3d: ManyArrays | None = None,
    labels2d: ManyArrays | None = None,
    labels3d: ManyArrays | None = None,
    scores2d: ManyArrays | None = None,
    scores3d: ManyArrays | None = None,
    solver: "str | Path | torch.nn.Module" = "auto",
    prior: ManyPriors | None = None,
    inlier_threshold: float | int | None = None,
    clutter: float | int | None = None,
    rig: Sequence[PoseLike] | None = None,
    scale: bool = False,
    seed: int = 0,
    time_limit: float | int | None = None,
    device: "str | torch.device | None" = None,
    progress: Progress | None = None,
) -> list[Solution]:
    """Solve many problems, each as `solve` does.

    Problems are independent, with one exception: small problems (m n at most 4,000, or 250,000 where a prior lets two
    matches fix a pose) with the same image points and camera never share an image point. The problem with the fewest
    false alarms keeps its matches. A later one that used some of their points is solved again without them;
    `stats.taken2d` counts them.

    Args:
        points2d: Sequence of k arrays (m_i, 2) or (m_i, 3), one per problem.
        points3d: Sequence of k arrays (n_i, 3), or one array for all problems.
        camera: One camera for all problems, or a list of k cameras. None for normalised coordinates and bearings.
        distortion: OpenCV's coefficients of the one `camera`, or True to always fit a radial one; as for `solve`.
        image_size: (width, height) of the images, pixels, for all problems; as for `solve`.
        focal_error: Relative standard deviation of the focal length, for all problems; as for `solve`.
        normals3d: Sequence of k arrays (n_i, 3), or one array for all problems.
        labels2d: Sequence of k arrays (m_i,) or (m_i, c), or one array for all problems.
        labels3d: Sequence of k arrays (n_i,) or (n_i, c), or one array for all problems.
        scores2d: Sequence of k arrays (m_i,), or one array for all problems.
        scores3d: Sequence of k arrays (n_i,), or one array for all problems.
        solver: As for `solve`. On a GPU a module solves problems of similar size in one batch.
        prior: One prior for all problems, or a list of k priors. A list [R, t], or of the rows of [R | t], is one.
        inlier_threshold: Largest reprojection error of a match, for all problems; as for `solve`.
        clutter: Expected fraction of the image points without a correspondence, for all problems; as for `solve`.
        rig: Extrinsics of the cameras of a rig that sees all problems; as for `solve`. The image points of a problem,
            `labels2d` and `scores2d` are then lists with one array per camera, and `camera` is one for all or a list
            with one per camera. The problems are then independent.
        scale: With `rig`: also estimate the scale of each scene; as for `solve`.
        seed: Seed of the search, default 0.
        time_limit: Seconds per problem, 5 by default; math.inf for no limit.
        device: Device on which a copy of a module runs; as for `solve`.
        progress: Callback with (problem index, batches of initial poses, seconds); as for `solve`.

    Returns:
        List of k solutions, in the order of the problems.

    Raises:
        ValueError: The input is invalid, as for `solve`. The message names the problem; nothing has been solved then.

    >>> import numpy as np
    >>> from bpnp import solve_many
    >>> scene = np.random.default_rng(0).normal(size=(60, 3))
    >>> images = [(scene + [x, 0, 6])[:, :2] / (scene + [x, 0, 6])[:, 2:] for x in (0, 1)]
    >>> [round(float(solution.translation[0]), 3) + 0.0 for solution in solve_many(images, scene)]
    [0.0, 1.0]
    """
    begun = Clock.now()
    camera, fits_distortion = split_distortion(camera, distortion)
    images = each_set("points2d", points2d, None)
    count = len(images)
    seconds = seconds_from(time_limit, TIME_LIMIT_OF_MANY)
    options = Options(
        solver=None if rig is not None else source_from(solver),
        asks=solver == "auto",
        inlier_threshold=positive("inlier_threshold", inlier_threshold, finite=True),
        clutter=checked_clutter(clutter),
        seed=checked_seed(seed),
        time_limit=seconds,
        device=device_from(device),
        progress=progress,
        until=Deadline(begun + seconds) if count == 1 else Deadline(),
    )
    if scale and rig is None:
        raise ValueError("`scale=True` needs a `rig`: one camera does not determine the unit of a scene")
    point_options = {
        "normals3d": each_set("normals3d", normals3d, count),
        "labels2d": each_set("labels2d", labels2d, count, _axes_of_labels(labels2d)),
        "labels3d": each_set("labels3d", labels3d, count, _axes_of_labels(labels3d)),
        "scores2d": each_set("scores2d", scores2d, count, 1),
        "scores3d": each_set("scores3d", scores3d, count, 1),
    }
    scenes = each_set("points3d", points3d, count)
    if rig is not None:
        chosen = RigOptions(
            rig=rig,
            scale=scale,
            image_size=image_size,
            focal_error=focal_error,
            distortion=fits_distortion,
            solver=solver,
            device=device,
        )
        ready = []
        for i, each in enumerate(each_prior(prior, count)):
            arrays = {name: values[i] for name, values in point_options.items()}
            with about(f"problem {i}" if count > 1 else None):
                ready.append(prepare(images[i], scenes[i], camera, arrays, options.numbered(i), chosen, each))
        return [solve_one().solution for solve_one in ready]
    cameras = each_camera(camera, count)
    priors = [checked_prior(each) for each in each_prior(prior, count)]
    pixels = [pixels_from(points, one, image_size) for points, one in zip(images, cameras, strict=True)]

    shared = set[int]()

    def problem(i: int, lens: Camera | None, focal: UnknownFocal | None = None) -> Problem:
        arrays = {name: values[i] for name, values in point_options.items()}
        with about(f"problem {i}" if count > 1 else None):
            whole = problem_from(
                pixels[i],
                scenes[i],
                lens,
                prior=priors[i],
                focal=focal,
                inlier_threshold=options.inlier_threshold,
                **arrays,
            )
        return replace(whole, is_shared=i in shared)

    if fits_distortion or image_size is not None or focal_error is not None:
        unknown = [unknown_camera(one, image_size, focal_error, fits_distortion) for one in cameras]
        for points in pixels if image_size is not None else ():
            check_inside(points, image_size)
        problems = {i: problem(i, one.reference, one.focal(one.reference)) for i, one in enumerate(unknown)}
        shared |= set().union(*same_images(problems))

        def again(i: int, taken: Labels | None = None) -> Solution:
            def at(lens: Camera, focal: UnknownFocal) -> Problem:
                whole = problem(i, lens, focal)
                return whole if taken is None else whole.without(taken)

            return solve_with_focal_length(at, unknown[i], options.numbered(i)).solution

        solutions = {i: again(i) for i in problems}
    else:
        problems = {i: problem(i, None if one is None else camera_from(one)) for i, one in enumerate(cameras)}
        problems |= {i: replace(problems[i], is_shared=True) for group in same_images(problems) for i in group}

        def again(i: int, taken: Labels | None = None) -> Solution:
            problem = problems[i] if taken is None else problems[i].without(taken)
            return solve_problems({i: problem}, options)[i].solution

        solutions = {i: one.solution for i, one in solve_problems(problems, options).items()}
    share_points(problems, solutions, again)
    return [solutions[i] for i in range(count)]


def _axes_of_labels(labels: Any) -> int:
    """Return the number of axes of one problem's labels: 2 for one array of class probabilities, else 1."""
    return 2 if getattr(labels, "ndim", 1) == 2 and "float" in str(labels.dtype) else 1


def same_images(problems: Mapping[int, Problem]) -> list[list[int]]:
    """Return the groups of small problems that have the same image points and camera."""
    groups: dict[bytes, list[int]] = {}
    for i, problem in problems.items():
        if len(problems) > 1 and problem.degenerate is None and is_enumerable(problem):
            groups.setdefault(problem.measured.points.tobytes() + repr(problem.measured.camera).encode(), []).append(i)
    return [group for group in groups.values() if len(group) > 1]


def share_points(
    problems: Mapping[int, Problem], solutions: dict[int, Solution], again: Callable[[int, Labels], Solution]
) -> None:
    """Assign each image point to at most one of the small problems that have the same image points.

    The problem with the fewest false alarms keeps its matches. A later one that used one of their points is solved
    `again` without these, and its entry of `solutions` changes; its `stats.taken2d` counts them. The points of a failed
    pose stay free.
    """
    for members in same_images(problems):
        taken: set[int] = set()
        for i in sorted(members, key=lambda i: (solutions[i].log10_false_alarms, i)):
            if taken.intersection(solutions[i].matches[:, 0].tolist()):
                solutions[i] = again(i, np.array(sorted(taken)))
            if solutions[i].verdict != "failed":
                taken.update(solutions[i].matches[:, 0].tolist())
