"""`solve` with a `rig`: argument checks, the search for one pose of all cameras, and the `Solution`."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from bpnp.cameras import camera_from
from bpnp.loops.parallel import Clock, Deadline
from bpnp.search.config import DEFAULT as SEARCH
from bpnp.search.evidence.covariance import student_factor
from bpnp.search.pose_model import crossed
from bpnp.search.problem import Problem
from bpnp.search.rig.cameras import Pose, Rig
from bpnp.search.rig.search import search_rig
from bpnp.search.starts import GravityPrior, PosePrior, Prior
from bpnp.search.verdict import SearchResult, no_pose
from bpnp.solving.arguments import Array, about, checked_pose, pose_of
from bpnp.solving.focal_length import UnknownCamera
from bpnp.solving.inputs import problem_from
from bpnp.solving.matches import SCALES, one_to_one, without_pose
from bpnp.solving.solution import POSE_PARAMETERS, SCALE, Solution, with_pose
from bpnp.solving.sources import Options


def prepare_rig(
    points2d: Sequence[Any],
    points3d: Any,
    cameras: Sequence[Any],
    unknown: Sequence[UnknownCamera] | None,
    mounts: Sequence[Pose],
    known: Mapping[str, Any],
    options: Options,
    *,
    prior: Prior | None = None,
    scale: bool = False,
) -> Callable[[], Solution]:
    """Check the problem of a rig, and return the function that estimates its pose rig_from_world; see `bpnp.solve`.

    Args:
        points2d: Points of each camera.
        points3d: (n, 3) scene points.
        cameras: Camera of each of them; None for normalised coordinates and bearings.
        unknown: Cameras with an unknown focal length; None if it is known.
        mounts: Extrinsics cam_from_rig of each camera.
        known: Lists of `labels2d` and `scores2d`, one array or None per camera; `normals3d`, `labels3d`, `scores3d`.
        options: Options of the search.
        prior: Prior of the pose of the rig.
        scale: Estimate the scale of the scene too. Default False.
    """
    if unknown is not None:
        raise ValueError("expected no unknown focal length with `rig`; give the `camera` of each image")
    placed = isinstance(prior, PosePrior) and prior.translation is not None and math.isfinite(prior.translation_sigma)
    if scale and placed:
        raise ValueError(
            "`prior` has a `translation_sigma`, but with `scale=True` the unit of the scene is unknown, and with it "
            "the distance of the scene from a camera; use PosePrior(rotation, None, rotation_sigma_deg)"
        )
    if options.clutter is not None:
        SEARCH.expecting(options.clutter)  # raises for one that is out of range
    problems = []
    for k, (image, one) in enumerate(zip(points2d, cameras, strict=True)):
        lens = None if one is None else camera_from(one)
        arrays = {name: values[k] if name.endswith("2d") else values for name, values in known.items()}
        with about(f"camera {k}"):
            vertical = prior if isinstance(prior, GravityPrior) else None  # with it, three points fix a pose
            problem = problem_from(image, points3d, lens, prior=vertical, **arrays)
            problems.append(replace(problem, clutter=options.clutter))
    known_pose = prior if prior is None else problems[0].prior_from_user(prior)
    rig = Rig(problems, mounts, is_metric=not scale, prior=known_pose)
    if scale and not rig.apart:
        raise ValueError(
            "all cameras of the `rig` have one centre, which does not determine the scale of the scene; give cameras "
            "with a baseline, or leave out `scale=True`"
        )
    return partial(_solve, rig, options)


def _solve(rig: Rig, options: Options) -> Solution:
    begun = Clock.now()
    reasons = [problem.degenerate for problem in rig.problems if problem.degenerate is not None]
    if reasons:
        result = no_pose(reasons[0])
    else:
        deadline = Deadline.after(options.time_limit)
        result = search_rig(rig, clutter=options.clutter, seed=options.seed, deadline=deadline)
    solution = _finished(rig, rig.problems, result, options.inlier_threshold)
    return replace(solution, seconds=Clock.now() - begun)


def mount_from(name: str, value: Any) -> Pose:
    """Return rotation and translation of extrinsics cam_from_rig; see `pose_of` for the forms."""
    pose = pose_of(value, name)
    if pose is None or pose[1] is None:
        wrong = f"has the shape {value.shape}" if hasattr(value, "shape") else f"is {value!r:.80}"
        raise ValueError(
            f"`{name}` {wrong}; give cam_from_rig as (R, t), a matrix (3, 4) or (4, 4), or a pycolmap.Rigid3d"
        )
    return checked_pose(f"{name}.", *pose)


def _finished(rig: Rig, problems: Sequence[Problem], result: SearchResult, inlier_threshold: float | None) -> Solution:
    """Build the solution with the matches of all cameras; 2D points are indexed over all cameras, concatenated."""
    found, first = result.candidates, problems[0]
    solution = replace(without_pose(first, result.reason, inlier_threshold), camera=None)
    if rig.unknowns == 7:
        parameters = (*POSE_PARAMETERS, SCALE)
        solution = replace(solution, scale=math.nan, covariance=np.full((7, 7), math.nan), parameters=parameters)
    if not len(found):
        return solution
    rotation, translation = found.rotation[0], found.translation[0]
    matches, errors, angles, count = [], [], [], 0
    for k, problem in enumerate(problems):
        threshold = inlier_threshold or SCALES * result.residual * problem.per_radian
        seen = problem.project_scene(*rig.pose_of(k, rotation, translation))
        i, j = one_to_one(problem.image_points, seen, threshold, problem.may_match).T
        errors.append(np.linalg.norm(problem.image_points[i] - seen[j], axis=-1))
        angles.append(errors[-1] / problem.per_radian)
        matches.append(np.stack([problem.usable[i] + count, j], -1))
        count += len(problem.all2d)
    matched = sum(map(len, matches))
    covariance = None if result.verdict == "failed" else rig.covariance(rotation, translation, result.residual)
    if covariance is not None:
        middle = rotation @ first.middle_of_user
        _, shift = first.to_user(rotation, translation[:3])
        covariance = _about_origin(
            covariance, first.size, middle, shift, 1 / translation[3], max(2 * matched - rig.unknowns, 1)
        )
    _, moved = first.to_user(found.rotation, found.translation[:, :3])
    points2d = np.concatenate([problem.all2d for problem in problems])
    dropped = sum(problem.dropped2d for problem in problems)
    return with_pose(
        replace(solution, points2d=points2d, stats=replace(solution.stats, dropped2d=dropped)),
        result,
        replace(found, translation=np.column_stack([moved, found.translation[:, 3]])),
        [matched, *[0] * (len(found) - 1)],
        np.concatenate(matches),
        np.concatenate(errors),
        np.concatenate(angles),
        most=sum(min(len(problem.all2d), len(problem.points3d)) for problem in problems),
        threshold=inlier_threshold or SCALES * result.residual * first.per_radian,
        residual=result.residual,
        covariance=covariance,
    )


def _about_origin(covariance: Array, size: float, middle: Array, shift: Array, scale: float, free: int) -> Array:
    """Return the covariance of the rotation, of the translation in units of the rig, and of the scale if it is unknown.

    Args:
        covariance: Covariance of the rotation, of the shift of the scene's centroid in unit size, and of the log scale.
        size: Size of the scene, user's unit.
        middle: (3,) centroid of the scene from its origin, in the axes of the rig, user's unit.
        shift: (3,) translation, unit of the scene.
        scale: Units of the rig in one unit of the scene.
        free: Degrees of freedom of Student's t.
    """
    moved = np.eye(7)
    moved[3:6, 3:6] *= scale * size
    moved[6, 6] = scale
    moved[3:6, :3] = scale * crossed(middle)
    moved[3:6, 6] = scale * shift
    moved = moved[: len(covariance), : len(covariance)]
    return np.asarray(student_factor(free) * moved @ covariance @ moved.T)
