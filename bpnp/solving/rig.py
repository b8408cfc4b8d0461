"""One pose of several cameras that are fixed to each other: proposed by each alone, refined and judged on all of them.

The image points of the cameras are independent, so the logs of their likelihood ratios add up. Three matches fix the
pose of all: the three largest terms are left out once, in that camera where they count most. The tests are those of all
cameras together, for each of them proposes poses from its own triples.

Image points do not tell the unit of the scene, but cameras that are apart tell it in units of the rig. Translations of
the rig are homogeneous, (t, u) in units of the scene with u of them in a unit of the rig, so that camera k has the
translation [C_k | c_k] (t, u). Where u is not known, two cameras propose it together, and one more match is left out
and counted in the tests, in another camera than the three.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import combinations
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import stdtrit

from bpnp.cameras import camera_from
from bpnp.distinct_poses import distinct
from bpnp.loops.parallel import Clock, Deadline
from bpnp.search.candidates import Candidates
from bpnp.search.enumeration.poses import enumerate_poses
from bpnp.search.enumeration.search import is_enumerable
from bpnp.search.enumeration.settings import DEFAULT as ENUMERATION
from bpnp.search.evidence.false_alarms import directions_of, log10_tests, log_evidence_of
from bpnp.search.evidence.repetitions import repeated_poses
from bpnp.search.evidence.uncertainty import ONE_SIGMA, Linearised, linearised, local_covariance, share_bound
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
AGREE_DEG, AGREE, PAIRS = 6.0, 0.2, 50_000  # of poses of two cameras that tell a scale: turn, shift in distances, most
LEAST_APART = 0.01  # of two cameras, in distances of the scene: a scale with which they are nearer cannot be told
SAME_CENTRE = 1e-6  # of the farthest centre from the origin of the rig


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
    """`bpnp.solve` with a `rig`: the pose rig_from_world. known: normals and labels. scale: whether the scene's unit is
    unknown."""
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
    result = no_pose(reasons[0]) if reasons else search_rig(cameras, options)
    solution = _finished(cameras, result, options.inlier_threshold)
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
    """Cameras with their points, all of the same scene; `mounts`, camera_k = C_k rig + c_k. Its translations are
    homogeneous; is_metric: whether their last number is 1, else it is looked for."""

    def __init__(self, problems: Sequence[Problem], mounts: Sequence[Pose], *, is_metric: bool = True) -> None:
        self.problems, self.mounts, self.sets = problems, mounts, [problem.sets for problem in problems]
        self.floor = max(each.floor or float(each.image.scales[0]) for each in self.sets)
        self.unknowns = 6 if is_metric else 7
        centres = np.array([-turn.T @ shift for turn, shift in mounts])
        least = SAME_CENTRE * np.abs(centres).max()
        pairs = combinations(range(len(mounts)), 2)
        self.apart = [(k, other) for k, other in pairs if np.linalg.norm(centres[k] - centres[other]) > least]

    def pose_of(self, k: int, rotation: Array, translation: Array) -> Pose:
        """Of camera k, for poses (..., 3, 3), (..., 4) of the rig."""
        turn, shift = self.mounts[k]
        return turn @ rotation, translation[..., :3] @ turn.T + translation[..., 3:] * shift

    def rig_of(self, k: int, rotation: Array, translation: Array, unit: Array | float = 1.0) -> Pose:
        """Of the rig, for those of camera k, whose scene has this many of its units in one of the rig."""
        turn, shift = self.mounts[k]
        units = np.broadcast_to(unit, (*translation.shape[:-1], 1))
        return turn.T @ rotation, np.concatenate([(translation - units * shift) @ turn, units], -1)

    def seen(self, k: int, poses: Candidates) -> Candidates:
        """Poses of the rig as those of camera k, whose alternatives that need a derivative are asked of one camera."""
        turns, shifts = self.pose_of(k, poses.rotation, poses.translation)
        share = poses.matched / min(len(self.sets[k].bearings), len(self.sets[k].points3d))
        return replace(poses, rotation=turns, translation=shifts, matched=share)

    def linearised(self, rotation: Array, translation: Array, scale: float) -> list[tuple[Array, Linearised]]:
        """Each camera that sees a point near an image point, and the matrix (6, unknowns) that makes a step of the rig
        one of it; the seventh number is the logarithm of the scale."""
        found = []
        for k, sets in enumerate(self.sets):
            linear = linearised(sets, *self.pose_of(k, rotation, translation), scale)
            if linear is not None:
                turn, shift = self.mounts[k]
                by_scale = np.r_[np.zeros(3), -translation[3] * shift]
                step = np.column_stack([np.kron(np.eye(2), turn), by_scale])[:, : self.unknowns]
                found.append((np.asarray(step, np.float64), linear))
        return found

    def refined(self, rotation: Array, translation: Array) -> Iterator[tuple[Array, Array, float, float]]:
        """The optimum beside a pose at ever smaller scales, radians, with that scale and the number of matches."""
        middle = self.sets[0].middle
        for scale in np.geomspace(WIDE, 1.0, STEPS) * self.floor:
            information, gradient, count = 1e-9 * np.eye(self.unknowns), np.zeros(self.unknowns), 0.0
            for turn, linear in self.linearised(rotation, translation, scale):
                rows = linear.jacobian @ turn
                information = information + np.einsum("k,kia,kib->ab", linear.probability, rows, rows)
                gradient = gradient + np.einsum("k,kia,ki->a", linear.probability, rows, linear.residual)
                count += float(linear.probability.sum()) * len(linear.sets.bearings) / len(linear.sets.image.chosen)
            if count <= self.unknowns - 3:
                return
            step = np.linalg.solve(information, gradient)
            moved = rotation @ middle + translation[:3] + step[3:6]
            rotation = Rotation.from_rotvec(step[:3]).as_matrix() @ rotation
            unit = translation[3:] * np.exp(-np.clip(step[6:], -1, 1).sum())
            translation = np.r_[moved - rotation @ middle, unit]
            yield rotation, translation, float(scale), count

    def alarms(self, rotation: Array, translation: Array, scale: float) -> tuple[float, float]:
        """log10 of the number of false alarms at the scale of the residuals, and at rougher ones."""
        tests = math.log10(sum(10 ** log10_tests(each) for each in self.sets))
        if self.unknowns == 7:
            tests += math.log10(sum(len(each.bearings) * len(each.points3d) for each in self.sets))
        terms = []
        for k, sets in enumerate(self.sets):
            seen = directions_of(sets, *self.pose_of(k, rotation, translation))
            terms.append([log_evidence_of(sets, seen, scale, fixing) for fixing in (0, 3, 1)])
        every, *without = np.array(terms).transpose(1, 2, 0)  # (own and rough, cameras) each
        three, one = (np.where(np.isfinite(every), every, 0) - np.where(np.isfinite(x), x, 0) for x in without)
        fixing = three.max(1)
        if self.unknowns == 7:  # three matches in one camera, one in another that is apart from it
            either = [*self.apart, *(pair[::-1] for pair in self.apart)]
            fixing = np.max([three[:, k] + one[:, other] for k, other in either], 0)
        own, rough = tests - (every.sum(1) - fixing) / math.log(10)
        return float(own), float(rough)

    def covariance(self, rotation: Array, translation: Array, scale: float) -> Array | None:
        """Covariance of the turn, of the shift of the middle of the scene, in the axes of the rig, and of the logarithm
        of the scale if that is unknown."""
        information = np.zeros((self.unknowns, self.unknowns))
        for turn, linear in self.linearised(rotation, translation, scale):
            own = local_covariance(linear)
            if own is not None:
                information += turn.T @ np.linalg.solve(own, turn)
        is_fixed = np.linalg.matrix_rank(information) == self.unknowns
        return np.asarray(np.linalg.inv(information), np.float64) if is_fixed else None


def search_rig(rig: Rig, options: Options) -> SearchResult:
    """Distinct poses of the rig, best first, and the verdict on the first one."""
    proposed: list[tuple[Array, Array, Labels]] = []
    sure, exhaustive = list[tuple[int, Array, Array]](), True
    deadline, rule = Deadline.after(options.time_limit), DEFAULT.evidence
    for k, sets in enumerate(rig.sets):
        until = Deadline((Deadline.after(0.0).at * (len(rig.sets) - k - 1) + deadline.at) / (len(rig.sets) - k))
        if is_enumerable(sets):
            radius = ENUMERATION.radius if sets.floor is None else ENUMERATION.floors * sets.floor
            chosen = replace(ENUMERATION, kept=PROPOSED)
            poses = enumerate_poses(sets, radius=radius, deadline=until.at, is_safe=lambda _: False, settings=chosen)
            exhaustive &= poses.ended == "exhausted"
            proposed.append((poses.rotation, poses.translation, np.zeros(len(poses.rotation), np.int64)))
        else:
            result = search_poses(sets, clutter=options.clutter, seed=options.seed, deadline=until)
            found, exhaustive = result.candidates, False
            proposed.append((found.rotation, found.translation, found.hits))
            sure += [(k, found.rotation[:1], found.translation[:1])] * (result.verdict == "confident")
    rotation, translation, hits = _proposals(rig, proposed)
    order = _screened(rig, rotation, translation)
    found = _candidates(rig, rotation[order], translation[order], hits[order])
    if not len(found):
        return no_pose("no pose was found")
    found = found[np.argsort(found.log10_false_alarms, kind="stable")]
    strongest = max(range(len(rig.sets)), key=lambda k: len(rig.sets[k].bearings))
    best = rig.pose_of(strongest, found.rotation[0], found.translation[0])
    (turns, shifts), _ = repeated_poses(rig.sets[strongest], *best, float(found.scale[0]), rule)
    repeated = rig.rig_of(strongest, turns, shifts, found.translation[0, 3])
    found = Candidates.concatenated([found, _candidates(rig, *repeated, np.zeros(len(turns), np.int64))])
    found = found[np.argsort(found.log10_false_alarms, kind="stable")]
    same = rig.sets[0].same_pose(*rig.pose_of(0, found.rotation, found.translation), rule.other_deg, rule.other_shift)
    found.hits[0] = found.hits[same].sum()  # of the cameras, which search for themselves
    agree = 0
    for k, turn, shift in sure:  # nothing better than this pose was missed
        one, other = rig.pose_of(k, found.rotation[:1], found.translation[:1])
        both = np.concatenate([one, turn]), np.concatenate([other, shift])
        agree += bool(rig.sets[k].same_pose(*both, rule.other_deg, rule.other_shift)[1])
    result = judged(
        rig.seen(strongest, found),
        rig.sets[strongest],
        batches=0,
        exhaustive=exhaustive or agree > rig.unknowns - 6,  # two of them tell a scale
        rule=rule,
        rig=[(rig.seen(k, found), sets) for k, sets in enumerate(rig.sets)],
    )
    if result.verdict == "confident" and rig.unknowns == 7 and _scale_bound(rig, found) > rule.focal:
        reason = f"the scale of the scene cannot be told: it may be more than {100 * rule.focal:.0f} % off"
        result = replace(result, verdict="ambiguous", reason=reason)
    return replace(
        result, candidates=replace(result.candidates, rotation=found.rotation, translation=found.translation)
    )


def _scale_bound(rig: Rig, found: Candidates) -> float:
    """Share by which the scale of the first pose may be wrong, exceeded once in a thousand."""
    covariance = rig.covariance(found.rotation[0], found.translation[0], float(found.scale[0]))
    return math.inf if covariance is None else share_bound(covariance[6:, 6:], 2 * float(found.matched[0]) - 7)


def _proposals(rig: Rig, proposed: Sequence[tuple[Array, Array, Labels]]) -> tuple[Array, Array, Labels]:
    """Poses of the rig and their hits: those of each camera; or, of an unknown scale, those in which two cameras that
    are apart agree, the middle of the scene where it is with least squares."""
    if rig.unknowns == 6:
        parts = [(*rig.rig_of(k, turns, shifts), hits) for k, (turns, shifts, hits) in enumerate(proposed)]
    else:
        parts = [_told_by(rig, pair, proposed[pair[0]], proposed[pair[1]]) for pair in rig.apart]
    rotation, translation, hits = map(np.concatenate, zip(*parts, strict=True))
    return rotation, translation, hits


def _told_by(
    rig: Rig, pair: tuple[int, int], first: tuple[Array, Array, Labels], second: tuple[Array, Array, Labels]
) -> tuple[Array, Array, Labels]:
    """Poses of the rig in which two cameras agree, and the fewer of their hits."""
    (turn, shift), (other, moved) = (rig.mounts[k] for k in pair)
    middle = rig.sets[0].middle
    turns, others = (turn.T @ first[0]).reshape(-1, 9), (other.T @ second[0]).reshape(-1, 9)
    traces = turns.astype(np.float32) @ others.T.astype(np.float32)
    near = np.flatnonzero(traces.ravel() > 1 + 2 * math.cos(math.radians(AGREE_DEG)))
    i, j = np.divmod(near[np.argsort(-traces.ravel()[near], kind="stable")[:PAIRS]], max(len(others), 1))
    rotation = turn.T @ first[0][i]
    seen = (first[0][i] @ middle + first[1][i]) @ turn  # from the first camera, in the axes of the rig
    way, apart = seen - (second[0][j] @ middle + second[1][j]) @ other, shift @ turn - moved @ other
    distance, length = np.linalg.norm(seen, axis=-1), float(np.linalg.norm(apart))
    unit = np.maximum(way @ apart / length, LEAST_APART * distance)[:, None] / length
    translation = np.concatenate(
        [seen - unit * (shift @ turn) - (way - unit * apart) / 2 - rotation @ middle, unit], -1
    )
    agree = np.linalg.norm(way - unit * apart, axis=-1) < AGREE * distance
    return rotation[agree], translation[agree], np.minimum(first[2][i], second[2][j])[agree]


def _screened(rig: Rig, rotations: Array, translations: Array) -> Labels:
    """The places of the poses (p, 3, 3), (p, 4) that explain the bearings of all cameras best at a wide scale, and, of
    an unknown scale, for which cameras proposed in pairs, are not the same."""
    total, scale = np.zeros(len(rotations)), WIDE * rig.floor
    if len(rotations) <= REFINED:
        return np.arange(len(rotations))
    for k, sets in enumerate(rig.sets):
        turns, shifts = rig.pose_of(k, rotations, translations)
        seen = sets.points3d @ turns.transpose(0, 2, 1) + shifts[:, None]
        seen /= np.maximum(np.linalg.norm(seen, axis=-1, keepdims=True), 1e-300)
        nearest = (sets.bearings @ seen.transpose(0, 2, 1)).max(-1)
        total += np.logaddexp((nearest - 1) / scale**2, -4.0).sum(-1)
    if rig.unknowns == 6:
        return np.argsort(-total, kind="stable")[:REFINED]
    rule, places = DEFAULT.evidence, []
    for k, sets in enumerate(rig.sets):
        turns, shifts = rig.pose_of(k, rotations, translations)
        middle = turns @ sets.middle + shifts
        places.append(middle / np.linalg.norm(middle, axis=-1, keepdims=True))
    return distinct(rotations, np.concatenate(places, -1), total, REFINED, rule.other_deg, rule.other_shift)


def _candidates(rig: Rig, rotations: Array, translations: Array, hits: Labels) -> Candidates:
    """Poses refined on all cameras to the scale at which their false alarms are fewest, those that end together as one;
    `matched` is their expected number of matches."""
    ends = []
    for k in range(len(rotations)):
        weighed = [(*rig.alarms(*end[:3]), *end) for end in [*rig.refined(rotations[k], translations[k])][-WEIGHED:]]
        if weighed:
            ends.append((*min(weighed, key=lambda each: each[0]), int(hits[k])))
    if not ends:
        return Candidates.unscored(rotations[:0], translations[:0])
    own, rough, turns, shifts, scales, counts, known = map(np.array, zip(*ends, strict=True))
    return replace(
        Candidates.unscored(turns, shifts),
        matched=counts, scale=scales, hits=known, score=-own, log10_false_alarms=own, log10_rough=rough,
    )  # fmt: skip


def _finished(rig: Rig, result: SearchResult, inlier_threshold: float | None) -> Solution:
    """The matches of all cameras; their 2D points count on from one camera to the next."""
    found, problems, first = result.candidates, rig.problems, rig.problems[0]
    solution = replace(without_pose(first, result.reason, inlier_threshold), camera=None)
    if rig.unknowns == 7:
        solution = replace(solution, scale=math.nan, covariance=np.full((7, 7), math.nan))
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
        shift = translation[:3] - rotation @ first.origin
        covariance = _about_origin(covariance, middle, shift, 1 / translation[3], max(2 * matched - rig.unknowns, 1))
    alarms = found.log10_false_alarms.tolist()
    points2d = np.concatenate([problem.points2d for problem in problems])
    dropped = sum(problem.left_out[0] for problem in problems)
    stats = replace(solution.stats, iterations=result.batches, dropped2d=dropped)
    return with_pose(
        replace(solution, verdict=result.verdict, points2d=points2d, stats=stats),
        [
            Candidate(
                r, (t[:3] - r @ first.origin) / t[3], -alarms[k], matched if k == 0 else 0, alarms[k], float(1 / t[3])
            )
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


def _about_origin(covariance: Array, middle: Array, shift: Array, scale: float, free: int) -> Array:
    """That of a turn, the translation in units of the rig, and the scale if it is unknown, from that of the shift of
    the middle of the scene in its units and of the logarithm of the scale; with Student's t."""
    x, y, z = middle
    moved = np.eye(7)
    moved[3:, 3:] *= scale
    moved[3:6, :3] = scale * np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    moved[3:6, 6] = scale * shift
    moved = moved[: len(covariance), : len(covariance)]
    return np.asarray(float(stdtrit(free, ONE_SIGMA)) ** 2 * moved @ covariance @ moved.T)
