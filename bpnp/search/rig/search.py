"""One pose of several cameras that are fixed to each other: proposed by each alone, refined and judged on all of them.

Few points of a camera are enumerated. Cameras with many search in turns, each as if it were alone but that raster
searches look points up in all of them; of what a turn finds those poses are refined that have most evidence in all
cameras together, and the search ends where the best is certain. As long as none exceeds chance, each round ends with a
raster search around that with most evidence.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from bpnp.loops.parallel import NEVER, Clock, Deadline, one_blas_thread
from bpnp.poses import distinct, seen_from
from bpnp.search.enumeration.search import enumerate_poses, is_enumerable
from bpnp.search.enumeration.settings import DEFAULT as ENUMERATION
from bpnp.search.evidence.repetitions import repeated_poses
from bpnp.search.evidence.uncertainty import share_bound
from bpnp.search.hypotheses import Hypotheses, to_problem_frame, to_scene_frame
from bpnp.search.pool import Pool
from bpnp.search.raster_search import search_beside
from bpnp.search.rig.cameras import WIDE, Array, Pose, Rig
from bpnp.search.scene import Scene
from bpnp.search.schedule import turns
from bpnp.search.search import lacks_partners
from bpnp.search.settings import DEFAULT
from bpnp.search.verdict import SearchResult, judged, missed, no_pose

PROPOSING = replace(ENUMERATION, kept=4000)  # poses of few points that a camera proposes
REFINED = 16  # poses of all cameras
A_TURN = 2  # poses that a turn of a camera finds and that are refined
COMPARED = 64  # proposals of which it is asked how much evidence they have
BEFORE = 1e9  # nats, more than any pose explains: of those that were refined before
AGREE_DEG, AGREE, PAIRS = 6.0, 0.2, 50_000  # of poses of two cameras that tell a scale: turn, shift in distances, most
LEAST_APART = 0.01  # of two cameras, in distances of the scene: a scale with which they are nearer cannot be told


@one_blas_thread
def search_rig(rig: Rig, *, clutter: float | None = None, seed: int = 0, deadline: Deadline = NEVER) -> SearchResult:
    """Distinct poses of the rig, best first, and the verdict on the first one; arguments as for `search_poses`."""
    settings = DEFAULT if clutter is None else DEFAULT.expecting(clutter)
    together, searches, few = Together(rig), dict[int, Iterator[Hypotheses]](), dict[int, Hypotheses]()
    for k, problem in enumerate(rig.problems):
        if is_enumerable(problem):
            until = (Clock.now() * (len(rig.problems) - k - 1) + deadline.at) / (len(rig.problems) - k)
            found = enumerate_poses(problem, deadline=until, is_safe=lambda _: False, settings=PROPOSING)
            few[k] = Hypotheses.from_poses(found.poses.rotation, found.poses.translation)
            together.exhaustive &= found.ended == "exhausted"
            continue
        together.exhaustive = False
        scene = Scene(problem, seed + k, settings, deadline)
        if not lacks_partners(scene):
            together.pools[k] = Pool(scene, problem, no_pose("no pose was found"))
            searches[k] = turns(together.pools[k], None, None)
    rig.join({k: pool.scene for k, pool in together.pools.items()})
    together.take(few, REFINED)
    while searches and together.turns < settings.schedule.turns and not deadline.passed():
        for k in list(searches):
            new = next(searches[k], None)
            if new is None or deadline.passed():
                del searches[k]
                continue
            together.pools[k].turns += 1
            together.pools[k].merge(new)
            together.take({k: new}, A_TURN)
            if together.may_be_certain():
                result = together.result()
                if result.verdict == "confident" or result.settled:
                    return result
        together.look_around()
    return together.result()


class Together:
    """What the cameras of a rig have proposed, and the best of it refined on all.

    met: of each camera all poses, in the frame of its problem. pools: of those that search. starts: poses of the rig
    that were refined, with their evidence. looked: those around which was searched. best: distinct poses, best first.
    exhaustive: whether every pose was looked at.
    """

    def __init__(self, rig: Rig) -> None:
        self.rig, self.rule, self.exhaustive = rig, DEFAULT.evidence, True
        self.met = [Hypotheses.empty() for _ in rig.problems]
        self.starts = Hypotheses.empty(4)
        self.best, self.looked, self.pools = self.starts, self.starts, dict[int, Pool]()

    @property
    def turns(self) -> int:
        """Of all cameras."""
        return sum(pool.turns for pool in self.pools.values())

    def take(self, new: Mapping[int, Hypotheses], most: int) -> None:
        """Refine at most so many of the poses that cameras propose, in the frames of their scenes if they have one,
        those that all agree with best."""
        new = {k: to_problem_frame(p, self.pools[k].scene) if k in self.pools else p for k, p in new.items()}
        rotation, translation = _proposals(self.rig, new, self.met)
        for k, poses in new.items():
            self.met[k] = Hypotheses.concatenate([self.met[k], poses])
        if len(rotation) > COMPARED:
            best = np.argsort(-_agreement(self.rig, rotation, translation), kind="stable")[:COMPARED]
            rotation, translation = rotation[best], translation[best]
        score = np.array([self.rig.evidence(*pose).sum() for pose in zip(rotation, translation, strict=True)])
        poses, known = Hypotheses.from_poses(rotation, translation, log_likelihood=score), len(self.starts)
        every = Hypotheses.concatenate([self.starts, poses])
        order = self._distinct(every, np.r_[np.full(known, BEFORE), score], known + most)[known:]
        self.starts = every[np.r_[:known, order]]
        self._add(self.rig.candidates(every.rotation[order], every.translation[order]))

    def look_around(self) -> None:
        """Search around the pose with most evidence, if none exceeds chance, around none twice."""
        if not self.pools or not len(self.starts) or self.best.log10_false_alarms[:1].min(initial=math.inf) < 0:
            return
        poses = Hypotheses.concatenate([self.looked, self.starts])
        score = np.r_[np.full(len(self.looked), BEFORE), self.starts.log_likelihood]
        apart = DEFAULT.schedule.apart_deg
        order = distinct(poses.rotation, poses.translation, score, len(self.looked) + 1, apart, math.inf)
        new = poses[order[len(self.looked) :]]
        self.looked = Hypotheses.concatenate([self.looked, new])
        k = max(self.pools, key=lambda k: len(self.rig.problems[k].bearings))
        turn, shift = self.rig.pose_of(k, new.rotation, new.translation)
        if len(new):
            scene = self.pools[k].scene
            pose = to_scene_frame(Hypotheses.from_poses(turn, shift), scene)
            self.take({k: search_beside(scene, pose, scene.settings.beside)}, A_TURN)

    def _add(self, refined: Hypotheses) -> None:
        """Take up refined poses; the best one has the basin counts of all cameras."""
        every = Hypotheses.concatenate([self.best, refined])
        self.best = every[self._distinct(every, -every.log10_false_alarms, REFINED)]
        if len(self.best):
            self.best.basin_count[0] = sum(
                int(poses.basin_count[self._as_best(k, poses)].sum()) for k, poses in enumerate(self.met)
            )

    def _distinct(self, poses: Hypotheses, score: Array, count: int) -> NDArray[np.int64]:
        """Return the indices of the best poses, of which no two are the same to all cameras."""
        seen = []
        for k, problem in enumerate(self.rig.problems):
            turns, shifts = self.rig.pose_of(k, poses.rotation, poses.translation)
            seen.append(turns @ problem.middle + shifts)
        return distinct(poses.rotation, seen_from(np.stack(seen, 1)), score, count, *self.rule.same)

    def _looks(self) -> int:
        """How often its surroundings were searched in vain."""
        return sum(
            int(self._as_best(k, to_problem_frame(pool.surrounded, pool.scene)).sum()) for k, pool in self.pools.items()
        )

    def _as_best(self, k: int, poses: Hypotheses) -> NDArray[np.bool_]:
        """Which poses of a camera are the best one."""
        turn, shift = self.rig.pose_of(k, self.best.rotation[:1], self.best.translation[:1])
        both = np.concatenate([turn, poses.rotation]), np.concatenate([shift, poses.translation])
        return self.rig.problems[k].same_pose(*both, self.rule.same)[1:]

    def may_be_certain(self) -> bool:
        """Whether chance is excluded, and that a better pose was missed."""
        if not len(self.best) or self.best.log10_false_alarms[0] > self.rule.false_alarms:
            return False
        strongest, seen = self._strongest()
        return missed(seen, self.rig.problems[strongest], self._looks(), self.rule) <= self.rule.missed

    def _strongest(self) -> tuple[int, Hypotheses]:
        """The camera in which the best pose has most evidence, and the poses as its own."""
        k = int(self.rig.evidence(self.best.rotation[0], self.best.translation[0], float(self.best.scale[0])).argmax())
        return k, self.rig.seen(k, self.best)

    def result(self) -> SearchResult:
        """The verdict on the best poses, beside those that a repeated structure would confuse with a confident one."""
        if not len(self.best):
            return no_pose("no pose was found")
        result = self._judged()
        if result.verdict == "confident":
            strongest, seen = self._strongest()
            known = seen.rotation[0], seen.translation[0], float(seen.scale[0])
            repeated, _ = repeated_poses(self.rig.problems[strongest], *known, self.rule)
            turns, shifts = repeated.rotation, repeated.translation
            self._add(self.rig.candidates(*self.rig.rig_of(strongest, turns, shifts, self.best.translation[0, 3])))
            result = self._judged()
        if result.verdict == "confident" and self.rig.unknowns == 7:
            best = self.best.rotation[0], self.best.translation[0], float(self.best.scale[0])
            covariance, free = self.rig.covariance(*best), 2 * float(self.best.match_count[0]) - 7
            if covariance is None or share_bound(covariance[6:, 6:], free) > self.rule.scale:
                off = f"it may be more than {100 * self.rule.scale:.0f} % off"
                reason = f"the scale of the scene cannot be told: {off}"
                result = replace(result, verdict="ambiguous", reason=reason)
        poses = replace(result.candidates, rotation=self.best.rotation, translation=self.best.translation)
        return replace(result, candidates=poses)

    def _judged(self) -> SearchResult:
        strongest, seen = self._strongest()
        return judged(
            seen,
            self.rig.problems[strongest],
            batches=self.turns,
            looks=self._looks(),
            exhaustive=self.exhaustive,
            rule=self.rule,
            rig=[(self.rig.seen(k, self.best), problem) for k, problem in enumerate(self.rig.problems)],
        )


def _proposals(rig: Rig, new: Mapping[int, Hypotheses], met: Sequence[Hypotheses]) -> Pose:
    """Poses of the rig: those of each camera; or, of an unknown scale, those in which two cameras that are apart agree,
    one of them with what it had `met` before, the middle of the scene where it is with least squares."""
    if rig.unknowns == 6:
        parts = [rig.rig_of(k, poses.rotation, poses.translation) for k, poses in new.items()]
    else:
        pairs = [(k, other, poses) for k, poses in new.items() for other in range(len(met))]
        parts = []
        for k, other, poses in pairs:
            others = [met[other], *([new[other]] if other in new and other > k else [])]
            if (min(k, other), max(k, other)) in rig.apart:
                parts.append(_told_by(rig, (k, other), poses, Hypotheses.concatenate(others)))
    if not parts:
        return np.empty((0, 3, 3)), np.empty((0, 4))
    rotation, translation = map(np.concatenate, zip(*parts, strict=True))
    return rotation, translation


def _told_by(rig: Rig, pair: tuple[int, int], first: Hypotheses, second: Hypotheses) -> Pose:
    """Poses of the rig in which two cameras agree."""
    (turn, shift), (other, moved) = (rig.mounts[k] for k in pair)
    middle = rig.problems[0].middle
    turns, others = (turn.T @ first.rotation).reshape(-1, 9), (other.T @ second.rotation).reshape(-1, 9)
    traces = turns.astype(np.float32) @ others.T.astype(np.float32)
    near = np.flatnonzero(traces.ravel() > 1 + 2 * math.cos(math.radians(AGREE_DEG)))
    i, j = np.divmod(near[np.argsort(-traces.ravel()[near], kind="stable")[:PAIRS]], max(len(others), 1))
    rotation = turn.T @ first.rotation[i]
    seen = (first.rotation[i] @ middle + first.translation[i]) @ turn  # from the first camera, in the axes of the rig
    way = seen - (second.rotation[j] @ middle + second.translation[j]) @ other
    apart = shift @ turn - moved @ other
    distance, length = np.linalg.norm(seen, axis=-1), float(np.linalg.norm(apart))
    unit = np.maximum(way @ apart / length, LEAST_APART * distance)[:, None] / length
    translation = np.concatenate(
        [seen - unit * (shift @ turn) - (way - unit * apart) / 2 - rotation @ middle, unit], -1
    )
    agree = np.linalg.norm(way - unit * apart, axis=-1) < AGREE * distance
    return rotation[agree], translation[agree]


def _agreement(rig: Rig, rotations: Array, translations: Array) -> Array:
    """How well poses (p, 3, 3), (p, 4) explain the bearings of all cameras at a wide scale, nats (p,)."""
    total, scale = np.zeros(len(rotations)), WIDE * rig.floor
    for k, problem in enumerate(rig.problems):
        turns, shifts = rig.pose_of(k, rotations, translations)
        seen = problem.points3d @ turns.transpose(0, 2, 1) + shifts[:, None]
        seen /= np.maximum(np.linalg.norm(seen, axis=-1, keepdims=True), 1e-300)
        nearest = (problem.bearings @ seen.transpose(0, 2, 1)).max(-1)
        total += np.logaddexp((nearest - 1) / scale**2, -4.0).sum(-1)
    return total
