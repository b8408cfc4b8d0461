"""Poses of few points (4 to some hundred a side) by exact enumeration: every small group of points is tried.

Triples of an image point and its neighbours are paired with triples of a scene point and its neighbours, nearest
first. Each pair is solved (P3P) and preverified on nearby points. Those that pass are refined on all points,
one-to-one. The neighbourhoods grow until the verdict is safe, every triple was tried, or the time is up.
"""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Literal, NamedTuple

import numpy as np

from bpnp.loops.parallel import Clock, Deadline
from bpnp.search.enumeration.hypotheses import Block, Kept, Work, explore
from bpnp.search.enumeration.matching import EnumerationTables, Matches
from bpnp.search.enumeration.points import (
    Array,
    ImageSide,
    pairs,
    predicted_pose,
    prior_arrays,
    scene_side,
    sets_within,
)
from bpnp.search.enumeration.settings import DEFAULT, RULES, EnumerationSettings, Stage
from bpnp.search.evidence.partners import explained
from bpnp.search.evidence.repetitions import competing_poses, registered
from bpnp.search.hypotheses import Hypotheses
from bpnp.search.problem import Problem
from bpnp.search.settings import SearchSettings
from bpnp.search.starts import GravityPrior, PosePrior
from bpnp.search.verdict import is_certain, weighed, with_false_alarms

ORDERS = {
    2: np.array([[0, 1, 1], [1, 0, 0]]),
    3: np.array([[0, 1, 2], [1, 2, 0], [2, 0, 1], [0, 2, 1], [1, 0, 2], [2, 1, 0]]),
}

SLOWEST = 2e-6  # seconds a hypothesis, before it is measured
BUILT, BUILT_FACING = 5e-7, 5e-6  # seconds a set of points when a stage begins, and one with normals
SHORTEST = 5e-5  # seconds before the deadline, in which no hypothesis is begun
Ended = Literal["exhausted", "safe", "interrupted", "most"]


class Enumerated(NamedTuple):
    """Result of an enumeration.

    Attributes:
        poses: Distinct hypotheses, likeliest first, with matches and residuals. `evidence` is in nats, less the
            logarithm of the number of tests. `basin_count` is the number of image sets with a hypothesis that ended at
            the pose.
        ended: "exhausted" after every minimal problem, "safe" if `is_safe` returned True, "interrupted" by the
            deadline, "most" after the largest number of hypotheses.
    """

    poses: Hypotheses
    ended: Ended


Competitors = Callable[[Hypotheses], tuple[Array, Array]]


