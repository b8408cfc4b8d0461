"""The `Solution` of a search: the best pose fitted, points matched and inliers counted, for one camera or a rig."""

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from bpnp.arrays import Array
from bpnp.matching import DENSE_MATCHES, count_one_to_one, one_to_one
from bpnp.runtime import NEVER, Deadline
from bpnp.search.hypotheses import Hypotheses
from bpnp.search.match_fit import fit_to_matches
from bpnp.search.possible_matches import MATCH_REACH
from bpnp.search.problem import Problem
from bpnp.search.solution import FOCAL_LENGTH, POSE_PARAMETERS, Candidate, Solution, SolutionStats
from bpnp.search.verdict.decide import Case, SearchResult, Verdict, decide
from bpnp.search.verdict.reasons import Objection
from bpnp.search.verdict.uncertainty import Linearised, linearised, pose_covariance


@runtime_checkable
class Cameras(Protocol):
    """What a `Solution` needs of the cameras that see its points."""

    is_rig: bool  # the image points are numbered over several cameras

    @property
    def problems(self) -> Sequence[Problem]:
        """Problem of each camera; the first one has the unit and the frame of the user."""

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the estimated parameters."""

    def pose_of(self, k: int, rotation: Array, translation: Array) -> tuple[Array, Array]:
        """Return the poses (..., 3, 3), (..., 3) of camera k."""

    def to_user(self, poses: Hypotheses) -> Hypotheses:
        """Return the poses in the user's frame; translations (c, 3), or (c, 4) with the unit of the scene last."""

    def covariance_of(self, poses: Hypotheses, residual: float, inliers: int) -> Array | None:
        """Return the covariance of the parameters of the first pose; None if the points do not fix it.

        Args:
            poses: Poses in the frame of the search, best first.
            residual: Scale of the residuals, radians.
            inliers: Number of matches of the first pose.
        """


@dataclass(frozen=True, eq=False)
class OneCamera:
    """A single camera."""

    problem: Problem
    case: Case | None = None  # on which the verdict was made; what it has computed is used again
    is_rig = False

    @property
    def problems(self) -> Sequence[Problem]:
        return (self.problem,)

    @property
    def parameters(self) -> tuple[str, ...]:
        return POSE_PARAMETERS if self.problem.focal is None else (*POSE_PARAMETERS, FOCAL_LENGTH)

    def pose_of(self, k: int, rotation: Array, translation: Array) -> tuple[Array, Array]:
        return rotation, translation

    def to_user(self, poses: Hypotheses) -> Hypotheses:
        rotation, translation = self.problem.to_user(poses.rotation, poses.translation)
        return replace(poses, rotation=rotation, translation=translation)

    def covariance_of(self, poses: Hypotheses, residual: float, inliers: int) -> Array | None:
        linear = self._linearised(poses, residual)
        covariance = pose_covariance(self.problem, linear, float(poses.match_count[0]))
        if covariance is None or self.problem.measured.camera is None:
            return covariance
        unit = np.where(np.arange(len(covariance)) < len(POSE_PARAMETERS), 1.0, self.problem.measured.camera.focal)
        return np.asarray(covariance * np.outer(unit, unit))  # of the focal length instead of its logarithm

    def _linearised(self, poses: Hypotheses, residual: float) -> Linearised | None:
        """Return the best pose with its matches; those of the verdict if it was made on this pose."""
        case, pose = self.case, poses.pose()
        known = case is not None and case.problem is self.problem and case.residual == residual
        if case is not None and known and all(map(np.array_equal, case.pose, pose)):
            return case.linear
        return linearised(self.problem, *pose, residual)


class Solved(NamedTuple):
    """A solution, and the case on which its verdict was made."""

    case: Case
    solution: Solution

    def against(self, one: Objection | None) -> "Solved":
        """Return the solution with the verdict after an objection; the same one for None."""
        if one is None:
            return self
        case = self.case.against(one)
        return Solved(case, with_verdict(self.solution, decide(case)))


def assembled(
    cameras: Cameras,
    result: SearchResult,
    *,
    seconds: float = 0.0,
    inlier_threshold: float | None = None,
    deadline: Deadline = NEVER,
) -> Solution:
    """Build the `Solution` of a search by one camera or those of a rig, whose own run time is added to `seconds`.

    The largest error of an inlier is in the unit of the problem, None for three times the residual scale. After the end
    of the deadline, points get their mutual nearest neighbours, and candidates no inliers.
    """
    start, found, problems = time.perf_counter(), result.candidates, cameras.problems
    solution = _without_pose(cameras, result, inlier_threshold)
    if len(found):
        thresholds = [
            inlier_threshold or MATCH_REACH * result.residual * problem.measured.per_radian for problem in problems
        ]
        if not result.is_fitted:
            found = _with_best(found, *fit_to_matches(problems[0], *found.pose(), thresholds[0], deadline))
        matches, errors, angles, counts = _match(cameras, found, thresholds, deadline)
        candidates = candidates_of(cameras.to_user(found), counts.tolist())
        covariance = None
        if result.verdict != "failed":
            covariance = cameras.covariance_of(found, result.residual, int(counts[0]))
        solution = replace(
            solution,
            rotation=candidates[0].rotation,
            translation=candidates[0].translation,
            scale=candidates[0].scale,
            matches=matches,
            inlier_count=len(matches),
            inlier_ratio=len(matches) / sum(min(len(one.measured.plane), len(one.points3d)) for one in problems),
            inlier_threshold=thresholds[0],
            reprojection_error=float(errors.mean()) if len(matches) else math.nan,
            reprojection_error_deg=float(np.degrees(angles).mean()) if len(matches) else math.nan,
            covariance=solution.covariance if covariance is None else covariance,
            candidates=candidates,
            log10_false_alarms=candidates[0].log10_false_alarms,
            stats=replace(solution.stats, iterations=result.iterations, residual=result.residual),
        )
    solution = with_unfinished(with_verdict(solution, result), deadline)
    notes = [] if result.verdict == "confident" else _duplicates(problems)
    return replace(solution, reason="; ".join([result.reason, *notes]), seconds=seconds + time.perf_counter() - start)


