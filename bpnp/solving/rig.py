"""`solve` with a `rig`: argument checks, the search for one pose of all cameras, and the `Solution`."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from bpnp.cameras import camera_from
from bpnp.loops.parallel import Clock, Deadline
from bpnp.search.evidence.covariance import student_factor
from bpnp.search.pose_model import crossed
from bpnp.search.problem import Problem
from bpnp.search.rig.cameras import Pose, Rig
from bpnp.search.rig.search import search_rig
from bpnp.search.verdict import SearchResult, no_pose
from bpnp.solving.arguments import Array, about, checked_pose, each_camera, each_set, numbers
from bpnp.solving.inputs import problem_from
from bpnp.solving.matches import SCALES, one_to_one, without_pose
from bpnp.solving.solution import POSE_PARAMETERS, SCALE, Solution, with_pose
from bpnp.solving.sources import Options


def solve_rig(
    points2d: Any,
    points3d: Any,
    camera: Any,
    rig: Sequence[Any],
    known: Mapping[str, Any],
    options: Options,
    *,
    scale: bool = False,
) -> Solution:
    """Estimate the pose rig_from_world of a rig; arguments as for `bpnp.solve`.

    Args:
        points2d: List of arrays (m_i, 2), one per camera.
        points3d: (n, 3) scene points.
        camera: One camera for all, or a list with one each.
        rig: Extrinsics cam_from_rig of each camera.
        known: Normals and labels.
        options: Options of the search.
        scale: Estimate the scale of the scene too. Default False.
    """
    begun, labels2d = Clock.now(), known["labels2d"]
    mounts = [_mount(f"rig[{k}]", mount) for k, mount in enumerate(rig)]
    images = each_set("points2d", points2d, None)
    for name, values in (("points2d", images), ("camera", camera), ("labels2d", labels2d)):
        if isinstance(values, list) and len(values) != len(mounts):
            raise ValueError(f"expected {len(mounts)} of `{name}`, one a camera of the `rig`, got {len(values)}")
    labels, problems = each_set("labels2d", labels2d, len(mounts), 1), []
    for k, one in enumerate(each_camera(camera, len(mounts))):
        lens = None if one is None else camera_from(one)
        with about(f"camera {k}"):
            problems.append(problem_from(images[k], points3d, lens, **{**known, "labels2d": labels[k]}))
    cameras = Rig(problems, mounts, is_metric=not scale)
    if scale and not cameras.apart:
        raise ValueError(
            "expected cameras that are apart in `rig` with `scale=True`, got one centre for all, which tells no scale"
        )
    reasons = [problem.degenerate for problem in problems if problem.degenerate is not None]
    if reasons:
        result = no_pose(reasons[0])
    else:
        deadline = Deadline.after(options.time_limit)
        result = search_rig(cameras, clutter=options.clutter, seed=options.seed, deadline=deadline)
    solution = _finished(cameras, problems, result, options.inlier_threshold)
    return replace(solution, seconds=Clock.now() - begun)


def _mount(name: str, value: Any) -> Pose:
    """Return rotation and translation of extrinsics cam_from_rig, given as (3, 4), (4, 4) or (R, t)."""
    if isinstance(value, tuple) and len(value) == 2:
        return checked_pose(f"{name}.", *value)
    matrix = numbers(name, value)
    if matrix.shape not in ((3, 4), (4, 4)):
        raise ValueError(f"expected `{name}` as cam_from_rig, (3, 4), (4, 4) or (R, t), got shape {matrix.shape}")
    return checked_pose(f"{name}.", matrix[:3, :3], matrix[:3, 3])


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