class Enumeration:
    """Enumeration of one problem.

    Attributes:
        scene: Scene of the problem.
        image: Image of the problem.
        settings: Constants.
        reach: Largest radius of a match, in match radii.
        fixing: Number of matches that fix a pose.
        solved: Number of minimal problems solved so far.
        contested: Poses (1,) whose competing poses were proposed.
        tests: Logarithm of the number of minimal problems of these points times the number of radii tested.
        tables: Inputs of the compiled loops.
        kept: Poses found so far.
        work: Buffers of the compiled loops.
    """

    def __init__(self, problem: Problem, radius: float, settings: EnumerationSettings) -> None:
        scene = scene_side(problem.points3d, problem.normals3d, problem.labels3d)
        self.reach = _reach(problem, radius, settings)
        image = ImageSide(problem.bearings, radius, problem.labels2d, self.reach)
        (prior, heading, log_share), fixing = prior_arrays(problem, scene, image, settings), problem.fixing_matches
        self.scene, self.image, self.settings = scene, image, settings
        self.fixing, self.solved, self._pace = fixing, 0, SLOWEST
        self.contested: list[Hypotheses] = []  # poses (1,) whose competitors were proposed
        m, n, kept = len(image.arrays.rays), len(scene.arrays.points), settings.kept
        self.tables = EnumerationTables(scene.arrays, image.arrays, prior, heading, fixing, image.density)
        self.kept = Kept(
            np.zeros((kept, 4, 3)),
            np.full(kept, -math.inf),
            np.zeros(kept, np.int64),
            np.full((kept, m), -1),
            np.zeros((kept, m)),
            np.zeros(1, np.int64),
            np.zeros(1),
            np.zeros(kept, np.int64),
            np.full(kept, -1),
            np.zeros(1, np.int64),
        )
        matches = Matches(np.empty(m, np.int64), np.empty(m))
        self.work = Work(np.empty((4, 4, 3)), matches, np.empty((8, 6)))
        seen = settings.seen_witnesses * n / max(m - fixing, 1)
        near = int(np.clip(seen, settings.fewest_witnesses, settings.most_witnesses))
        self._witnesses = np.ascontiguousarray(scene.nearest[:, :near])
        problems = _log_choose(m, fixing) + _log_choose(n, fixing) + math.lgamma(fixing + 1) + log_share
        self.tests = math.log(RULES.ladder) + max(problems, 0.0)
        self._done: dict[tuple[int, float], tuple[int, int]] = {}
        none = np.empty((0, fixing), np.int64)
        self._block = Block(fixing, none, ORDERS[fixing], pairs(none), 0, 0, self._witnesses, 0, 1.0)

    @property
    def best(self) -> float:
        """Evidence of the best pose, nats."""
        return float(self.kept.evidence.max())

    def seconds_to_begin(self, stage: Stage) -> float:
        """Estimate the seconds needed to build the sets of a stage."""
        image, scene = (
            len(side) * min(near, side.shape[1]) ** (stage.matches - 1) / 2
            for side, near in ((self.image.nearest, stage.near2d), (self.scene.nearest, stage.near3d))
        )
        if (stage.matches, min(stage.near3d, self.scene.nearest.shape[1])) in self.scene.tables:
            scene = 0
        return BUILT * image + (BUILT_FACING if len(self.scene.arrays.normals) else BUILT) * scene

    def begin(self, stage: Stage) -> None:
        """Continue with the hypotheses of a stage, without those solved before."""
        m, n = len(self.image.arrays.rays), len(self.scene.arrays.points)
        sets = sets_within(self.image.nearest, stage.near2d, stage.matches)
        triangles = self.scene.triangles(stage.matches, stage.near3d)
        before = self._done.get((stage.matches, stage.reach), (0, 0))
        self._done[stage.matches, stage.reach] = len(sets), len(triangles.triples)
        # The required number of preverification points depends on the expected number of chance matches.
        chance = self._witnesses.shape[1] * m * self.image.density * stage.reach**2
        one, two = self.settings.witness_chances
        need = (1 if chance < one else 2 if chance < two else 3) + (stage.matches == 2)
        need = min(need, m - stage.matches, n - stage.matches)
        size, orders = stage.matches, ORDERS[stage.matches]
        self._block = Block(size, sets, orders, triangles, *before, self._witnesses, need, stage.reach)
        self._row, self._triangle = 0, 0
        self.kept.most[0] = 0.0

    @property
    def ended(self) -> bool:
        """True once all hypotheses of the stage were tried."""
        return self._row >= len(self._block.sets) * len(self._block.orders)

    def sweep(self, most: int, deadline: float) -> None:
        """Solve hypotheses of the stage.

        Args:
            most: Number of hypotheses. Fewer are solved if a better significant pose is found, or half of the time is
                over.
            deadline: When to stop (`Clock.now`).
        """
        start, stop = Clock.now(), max(self.best + 1e-9, self.tests)
        most = int(min(most, max(0.5 * (deadline - start) / self._pace, 1)))
        self._row, self._triangle, solved = self._explored(self._row, self._triangle, most, stop, 1.0)
        self.solved += solved
        if solved >= most:
            self._pace = (Clock.now() - start) / solved

    def propose(self, rotation: Array, translation: Array, reach: float) -> None:
        """Refine a pose (3, 3), (3,) from matches within `reach` radii, and keep it."""
        turn = self.image.turn
        self.refine(np.vstack([turn @ rotation, turn @ translation]), reach)

    def refine(self, pose: Array, reach: float) -> None:
        """Refine a pose (4, 3), in the frame of the arrays, from matches within `reach` radii, and keep it."""
        self.work.poses[0] = pose
        self._explored(0, 0, 0, 0.0, reach)

    def _explored(self, *where: int | float) -> tuple[int, int, int]:
        """Call the compiled loops; return the next row, the next triangle and the number of hypotheses solved."""
        return explore(*where, self._block, self.tables, self.kept, self.work)


