"""One pose of several cameras that are fixed to each other: proposed by each alone, refined and judged on all of them.

The image points of the cameras are independent, so the logs of their likelihood ratios add up. Three matches fix the
pose of all: the three largest terms are left out once, in that camera where they count most. The tests are those of all
cameras together, for each of them proposes poses from its own triples.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import stdtrit

from bpnp.cameras import camera_from
from bpnp.loops.parallel import Clock, Deadline
from bpnp.search.candidates import Candidates
from bpnp.search.enumeration.poses import enumerate_poses
from bpnp.search.enumeration.search import is_enumerable
from bpnp.search.enumeration.settings import DEFAULT as ENUMERATION
from bpnp.search.evidence.false_alarms import directions_of, log10_tests, log_evidence_of
from bpnp.search.evidence.repetitions import repeated_poses
from bpnp.search.evidence.uncertainty import ONE_SIGMA, Linearised, linearised, local_covariance
from bpnp.search.search import search_poses
from bpnp.search.settings import DEFAULT
from bpnp.search.verdict import SearchResult, judged, no_pose
from bpnp.solving.arguments import Array, Labels, about, checked_pose, each_camera, each_set, numbers
from bpnp.solving.matches import SCALES, one_to_one, without_pose
from bpnp.solving.problem import Problem, problem_from
from bpnp.solving.solution import Candidate, Solution, with_pose
from bpnp.solving.sources import Options

Pose = tuple[Array, Array]
PROPOSED, REFINED = 4000, 16  # poses of few points that a camera proposes, and of all cameras that are refined
WIDE = 60.0  # smallest believable scales, at which proposals are compared: a pose of one camera is off in another
STEPS, WEIGHED = 9, 7  # Gauss-Newton steps, each at a smaller scale, and the last of them that are weighed


def solve_rig(
    points2d: Any, points3d: Any, camera: Any, rig: Sequence[Any], known: Mapping[str, Any], options: Options
) -> Solution:
    """`bpnp.solve` with a `rig`: the pose rig_from_world. known: normals and labels."""
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
    for problem in problems:
        if problem.degenerate is not None:
            return without_pose(problems[0], problem.degenerate, options.inlier_threshold)
    cameras = Rig(problems, mounts)
    solution = _finished(cameras, search_rig(cameras, options), options.inlier_threshold)
    return replace(solution, seconds=Clock.now() - begun)


def _mount(name: str, value: Any) -> Pose:
    """cam_from_rig as (3, 4), (4, 4) or (R, t)."""
    if isinstance(value, tuple) and len(value) == 2:
        return checked_pose(f"{name}.", *value)
    matrix = numbers(name, value)
    if matrix.shape not in ((3, 4), (4, 4)):
        raise ValueError(f"expected `{name}` as cam_from_rig, (3, 4), (4, 4) or (R, t), got shape {matrix.shape}")
    return checked_pose(f"{name}.", matrix[:3, :3], matrix[:3, 3])


class Rig:
    """Cameras with their points, all of the same scene; `mounts`, camera_k = C_k rig + c_k."""

    def __init__(self, problems: Sequence[Problem], mounts: Sequence[Pose]) -> None:
        self.problems, self.mounts, self.sets = problems, mounts, [problem.sets for problem in problems]
        self.floor = max(each.floor or float(each.image.scales[0]) for each in self.sets)

    def pose_of(self, k: int, rotation: Array, translation: Array) -> Pose:
        """Of camera k, for poses (..., 3, 3), (..., 3) of the rig."""
        turn, shift = self.mounts[k]
        return turn @ rotation, translation @ turn.T + shift

    def rig_of(self, k: int, rotation: Array, translation: Array) -> Pose:
        """Of the rig, for those of camera k."""
        turn, shift = self.mounts[k]
        return turn.T @ rotation, (translation - shift) @ turn

    def seen(self, k: int, poses: Candidates) -> Candidates:
        """Poses of the rig as those of camera k, whose alternatives that need a derivative are asked of one camera."""
        turns, shifts = self.pose_of(k, poses.rotation, poses.translation)
        share = poses.matched / min(len(self.sets[k].bearings), len(self.sets[k].points3d))
        return replace(poses, rotation=turns, translation=shifts, matched=share)

    def linearised(self, rotation: Array, translation: Array, scale: float) -> list[tuple[Array, Linearised]]:
        """Each camera that sees a point near an image point, and the turn (6, 6) of a step of the rig into its axes."""
        found = []
        for k, sets in enumerate(self.sets):
            linear = linearised(sets, *self.pose_of(k, rotation, translation), scale)
            if linear is not None:
                found.append((np.asarray(np.kron(np.eye(2), self.mounts[k][0]), np.float64), linear))
        return found

    def refined(self, rotation: Array, translation: Array) -> Iterator[tuple[Array, Array, float, float]]:
        """The optimum beside a pose at ever smaller scales, radians, with that scale and the number of matches."""
        middle = self.sets[0].middle
        for scale in np.geomspace(WIDE, 1.0, STEPS) * self.floor:
            information, gradient, count = 1e-9 * np.eye(6), np.zeros(6), 0.0
            for turn, linear in self.linearised(rotation, translation, scale):
                rows = linear.jacobian @ turn
                information = information + np.einsum("k,kia,kib->ab", linear.probability, rows, rows)
                gradient = gradient + np.einsum("k,kia,ki->a", linear.probability, rows, linear.residual)
                count += float(linear.probability.sum()) * len(linear.sets.bearings) / len(linear.sets.image.chosen)
            if count <= 3:
                return
            step = np.linalg.solve(information, gradient)
            moved = rotation @ middle + translation + step[3:]
            rotation = Rotation.from_rotvec(step[:3]).as_matrix() @ rotation
            translation = moved - rotation @ middle
            yield rotation, translation, float(scale), count

    def alarms(self, rotation: Array, translation: Array, scale: float) -> tuple[float, float]:
        """log10 of the number of false alarms at the scale of the residuals, and at rougher ones."""
        tests = math.log10(sum(10 ** log10_tests(each) for each in self.sets))
        terms = []
        for k, sets in enumerate(self.sets):
            seen = directions_of(sets, *self.pose_of(k, rotation, translation))
            terms.append([log_evidence_of(sets, seen, scale, fixing) for fixing in (0, 3)])
        every, without = np.array(terms).transpose(1, 2, 0)  # (own and rough, cameras)
        fixing = np.where(np.isfinite(every), every, 0) - np.where(np.isfinite(without), without, 0)
        own, rough = tests - (every.sum(1) - fixing.max(1)) / math.log(10)
        return float(own), float(rough)

    def covariance(self, rotation: Array, translation: Array, scale: float) -> Array | None:
        """Covariance (6, 6) of the turn and of the shift of the middle of the scene, in the axes of the rig."""
        information = np.zeros((6, 6))
        for turn, linear in self.linearised(rotation, translation, scale):
            own = local_covariance(linear)
            if own is not None:
                information += turn.T @ np.linalg.solve(own, turn)
        return np.asarray(np.linalg.inv(information), np.float64) if np.linalg.matrix_rank(information) == 6 else None


def search_rig(rig: Rig, options: Options) -> SearchResult:
    """Distinct poses of the rig, best first, and the verdict on the first one."""
    rotations, translations, hits, sure, exhaustive = [], [], [], [], True
    deadline = Deadline.after(options.time_limit)
    for k, sets in enumerate(rig.sets):
        until = Deadline((Deadline.after(0.0).at * (len(rig.sets) - k - 1) + deadline.at) / (len(rig.sets) - k))
        if is_enumerable(sets):
            radius = ENUMERATION.radius if sets.floor is None else ENUMERATION.floors * sets.floor
            chosen = replace(ENUMERATION, kept=PROPOSED)
            poses = enumerate_poses(sets, radius=radius, deadline=until.at, is_safe=lambda _: False, settings=chosen)
            exhaustive &= poses.ended == "exhausted"
            proposed, starts = (poses.rotation, poses.translation), np.zeros(len(poses.rotation), np.int64)
        else:
            result = search_poses(sets, clutter=options.clutter, seed=options.seed, deadline=until)
            found, exhaustive = result.candidates, False
            proposed, starts = (found.rotation, found.translation), found.hits
            sure += [rig.rig_of(k, found.rotation[:1], found.translation[:1])] * (result.verdict == "confident")
        rotation, translation = rig.rig_of(k, *proposed)
        rotations.append(rotation)
        translations.append(translation)
        hits.append(starts)
    rotation, translation = np.concatenate(rotations), np.concatenate(translations)
    order = np.argsort(-_screened(rig, rotation, translation), kind="stable")[:REFINED]
    found = _candidates(rig, rotation[order], translation[order], np.concatenate(hits)[order])
    if not len(found):
        return no_pose("no pose was found")
    found, rule = found[np.argsort(found.log10_false_alarms, kind="stable")], DEFAULT.evidence
    strongest = max(range(len(rig.sets)), key=lambda k: len(rig.sets[k].bearings))
    best = rig.pose_of(strongest, found.rotation[0], found.translation[0])
    (turns, shifts), _ = repeated_poses(rig.sets[strongest], *best, float(found.scale[0]), rule)
    repeated = _candidates(rig, *rig.rig_of(strongest, turns, shifts), np.zeros(len(turns), np.int64))
    found = Candidates.concatenated([found, repeated])
    found = found[np.argsort(found.log10_false_alarms, kind="stable")]
    same = rig.sets[0].same_pose(*rig.pose_of(0, found.rotation, found.translation), rule.other_deg, rule.other_shift)
    found.hits[0] = found.hits[same].sum()  # of the cameras, which search for themselves
    for turn, shift in sure:  # nothing better than this pose was missed
        both = np.concatenate([found.rotation[:1], turn]), np.concatenate([found.translation[:1], shift])
        exhaustive |= bool(rig.sets[0].same_pose(*rig.pose_of(0, *both), rule.other_deg, rule.other_shift)[1])
    result = judged(
        rig.seen(strongest, found),
        rig.sets[strongest],
        batches=0,
        exhaustive=exhaustive,
        rule=rule,
        rig=[(rig.seen(k, found), sets) for k, sets in enumerate(rig.sets)],
    )
    turns, shifts = rig.rig_of(strongest, result.candidates.rotation, result.candidates.translation)
    return replace(result, candidates=replace(result.candidates, rotation=turns, translation=shifts))


def _screened(rig: Rig, rotations: Array, translations: Array) -> Array:
    """How well poses (p, 3, 3), (p, 3) explain the bearings of all cameras at a wide scale, nats (p,)."""
    total, scale = np.zeros(len(rotations)), WIDE * rig.floor
    if len(rotations) <= REFINED:
        return total
    for k, sets in enumerate(rig.sets):
        turns, shifts = rig.pose_of(k, rotations, translations)
        seen = sets.points3d @ turns.transpose(0, 2, 1) + shifts[:, None]
        seen /= np.maximum(np.linalg.norm(seen, axis=-1, keepdims=True), 1e-300)
        nearest = (sets.bearings @ seen.transpose(0, 2, 1)).max(-1)
        total += np.logaddexp((nearest - 1) / scale**2, -4.0).sum(-1)
    return total


def _candidates(rig: Rig, rotations: Array, translations: Array, hits: Labels) -> Candidates:
    """Poses refined on all cameras to the scale at which their false alarms are fewest, those that end together as one;
    `matched` is their expected number of matches."""
    ends = []
    for k in range(len(rotations)):
        weighed = [(*rig.alarms(*end[:3]), *end) for end in [*rig.refined(rotations[k], translations[k])][-WEIGHED:]]
        if weighed:
            ends.append((*min(weighed, key=lambda each: each[0]), int(hits[k])))
    if not ends:
        return Candidates.none()
    own, rough, turns, shifts, scales, counts, known = map(np.array, zip(*ends, strict=True))
    return replace(
        Candidates.unscored(turns, shifts),
        matched=counts, scale=scales, hits=known, score=-own, log10_false_alarms=own, log10_rough=rough,
    )  # fmt: skip


def _finished(rig: Rig, result: SearchResult, inlier_threshold: float | None) -> Solution:
    """The matches of all cameras; their 2D points count on from one camera to the next."""
    found, problems, first = result.candidates, rig.problems, rig.problems[0]
    solution = without_pose(first, result.reason, inlier_threshold)
    if not len(found):
        return solution
    rotation, translation = found.rotation[0], found.translation[0]
    matches, errors, angles, count = [], [], [], 0
    for k, problem in enumerate(problems):
        threshold = inlier_threshold or SCALES * result.residual * problem.per_radian
        seen = problem.view(*rig.pose_of(k, rotation, translation))
        i, j = one_to_one(problem.image, seen, threshold, problem.allowed).T
        errors.append(np.linalg.norm(problem.image[i] - seen[j], axis=-1))
        angles.append(errors[-1] / problem.per_radian)
        matches.append(np.stack([problem.usable[i] + count, j], -1))
        count += len(problem.points2d)
    matched = sum(map(len, matches))
    covariance = None if result.verdict == "failed" else rig.covariance(rotation, translation, result.residual)
    if covariance is not None:
        middle = rotation @ (first.sets.middle + first.origin)
        covariance = _about_origin(covariance, middle, max(2 * matched - 6, 1))
    alarms = found.log10_false_alarms.tolist()
    points2d = np.concatenate([problem.points2d for problem in problems])
    dropped = sum(problem.left_out[0] for problem in problems)
    stats = replace(solution.stats, iterations=result.batches, dropped2d=dropped)
    return with_pose(
        replace(solution, verdict=result.verdict, points2d=points2d, camera=None, stats=stats),
        [
            Candidate(r, t - r @ first.origin, -alarms[k], matched if k == 0 else 0, alarms[k])
            for k, (r, t) in enumerate(zip(found.rotation, found.translation, strict=True))
        ],
        np.concatenate(matches),
        np.concatenate(errors),
        np.concatenate(angles),
        most=sum(min(len(problem.points2d), len(problem.points3d)) for problem in problems),
        threshold=inlier_threshold or SCALES * result.residual * first.per_radian,
        residual=result.residual,
        covariance=covariance,
    )


def _about_origin(covariance: Array, middle: Array, free: int) -> Array:
    """That of a turn and the shift of the scene's origin, from that of the shift of its middle; with Student's t."""
    x, y, z = middle
    moved = np.eye(6)
    moved[3:, :3] = [[0, -z, y], [z, 0, -x], [-y, x, 0]]
    return np.asarray(float(stdtrit(free, ONE_SIGMA)) ** 2 * moved @ covariance @ moved.T)
