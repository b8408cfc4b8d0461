"""Search for the pose of a rig: proposed by each camera alone, refined and judged on all cameras.

A camera with few points enumerates poses. Cameras with many points search in rounds, one iteration each. Their
iterations are those of a single camera, except that density-map searches use the points of all cameras. The poses of an
iteration with the most evidence in all cameras are refined. The search ends when the best pose is confident. Until a
pose is significant, each round ends with a density-map search around the pose with the most evidence.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from bpnp.arrays import Array, PoseArrays
from bpnp.poses import SAME, distinct, polar_coordinates
from bpnp.runtime import NEVER, Clock, Deadline, one_blas_thread
from bpnp.search.few_points.enumeration import enumerate_poses, exceeds_enumeration, is_enumerable
from bpnp.search.few_points.points import predicted_pose
from bpnp.search.find import lacks_partners
from bpnp.search.hypotheses import Hypotheses, to_problem_frame, to_scene_frame
from bpnp.search.loop import Progress, Step, run, teller
from bpnp.search.pool import Pool
from bpnp.search.problem import Problem
from bpnp.search.propose.density_map import LOCAL, search_around
from bpnp.search.propose.known_matches import known_matches, poses_of_matches
from bpnp.search.propose.repetitions import repeated_poses
from bpnp.search.rig.cameras import WIDE_SCALES, Rig
from bpnp.search.schedule import SURROUNDED_APART_DEG, Plan
from bpnp.search.search_frame import SearchFrame
from bpnp.search.settings import DEFAULT, SearchSettings
from bpnp.search.verdict.competitors import distance_between
from bpnp.search.verdict.completeness import Symmetry
from bpnp.search.verdict.contest import Rival, contest
from bpnp.search.verdict.decide import FOCAL_BOUND, FOCAL_BOUND_OF_OBJECT, Case, fits_by_chance, is_object
from bpnp.search.verdict.false_alarms import alarms_of
from bpnp.search.verdict.limits import LEAST_MARGIN, MOST_FALSE_ALARMS, MOST_MISSED
from bpnp.search.verdict.reasons import Objection, Unfinished, focal_length_not_fixed, objection
from bpnp.search.verdict.rivals.given import given
from bpnp.search.verdict.rivals.lens import fitted_lens
from bpnp.search.verdict.uncertainty import linearised, share_bound, systematic_misfit

BEFORE = 1e9  # score of the poses that were refined before: above the evidence of any pose [nats; derived]
PROPOSED_POSES = 4000  # number of poses that a camera with few points proposes [poses; cost]
REFINED_RIG_POSES = 16  # number of enumerated poses that are refined, and of distinct poses that are kept [poses; cost]
REFINED_EACH_ITERATION = 2  # number of poses of an iteration that are refined [poses; cost]
COMPARED_POSES = 64  # largest number of proposals whose evidence is computed [poses; cost]
AGREE_DEG = 6.0  # angle between the poses of two cameras below which they agree [degrees; not tuned]
AGREE_SHIFT = 0.2  # distance below which they agree, in distances of the scene [fraction; not tuned]
COMPARED_PAIRS = 50_000  # largest number of pairs of poses that are compared [pairs; cost]
LEAST_BASELINE = 0.01  # least baseline that determines the scale, in distances of the scene [fraction; not tuned]
SCALE_BOUND = 0.2  # largest 99.9 % bound of the scale of a rig's scene, as a fraction [fraction; convention]


@one_blas_thread
def search_rig(
    rig: Rig,
    *,
    clutter: float | None = None,
    seed: int = 0,
    deadline: Deadline = NEVER,
    settings: SearchSettings = DEFAULT,
    progress: Progress | None = None,
) -> Case:
    """Search for the pose of a rig.

    `progress` is called after the cameras with few points (0) and after each iteration; `clutter` is the expected
    outlier fraction, None if it is unknown.
    """
    settings = settings if clutter is None else settings.expecting(clutter)
    poses, tell = RigPoses(rig, deadline), teller(progress)
    for k, problem in enumerate(rig.problems):
        if exceeds_enumeration(problem):
            scene = SearchFrame(problem, seed + k, settings, deadline)
            if not lacks_partners(scene):
                poses.pools[k] = Pool(scene, problem, Case.without_pose(problem))
    rig.join({k: pool.scene for k, pool in poses.pools.items()})
    if (predicted := predicted_pose(rig.model.prior)) is not None:
        poses.add_refined(rig.candidates(predicted[0][None], np.r_[predicted[1], 1.0][None]))
    poses.take(_of_few_points(poses, rig.problems, seed, deadline), REFINED_RIG_POSES)
    if rig.model.prior is not None and not poses.is_significant():
        without = [replace(problem, prior=None) for problem in rig.problems]
        poses.take(_of_few_points(poses, without, seed, deadline), REFINED_RIG_POSES)
    tell(0)
    if poses.may_be_decided() and (case := contest(poses.case(ended=False), poses.rivals)).objection is None:
        return case
    return run(RigPlan(poses), poses, most=settings.iterations, deadline=deadline, tell=tell)


def _of_few_points(
    poses: "RigPoses", problems: Sequence[Problem], seed: int, deadline: Deadline
) -> dict[int, Hypotheses]:
    """Return the poses of the cameras with known matches or few points, by index of the camera."""
    few = dict[int, Hypotheses]()
    for k, problem in enumerate(problems):
        matches = known_matches(problem)
        if matches is not None:
            few[k] = poses_of_matches(problem, *matches, seed + k)
        elif is_enumerable(problem):
            until = (Clock.now() * (len(problems) - k - 1) + deadline.at) / (len(problems) - k)
            found = enumerate_poses(problem, deadline=until, to_the_end=True, kept=PROPOSED_POSES)
            few[k] = Hypotheses.from_poses(found.poses.rotation, found.poses.translation)
            poses.exhaustive &= found.ended == "exhausted"
        else:
            poses.exhaustive = False
    return few


class RigPlan:
    """Steps of the cameras of a rig that search, one of each in turn; a local search for all of them ends a round."""

    def __init__(self, poses: "RigPoses") -> None:
        self._poses, self._plans = poses, {k: Plan.of(pool) for k, pool in poses.pools.items()}
        self._waiting = list(self._plans)

    def next_step(self) -> Step | None:
        """Return the next step of a camera, or the local search at the end of a round; None if no camera searches."""
        while self._plans:
            if not self._waiting:
                self._waiting = list(self._plans)
                if (local := self._poses.next_local_search()) is not None:
                    return local
            k = self._waiting.pop(0)
            if (step := self._plans[k].next_step()) is not None:
                return step._replace(camera=k)
            del self._plans[k]
        return None


class RigPoses:
    """Proposals of the cameras of a rig, and the best of them refined on all cameras."""

    def __init__(self, rig: Rig, deadline: Deadline = NEVER) -> None:
        self.deadline = deadline
        self.rig, self.exhaustive = rig, True
        self.found = [Hypotheses.empty() for _ in rig.problems]  # all poses of each camera, in the frame of its problem
        self.starts = Hypotheses.empty(4)  # initial poses of the rig that were refined, with their evidence
        # best: distinct refined poses, best first.
        # searched: initial poses that had a local search.
        # pools: pool of each camera that searches, by index.
        self.best, self.searched, self.pools = self.starts, self.starts, dict[int, Pool]()
        self._symmetries = [Symmetry(problem) for problem in rig.problems]

    @property
    def iterations(self) -> int:
        """Number of iterations of all cameras."""
        return sum(pool.iterations for pool in self.pools.values())

    def add(self, step: Step, found: Hypotheses) -> None:
        """Add the poses of one camera, in the frame of its scene."""
        if step.counts:
            self.pools[step.camera].add(step, found)
        self.take({step.camera: to_problem_frame(found, self.pools[step.camera].scene)}, REFINED_EACH_ITERATION)

    def take(self, new: Mapping[int, Hypotheses], most: int) -> None:
        """Refine those proposals of the cameras that have the most evidence in all cameras.

        At most `most` poses are refined. The new ones are in the frame of the problem of each camera, by index.
        """
        rotation, translation = _proposals(self.rig, new, self.found)
        for k, poses in new.items():
            self.found[k] = Hypotheses.concatenate([self.found[k], poses])
        if len(rotation) > COMPARED_POSES:
            best = np.argsort(-_agreement(self.rig, rotation, translation), kind="stable")[:COMPARED_POSES]
            rotation, translation = rotation[best], translation[best]
        score = np.array([self.rig.evidence(*pose).sum() for pose in zip(rotation, translation, strict=True)])
        poses, earlier = Hypotheses.from_poses(rotation, translation, log_likelihood=score), len(self.starts)
        every = Hypotheses.concatenate([self.starts, poses])
        order = self._distinct(every, np.r_[np.full(earlier, BEFORE), score], earlier + most)[earlier:]
        self.starts = every[np.r_[:earlier, order]]
        self.add_refined(self.rig.candidates(every.rotation[order], every.translation[order], self.deadline))

    def next_local_search(self) -> Step | None:
        """Return a local search around the best unused initial pose; None if a pose is significant."""
        if not self.pools or not len(self.starts) or self.best.log10_false_alarms[:1].min(initial=math.inf) < 0:
            return None
        poses = Hypotheses.concatenate([self.searched, self.starts])
        score = np.r_[np.full(len(self.searched), BEFORE), self.starts.log_likelihood]
        apart = SURROUNDED_APART_DEG
        order = distinct(poses.rotation, poses.translation, score, len(self.searched) + 1, apart, math.inf)
        new = poses[order[len(self.searched) :]]
        self.searched = Hypotheses.concatenate([self.searched, new])
        if not len(new):
            return None
        k = max(self.pools, key=lambda k: len(self.rig.problems[k].bearings))
        turn, shift = self.rig.pose_of(k, new.rotation, new.translation)
        scene = self.pools[k].scene
        pose = to_scene_frame(Hypotheses.from_poses(turn, shift), scene)
        return Step(partial(search_around, scene, pose, LOCAL), camera=k, counts=False)

    def add_refined(self, refined: Hypotheses) -> None:
        """Add refined poses; the basin count of the best one is the sum over all cameras."""
        every = Hypotheses.concatenate([self.best, refined])
        self.best = every[self._distinct(every, -every.log10_false_alarms, REFINED_RIG_POSES)]
        if len(self.best):
            self.best.basin_count[0] = sum(
                int(poses.basin_count[self._as_best(k, poses)].sum()) for k, poses in enumerate(self.found)
            )

    def _distinct(self, poses: Hypotheses, score: Array, count: int) -> NDArray[np.int64]:
        """Return the indices of the best poses that are pairwise different in at least one camera."""
        seen = []
        for k, problem in enumerate(self.rig.problems):
            rotations_of_camera, shifts = self.rig.pose_of(k, poses.rotation, poses.translation)
            seen.append(rotations_of_camera @ problem.centre3d + shifts)
        return distinct(poses.rotation, polar_coordinates(np.stack(seen, 1)), score, count, *SAME)

    def _local_searches(self) -> int:
        """Return the number of local searches around the best pose that found no better one."""
        return sum(
            int(self._as_best(k, to_problem_frame(pool.locally_best, pool.scene)).sum())
            for k, pool in self.pools.items()
        )

    def _as_best(self, k: int, poses: Hypotheses) -> NDArray[np.bool_]:
        """Return which poses of camera k are the same as the best pose."""
        best, tolerance = self.rig.pose_of(k, *self.best.pose()), SAME
        return self.rig.problems[k].same_as(best, poses.rotation, poses.translation, tolerance)

    def is_significant(self) -> bool:
        """Return whether the number of false alarms of the best pose is small enough."""
        return bool((self.best.log10_false_alarms[:1] <= MOST_FALSE_ALARMS).any())

    def may_be_decided(self) -> bool:
        """Return whether the best pose is significant and its miss probability is low enough."""
        if not self.is_significant():
            return False
        return self._case().missed <= MOST_MISSED

    def _strongest(self) -> tuple[int, Hypotheses]:
        """Return the index of the camera with the most evidence for the best pose, and the poses in that camera."""
        k = int(self.rig.evidence(self.best.rotation[0], self.best.translation[0], float(self.best.scale[0])).argmax())
        return k, self.rig.seen(k, self.best)

    @property
    def rivals(self) -> Sequence[Rival]:
        """What to ask about the best pose, in order."""
        return self._copies, self._extrinsics, self._lens, self._unknowns, given

    def case(self, *, ended: bool = True) -> Case:
        """Return what is known of the best pose, as seen by the camera with the most evidence for it."""
        return self._case() if len(self.best) else Case.without_pose(self.rig.problems[0])

    def _case(self) -> Case:
        strongest, seen = self._strongest()
        cameras = [(self.rig.seen(k, self.best), problem) for k, problem in enumerate(self.rig.problems)]
        return Case.of(
            seen,
            self.rig.problems[strongest],
            local_searches=self._local_searches(),
            exhaustive=self.exhaustive,
            iterations=self.iterations,
            is_fitted=True,
            cameras=cameras,
            distinct=self._distinct_fraction(),
            of_rig=self.best,
            motions=self._symmetries[strongest],
        )

    def _copies(self, case: Case) -> Case:
        """Return the case after the competing poses of a repeated structure were refined on all cameras."""
        if self.deadline.ended(Unfinished.competing_poses):
            return case.against(objection("untested"))
        strongest, seen = self._strongest()
        problem, pose_and_scale = self.rig.problems[strongest], (*seen.pose(), float(seen.scale[0]))
        repeated, sizes, _ = repeated_poses(problem, *pose_and_scale, deadline=self.deadline)
        unit = self.best.translation[0, 3]
        if self.rig.model.scale:  # a copy of another size looks the same if the rig is larger as well
            unit = unit * sizes[:, None]
        copies = self.rig.rig_of(strongest, repeated.rotation, repeated.translation, unit)
        end = replace(self.deadline, at=self.deadline.final)
        self.add_refined(self.rig.candidates(*copies, end, Unfinished.competing_poses))
        late = Unfinished.competing_poses in self.deadline.unfinished
        return self._case().against(objection("untested") if late else None)

    def _extrinsics(self, case: Case) -> Case:
        return case.against(self._other_extrinsics())

    def _lens(self, case: Case) -> Case:
        """Return the case against another focal length that the residuals in one camera support."""
        if self.rig.model.lens is not None:
            return case
        linear = linearised(case.problem, *case.pose, case.residual)
        return case.against(fitted_lens(linear, systematic_misfit(linear, case.match_count)))

    def _unknowns(self, case: Case) -> Case:
        """Return the case against a focal length or a scale that the points do not fix."""
        most: dict[str, float] = {}
        if self.rig.model.lens:
            most["focal"] = FOCAL_BOUND_OF_OBJECT if is_object(self.rig.problems[0]) else FOCAL_BOUND
        if self.rig.model.scale:
            most["scale"] = SCALE_BOUND
        if not most:
            return case
        best = self.best.rotation[0], self.best.translation[0], float(self.best.scale[0])
        covariance, free = self.rig.covariance(*best), 2 * float(self.best.match_count[0]) - self.rig.unknowns
        bounds = [
            math.inf if covariance is None else share_bound(covariance[k : k + 1, k : k + 1], free)
            for k in range(6, 6 + len(most))
        ]
        for (name, limit), bound in reversed([*zip(most.items(), bounds, strict=True)]):
            if bound > limit:
                scale = objection("scale_not_fixed", percent=100 * limit)
                return case.against(scale if name == "scale" else focal_length_not_fixed(bound))
        return case

    def _other_extrinsics(self) -> Objection | None:
        """Return an objection if one camera contradicts the best pose, else None.

        The best pose fits the points of this camera no better than chance (NFA at least 1). A pose that the camera
        proposed is significant, and its log10 NFA lower by the margin of a competing pose, at the same scale of the
        residuals. Wrong extrinsics are the likely cause.
        """
        for k, found in enumerate(self.found):
            seen = self.rig.seen(k, self.best[:1])
            here = float(self._alarms_alone(k, seen)[0])
            if not fits_by_chance(here) or not len(found):
                continue
            own = self._alarms_alone(k, found[:REFINED_RIG_POSES])  # those of an enumeration begin with the likeliest
            if own.min() <= min(MOST_FALSE_ALARMS, here - LEAST_MARGIN):
                away = distance_between(self.rig.problems[k], seen.pose(), found.pose(int(own.argmin())))
                return objection("other_extrinsics", camera=k, away=away)
        return None

    def _alarms_alone(self, k: int, poses: Hypotheses) -> Array:
        """Return log10 NFA (c,) of poses of camera k, in this camera alone, at the residual scale of the best pose."""
        problem = replace(self.rig.problems[k], prior=None)
        return alarms_of(problem, poses.rotation, poses.translation, np.repeat(self.best.scale[:1], len(poses))).own

    def _distinct_fraction(self) -> float:
        """Return the number of matched scene points of the best pose over that of its matches."""
        return self.rig.distinct_fraction(self.best.rotation[0], self.best.translation[0], float(self.best.scale[0]))


def _proposals(rig: Rig, new: Mapping[int, Hypotheses], found: Sequence[Hypotheses]) -> PoseArrays:
    """Return the poses of the rig that new poses of the cameras give.

    If the scale is unknown, they are those in which two cameras with a non-zero baseline agree. The poses of the second
    camera include those it had `found` before.
    """
    if not rig.model.scale:
        parts = [rig.rig_of(k, poses.rotation, poses.translation) for k, poses in new.items()]
    else:
        pairs = [(k, other, poses) for k, poses in new.items() for other in range(len(found))]
        parts = []
        for k, other, poses in pairs:
            others = [found[other], *([new[other]] if other in new and other > k else [])]
            if (min(k, other), max(k, other)) in rig.apart:
                parts.append(_agreeing_poses(rig, (k, other), poses, Hypotheses.concatenate(others)))
    if not parts:
        return np.empty((0, 3, 3)), np.empty((0, 4))
    rotation, translation = map(np.concatenate, zip(*parts, strict=True))
    return rotation, translation


def _agreeing_poses(rig: Rig, pair: tuple[int, int], first: Hypotheses, second: Hypotheses) -> PoseArrays:
    """Return the poses of the rig in which two cameras agree; the scene centroid is at its least-squares position."""
    (turn, shift), (other, moved) = (rig.mounts[k] for k in pair)
    centre = rig.problems[0].centre3d
    first_rotations, others = (turn.T @ first.rotation).reshape(-1, 9), (other.T @ second.rotation).reshape(-1, 9)
    traces = first_rotations.astype(np.float32) @ others.T.astype(np.float32)
    near = np.flatnonzero(traces.ravel() > 1 + 2 * math.cos(math.radians(AGREE_DEG)))
    i, j = np.divmod(near[np.argsort(-traces.ravel()[near], kind="stable")[:COMPARED_PAIRS]], max(len(others), 1))
    rotation = turn.T @ first.rotation[i]
    seen = (first.rotation[i] @ centre + first.translation[i]) @ turn  # from the first camera, in the rig's axes
    way = seen - (second.rotation[j] @ centre + second.translation[j]) @ other
    apart = shift @ turn - moved @ other
    distance, length = np.linalg.norm(seen, axis=-1), float(np.linalg.norm(apart))
    unit = np.maximum(way @ apart / length, LEAST_BASELINE * distance)[:, None] / length
    translation = np.concatenate(
        [seen - unit * (shift @ turn) - (way - unit * apart) / 2 - rotation @ centre, unit], -1
    )
    agree = np.linalg.norm(way - unit * apart, axis=-1) < AGREE_SHIFT * distance
    return rotation[agree], translation[agree]


def _agreement(rig: Rig, rotations: Array, translations: Array) -> Array:
    """Score poses (p, 3, 3), (p, 4) cheaply: robust log-likelihood (p,) of all bearings at a wide scale, nats."""
    total, scale = np.zeros(len(rotations)), WIDE_SCALES * rig.floor
    for k, problem in enumerate(rig.problems):
        rotations_of_camera, shifts = rig.pose_of(k, rotations, translations)
        seen = problem.points3d @ rotations_of_camera.transpose(0, 2, 1) + shifts[:, None]
        seen /= np.maximum(np.linalg.norm(seen, axis=-1, keepdims=True), 1e-300)
        nearest = (problem.bearings @ seen.transpose(0, 2, 1)).max(-1)
        total += np.logaddexp((nearest - 1) / scale**2, -4.0).sum(-1)
    return total