def enumerate_poses(
    problem: Problem,
    *,
    radius: float | None = None,
    deadline: float = math.inf,
    is_safe: Callable[[Hypotheses], bool] | None = None,
    competitors: Competitors | None = None,
    settings: EnumerationSettings = DEFAULT,
) -> Enumerated:
    """Enumerate poses under which image points see scene points, one-to-one within a radius.

    With prior gravity, or a rotation within a few degrees, two matches fix a pose. A predicted pose is tried first.

    Args:
        problem: Points.
        radius: Largest residual of a match, radians; None for the match radius of the problem.
        deadline: When to stop (`Clock.now`).
        is_safe: Called once the best pose is significant and leads every other pose; True stops. None always stops.
        competitors: Returns competing poses of the best one, which are tried too; None for none.
        settings: Constants.

    Returns:
        The poses, and why the enumeration ended.

    >>> import numpy as np
    >>> rng = np.random.default_rng(0)
    >>> points = rng.uniform(-1, 1, (8, 3))
    >>> seen = points[:6] + [0, 0, 5]
    >>> problem = Problem(seen / np.linalg.norm(seen, axis=1, keepdims=True), points)
    >>> found = enumerate_poses(problem, radius=2e-3).poses
    >>> np.allclose(found.rotation[0], np.eye(3)), found.matches[0].tolist()
    (True, [0, 1, 2, 3, 4, 5])
    """
    run = Enumeration(problem, problem.match_radius if radius is None else radius, settings)

    def enough(safe: float = settings.safe) -> Enumerated | None:
        if run.best < run.tests:
            return None
        poses = _poses(run)
        if competitors is not None:
            poses = _with_competitors(run, problem, poses, competitors)
        if margin(poses, problem) >= safe * (1 - run.solved / settings.patience) and (
            is_safe is None or is_safe(poses)
        ):
            return Enumerated(poses, "safe")
        return Enumerated(poses, "most") if run.solved >= 2 * settings.patience else None

    complete = False
    if (predicted := predicted_pose(problem.prior)) is not None:
        run.propose(*predicted, run.reach)
        if (found := enough(0.0)) is not None:
            return found
    for stage in settings.stages:
        if stage.matches < run.fixing:
            continue
        if run.seconds_to_begin(stage) > deadline - Clock.now():
            return Enumerated(_poses(run), "interrupted")
        run.begin(stage)
        while not run.ended:
            run.sweep(settings.look if run.best >= run.tests else settings.chunk, deadline)
            if (found := enough()) is not None:
                return found
            late = deadline - Clock.now() < SHORTEST
            if late or run.solved > settings.most:
                return Enumerated(_poses(run), "interrupted" if late else "most")
        complete = stage.near2d >= len(problem.bearings) - 1 and stage.near3d >= len(problem.points3d) - 1
        if complete and stage.matches == 3 and stage.reach == settings.stages[-1].reach:
            break
    return Enumerated(_poses(run), "exhausted" if complete else "most")


def _with_competitors(run: Enumeration, problem: Problem, poses: Hypotheses, competitors: Competitors) -> Hypotheses:
    """Refine the competing poses of the best pose, and of each better pose that results; each pose once."""
    while True:
        known = Hypotheses.concatenate([poses[:1], *run.contested])
        if problem.same_pose(known.rotation, known.translation)[1:].any():
            return poses
        run.contested.append(poses[:1])
        for pose in zip(*competitors(poses), strict=True):
            run.propose(*pose, run.reach)
        poses = _poses(run)


def _reach(problem: Problem, radius: float, settings: EnumerationSettings) -> float:
    """Return the largest radius of a match, in match radii.

    It covers the uncertainty of a predicted pose, up to `settings.widest`.
    """
    needed = max([1.0, *(stage.reach for stage in settings.stages)])
    if (predicted := predicted_pose(problem.prior)) is not None and isinstance(problem.prior, PosePrior):
        distance = max(float(np.linalg.norm(predicted[1])), 1e-12)
        turn = math.radians(problem.prior.rotation_sigma_deg) * min(1 / distance, 1.0)
        off = 2 * math.hypot(turn, problem.prior.translation_sigma / distance)
        needed = max(needed, min(off / radius, settings.widest))
    return needed


def _poses(run: Enumeration) -> Hypotheses:
    """Return the kept poses, likeliest first, after the best one was refined again on wider matches."""
    kept = run.kept
    for reach in (0.5 * run.reach, run.reach) if math.isfinite(run.best) else ():
        run.refine(kept.poses[int(kept.evidence.argmax())], reach)
    order = np.argsort(-kept.evidence, kind="stable")
    order = order[np.isfinite(kept.evidence[order])]
    rotation = run.image.turn.T @ kept.poses[order, :3]
    translation = kept.poses[order, 3] @ run.image.turn
    matches, radii = kept.point[order], np.sqrt(kept.distance2[order])
    matched, angle = matches >= 0, radii / run.image.arrays.per_radian
    count = matched.sum(-1)
    free = np.maximum(2 * count - 2 * run.fixing, 1)  # degrees of freedom
    return Hypotheses.from_poses(
        rotation,
        translation,
        match_count=count,
        scale=np.sqrt((np.where(matched, angle, 0.0) ** 2).sum(-1) / free),
        basin_count=kept.basin_count[order],
        evidence=kept.evidence[order] - run.tests,
        matches=matches,
        residual=np.where(matched, angle, math.inf),
    )