def with_verdict(solution: Solution, result: SearchResult) -> Solution:
    """Return a solution with a verdict and the values that depend on it; a failed one has no covariance."""
    verdict: Verdict = result.verdict
    covariance = np.full_like(solution.covariance, math.nan) if verdict == "failed" else solution.covariance
    stats = replace(solution.stats, converged=verdict == "confident")
    stated = {"verdict": verdict, "reason": result.reason, "reason_code": result.code}
    return replace(solution, **stated, covariance=covariance, stats=stats)  # type: ignore[arg-type]


def with_unfinished(solution: Solution, deadline: Deadline) -> Solution:
    """Return a solution whose statistics name the stages that a deadline cut short, besides those that they have."""
    unfinished = tuple(sorted({*solution.stats.unfinished, *deadline.unfinished}))
    return replace(solution, stats=replace(solution.stats, unfinished=unfinished))


def candidates_of(poses: Hypotheses, counts: Sequence[int]) -> tuple[Candidate, ...]:
    """Return poses in the user's frame (`Cameras.to_user`), homogeneous for a rig, with their numbers of inliers."""
    unit = poses.translation[:, 3:] if poses.translation.shape[1] == 4 else np.ones((len(poses), 1))
    return tuple(
        Candidate(rotation, translation, score, count, alarms, scale)
        for rotation, translation, score, count, alarms, scale in zip(
            poses.rotation,
            poses.translation[:, :3] / unit,
            poses.log_likelihood.tolist(),
            counts,
            poses.log10_false_alarms.tolist(),
            (1 / unit[:, 0]).tolist(),
            strict=True,
        )
    )


def _without_pose(cameras: Cameras, result: SearchResult, inlier_threshold: float | None) -> Solution:
    """Return the solution of points for which there is no pose."""
    problems, first = cameras.problems, cameras.problems[0]
    dropped, taken = (sum(getattr(one.measured, name) for one in problems) for name in ("dropped", "taken"))
    return Solution(
        inlier_threshold=math.nan if inlier_threshold is None else inlier_threshold,
        unit=first.measured.unit,
        covariance=np.full((len(cameras.parameters),) * 2, math.nan),
        parameters=cameras.parameters,
        scale=math.nan if "scale" in cameras.parameters else 1.0,
        verdict=result.verdict,
        reason=result.reason,
        stats=SolutionStats(dropped2d=dropped, taken2d=taken),
        points2d=np.concatenate([one.measured.plane for one in problems]),
        points_per_camera=tuple(len(one.measured.plane) for one in problems) if cameras.is_rig else None,
        points3d=first.all3d,
        normals3d=first.normals3d if first.cosines3d is None else None,
        camera=None if cameras.is_rig else first.measured.camera,
    )


def _with_best(poses: Hypotheses, rotation: Array, translation: Array) -> Hypotheses:
    """Return poses with another first one."""
    rotations, translations = poses.rotation.copy(), poses.translation.copy()
    rotations[0], translations[0] = rotation, translation
    return replace(poses, rotation=rotations, translation=translations)


def _match(
    cameras: Cameras, found: Hypotheses, thresholds: Sequence[float], deadline: Deadline
) -> tuple[NDArray[np.int64], Array, Array, NDArray[np.int64]]:
    """Match the points of all cameras under the first pose, and count the inliers (c,) of each pose.

    Matches are indices (k, 2) of the user's points, those of the images over all cameras; with errors (k,) in the unit
    of the problem and angles (k,), radians.
    """
    matches, errors, angles, before = [], [], [], 0
    counts = np.zeros(len(found), np.int64)
    for k, (problem, threshold) in enumerate(zip(cameras.problems, thresholds, strict=True)):
        rotations, translations = cameras.pose_of(k, found.rotation, found.translation)
        seen, *others = map(problem.project_scene, rotations, translations)
        known = threshold, problem.may_match, deadline
        i, j = one_to_one(problem.measured.points, seen, *known).T
        counts += [len(i), *(count_one_to_one(problem.measured.points, other, *known) for other in others)]
        errors.append(np.linalg.norm(problem.measured.points[i] - seen[j], axis=-1))
        angles.append(_angles(problem.bearings[i], problem.points3d[j] @ rotations[0].T + translations[0]))
        matches.append(np.stack([problem.measured.indices[i] + before, j], -1))
        before += len(problem.measured.plane)
    return np.concatenate(matches), np.concatenate(errors), np.concatenate(angles), counts


def _angles(bearings: Array, directions: Array) -> Array:
    """Return the angles (k,) between vectors (k, 3), radians, accurate also for small angles."""
    sine = np.linalg.norm(np.cross(bearings, directions), axis=-1)
    return np.arctan2(sine, (bearings * directions).sum(-1))


def _duplicates(problems: Sequence[Problem]) -> list[str]:
    """Return sentences with the number of duplicate points of each side, for not too many points."""
    sides = {"image": [one.measured.points for one in problems], "scene": [problems[0].points3d]}
    if len(problems[0].points3d) > DENSE_MATCHES:
        return []
    counts = {side: sum(len(each) - len(np.unique(each, axis=0)) for each in points) for side, points in sides.items()}
    return [f"{count} of the {side} points are duplicates" for side, count in counts.items() if count]
