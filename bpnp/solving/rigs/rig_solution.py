"""The pose of several cameras that are fixed to each other, from the points of all of them."""

import math
import time
from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.special import stdtrit

from bpnp.cameras import camera_from
from bpnp.loops.parallel import Deadline
from bpnp.search.evidence.uncertainty import ONE_SIGMA
from bpnp.search.verdict import SearchResult
from bpnp.solving.arguments import Array, checked_pose, each_camera, each_set, numbers
from bpnp.solving.matches import SCALES, one_to_one, without_pose
from bpnp.solving.problem import Problem, problem_from
from bpnp.solving.rigs.joint import Pose, Rig, search_rig
from bpnp.solving.solution import Candidate, Solution, SolutionStats


def solve_rig(
    points2d: Any,
    points3d: Any,
    camera: Any,
    rig: Sequence[Any],
    *,
    normals3d: Any,
    labels2d: Any,
    labels3d: Any,
    inlier_threshold: float | None,
    clutter: float | None,
    seed: int,
    time_limit: float | None,
) -> Solution:
    """`bpnp.solve` with a `rig`: the pose rig_from_world."""
    begun, deadline = time.perf_counter(), Deadline.after(time_limit)
    mounts = [_mount(k, mount) for k, mount in enumerate(rig)]
    images = each_set("points2d", points2d, None)
    for name, given in (("points2d", images), ("camera", camera), ("labels2d", labels2d)):
        if isinstance(given, list) and len(given) != len(mounts):
            raise ValueError(f"expected {len(mounts)} of `{name}`, one a camera of the `rig`, got {len(given)}")
    cameras = [None if one is None else camera_from(one) for one in each_camera(camera, len(mounts))]
    labels = each_set("labels2d", labels2d, len(mounts), 1)
    problems = [
        problem_from(
            images[k], points3d, cameras[k], normals3d=normals3d, labels2d=labels[k], labels3d=labels3d,
            where=f" of camera {k}",
        )
        for k in range(len(mounts))
    ]  # fmt: skip
    reason = problems[0].degenerate or next((each.degenerate for each in problems if each.degenerate), None)
    if reason is not None:
        return without_pose(problems[0], reason, inlier_threshold)
    cameras_of = Rig([problem.sets for problem in problems], mounts)
    result = search_rig(cameras_of, clutter=clutter, seed=seed, deadline=deadline)
    return _finished(cameras_of, problems, result, inlier_threshold, time.perf_counter() - begun)


def _mount(k: int, value: Any) -> Pose:
    """cam_from_rig as (3, 4), (4, 4) or (R, t)."""
    if isinstance(value, tuple) and len(value) == 2:
        return checked_pose(f"rig[{k}].", *value)
    matrix = numbers(f"rig[{k}]", value, "")
    if matrix.shape not in ((3, 4), (4, 4)):
        raise ValueError(f"expected `rig[{k}]` as cam_from_rig, (3, 4), (4, 4) or (R, t), got shape {matrix.shape}")
    return checked_pose(f"rig[{k}].", matrix[:3, :3], matrix[:3, 3])


def _finished(
    rig: Rig, problems: list[Problem], result: SearchResult, inlier_threshold: float | None, seconds: float
) -> Solution:
    """The matches of all cameras; their 2D points count on from one camera to the next."""
    found = result.candidates
    if not len(found):
        return without_pose(problems[0], result.reason, inlier_threshold, seconds)
    rotation, translation, origin = found.rotation[0], found.translation[0], problems[0].origin
    matches, errors, angles, first = [], [], [], 0
    unit = problems[0].unit
    for k, problem in enumerate(problems):
        threshold = inlier_threshold or SCALES * result.residual * problem.per_radian
        seen = problem.view(*rig.pose_of(k, rotation, translation))
        i, j = one_to_one(problem.image, seen, threshold, problem.allowed).T
        errors.append(np.linalg.norm(problem.image[i] - seen[j], axis=-1))
        angles.append(errors[-1] / problem.per_radian)
        matches.append(np.stack([problem.usable[i] + first, j], -1))
        first += len(problem.points2d)
    every, error = np.concatenate(matches), np.concatenate(errors)
    covariance = None if result.verdict == "failed" else rig.covariance(rotation, translation, result.residual)
    return Solution(
        rotation=rotation,
        translation=translation - rotation @ origin,
        matches=every,
        inlier_count=len(every),
        inlier_ratio=len(every) / sum(min(len(each.points2d), len(each.points3d)) for each in problems),
        inlier_threshold=inlier_threshold or SCALES * result.residual * problems[0].per_radian,
        reprojection_error=float(error.mean()) if len(every) else math.nan,
        reprojection_error_deg=math.degrees(float(np.concatenate(angles).mean())) if len(every) else math.nan,
        unit=unit,
        covariance=np.full((6, 6), math.nan)
        if covariance is None
        else _about_origin(covariance, rotation @ (rig.sets[0].middle + origin), max(2 * len(every) - 6, 1)),
        candidates=tuple(
            Candidate(r, t - r @ origin, float(-alarms), len(every) if number == 0 else 0, float(alarms))
            for number, (r, t, alarms) in enumerate(
                zip(found.rotation, found.translation, found.log10_false_alarms, strict=True)
            )
        ),
        verdict=result.verdict,
        reason=result.reason,
        log10_false_alarms=result.log10_false_alarms,
        stats=SolutionStats(result.batches, result.residual, result.verdict == "confident"),
        seconds=seconds,
        points2d=np.concatenate([problem.points2d for problem in problems]),
        points3d=problems[0].points3d,
    )


def _about_origin(covariance: Array, middle: Array, free: int) -> Array:
    """That of a turn and the shift of the scene's origin, from that of the shift of its middle; with Student's t."""
    x, y, z = middle
    moved = np.eye(6)
    moved[3:, :3] = [[0, -z, y], [z, 0, -x], [-y, x, 0]]
    return np.asarray(float(stdtrit(free, ONE_SIGMA)) ** 2 * moved @ covariance @ moved.T)