def margin(poses: Hypotheses, problem: Problem) -> float:
    """Return the nats by which the best pose exceeds both chance after all tests, and every different pose."""
    if poses.evidence is None or not len(poses):
        return -math.inf
    other = poses.evidence[~problem.same_pose(poses.rotation, poses.translation)]
    lead = float(poses.evidence[0] - other.max()) if len(other) else math.inf
    return min(float(poses.evidence[0]), lead)


def _log_choose(n: int, k: int) -> float:
    """Return log C(n, k), or 0 for n < k."""
    return math.lgamma(n + 1) - math.lgamma(k + 1) - math.lgamma(n - k + 1) if n >= k else 0.0


def is_enumerable(problem: Problem) -> bool:
    """Return whether the points are few enough to be enumerated."""
    products = len(problem.bearings) * len(problem.points3d)
    return products <= (DEFAULT.most_products if problem.fixing_matches == 3 else DEFAULT.most_products_known)


def exceeds_enumeration(problem: Problem) -> bool:
    """Return whether the points are too many to be enumerated without a prior.

    With a prior they may be enumerated, but the enumeration may miss a pose.
    """
    return not is_enumerable(replace(problem, prior=None))


def search_by_enumeration(problem: Problem, deadline: Deadline, settings: SearchSettings) -> tuple[Hypotheses, bool]:
    """Search for the poses of few points by enumeration.

    A closely predicted pose, as in tracking, is tried first; the whole space is searched if it fails. With a rough
    prediction the whole space is searched if no pose near it is significant. If no pose with the prior gravity is
    significant, the search is repeated without it: a hypothesis of two matches has the error of the prior.

    Args:
        problem: Points.
        deadline: When to stop.
        settings: Constants.

    Returns:
        The poses, best first, and whether every hypothesis was tried.
    """
    certain: Hypotheses | None = None
    annotated = problem
    if problem.cosines3d is not None:
        problem = replace(problem, normals3d=None, cosines3d=None)

    def is_safe(poses: Hypotheses) -> bool:
        nonlocal certain
        candidates = weighed(_candidates(poses, annotated, settings), problem, settings.evidence)
        certain = candidates if is_certain(candidates, problem, settings.evidence) else None
        return certain is not None

    def competitors(poses: Hypotheses) -> tuple[Array, Array]:
        pose = poses.rotation[0], poses.translation[0]
        scale = max(float(poses.scale[0]), problem.floor or 1e-5)
        motions = registered(annotated, *pose, scale, settings.evidence)
        return competing_poses(annotated, *pose, motions, settings.evidence)

    def enumerated(problem: Problem, rule: EnumerationSettings) -> tuple[Enumerated, Hypotheses]:
        found = enumerate_poses(problem, deadline=deadline.at, is_safe=is_safe, competitors=competitors, settings=rule)
        return found, _candidates(found.poses, annotated, settings) if certain is None else certain

    tracked = predicted_pose(problem.prior) is not None
    near = tracked and problem.fixing_matches == 2
    found, candidates = enumerated(problem, replace(DEFAULT, stages=()) if near else DEFAULT)
    if certain is None and isinstance(problem.prior, GravityPrior):
        candidates = with_false_alarms(candidates, problem)
        if candidates.log10_false_alarms.min(initial=math.inf) > settings.evidence.false_alarms:
            found, others = enumerated(replace(problem, prior=None), DEFAULT)
            candidates = with_false_alarms(Hypotheses.concatenate([candidates, others]), problem)
            candidates = candidates[np.argsort(candidates.log10_false_alarms, kind="stable")[: settings.kept]]
    elif certain is None and tracked and (near or margin(found.poses, problem) < 0):
        found, others = enumerated(replace(problem, prior=None), DEFAULT)
        candidates = Hypotheses.concatenate([candidates, others])
        candidates = candidates[np.argsort(-candidates.log_likelihood, kind="stable")[: settings.kept]]
    return candidates, found.ended == "exhausted"


def _candidates(poses: Hypotheses, problem: Problem, settings: SearchSettings) -> Hypotheses:
    """Return the poses not far less likely than the best, with the scale and likelihood of the annealing."""
    if poses.evidence is None or not len(poses):
        return poses
    poses = poses[poses.evidence >= poses.evidence.max() - DEFAULT.near_nats][: settings.kept]
    scale = np.maximum(poses.scale, problem.floor or 1e-5)
    each = zip(poses.rotation, poses.translation, scale, strict=True)
    return replace(poses, scale=scale, log_likelihood=np.array([explained(problem, *one)[0] for one in each]))
