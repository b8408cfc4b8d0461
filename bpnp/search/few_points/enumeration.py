"""Poses of few points (4 to some hundred a side) by exact enumeration: every small group of points is tried.

Triples of an image point and its neighbours are paired with triples of a scene point and its neighbours, nearest
first. Each pair is solved (P3P) and preverified on nearby points. Those that pass are refined on all points,
one-to-one. The neighbourhoods grow until the verdict is safe, every triple was tried, or the time is up.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Literal, NamedTuple

import numpy as np

from bpnp.arrays import Array
from bpnp.runtime import Clock
from bpnp.search.few_points.hypotheses import VISITED_PAIRS, Block, Kept, Work, explore
from bpnp.search.few_points.matching import TESTED_RADII, EnumerationTables, Matches
from bpnp.search.few_points.points import ImageSide, pairs, predicted_pose, prior_arrays, scene_side, sets_within
from bpnp.search.hypotheses import Hypotheses
from bpnp.search.kernels.sides import fit_any
from bpnp.search.problem import Problem
from bpnp.search.starts import PosePrior

MOST_PRODUCTS = 4000  # largest number of image points times scene points that are enumerated: 63 x 63 [products; cost]
MOST_PRODUCTS_KNOWN = 250_000  # the limit where a prior lets two matches fix a pose [products; cost]
KEPT_POSES = 16  # distinct poses that are kept [poses; cost]
SAFE_NATS = math.log(1e6)  # margin over chance and any other pose that ends the search at once [nats; calibration]
# After twice as many the search ends with any significant pose.
PATIENCE = 25_000  # hypotheses after which the required margin has fallen linearly to 0 [hypotheses; calibration]
HYPOTHESES_A_LOOK = 3_000  # hypotheses between checks of the best pose once it is significant [hypotheses; cost]
HYPOTHESES_A_SWEEP = 20_000  # hypotheses between checks before [hypotheses; cost]
MOST_HYPOTHESES = 200_000  # largest number of hypotheses [hypotheses; cost]
WIDEST_REACH = 12.0  # largest radius within which points are matched to a predicted pose [match radii; calibration]
SEEN_WITNESSES = 3.0  # preverification points that are seen if the image covers the scene evenly [points; calibration]
FEWEST_WITNESSES = 10  # fewest preverification points of a hypothesis [points; calibration]
MOST_WITNESSES = 32  # most preverification points of a hypothesis [points; cost]
# Expected chance matches of these points from which two, and three, matches are required.
WITNESS_CHANCES = (0.05, 0.3)  # [matches; calibration]


class Stage(NamedTuple):
    """Block of hypotheses: the `near2d` nearest of an image point with the `near3d` nearest of a scene point."""

    matches: int  # of a hypothesis: 3, or 2 where a prior lets two matches fix a pose
    near2d: int  # neighbours of an image point
    near3d: int  # neighbours of a scene point
    reach: float  # largest residual of a match before the pose is refined, in match radii


# Blocks of hypotheses, in their order; those of two matches need a prior that lets two fix a pose.
STAGES = (  # [`Stage`; calibration]
    *(Stage(2, *near, 0.6) for near in ((5, 9), (9, 16), (63, 63))),
    *(Stage(2, 63, 63, 2.0), Stage(3, 3, 5, 0.5), Stage(3, 4, 7, 0.5), Stage(3, 3, 5, 2.0)),
    *(Stage(3, *near, reach) for near in ((5, 9), (8, 13), (24, 32), (63, 63)) for reach in (0.5, 2.0)),
)
HYPOTHESIS_SECONDS = 2e-6  # time of a hypothesis of the enumeration before it is measured [seconds; cost]
LEAST_PACE = 1e-9  # least measured time of a hypothesis; a coarse clock may measure 0 [seconds; numerics]
SET_SECONDS = 5e-7  # time of a set of points when a stage of the enumeration begins [seconds; cost]
FACING_SET_SECONDS = 5e-6  # the same for a set of points with normals [seconds; cost]
SHORTEST_SECONDS = 5e-5  # time before the deadline in which no hypothesis is begun [seconds; cost]
ORDERS = {
    2: np.array([[0, 1, 1], [1, 0, 0]]),
    3: np.array([[0, 1, 2], [1, 2, 0], [2, 0, 1], [0, 2, 1], [1, 0, 2], [2, 1, 0]]),
}

Ended = Literal["exhausted", "safe", "interrupted", "most"]


class Enumerated(NamedTuple):
    """Result of an enumeration."""

    # Distinct hypotheses, likeliest first, with matches and residuals. `evidence` is in nats, less the logarithm of the
    # number of tests. `basin_count` is the number of image sets with a hypothesis that ended at the pose.
    poses: Hypotheses
    # "exhausted" after every minimal problem, "safe" if the best pose leads by a safe margin, "interrupted" by the
    # deadline, "most" after the largest number of hypotheses.
    ended: Ended


class Enumeration:
    """Enumeration of one problem."""

    def __init__(
        self,
        problem: Problem,
        radius: float,
        *,
        stages: Sequence[Stage] = STAGES,
        most: int = MOST_HYPOTHESES,
        kept: int = KEPT_POSES,
    ) -> None:
        scene = scene_side(problem.points3d, problem.normals3d, problem.labels3d)
        self.reach = _reach(problem, radius, stages)  # largest radius of a match, in match radii
        image = ImageSide(problem.bearings, radius, problem.labels2d, self.reach)
        (prior, heading, log_share), fixing = prior_arrays(problem, scene, image), problem.fixing_matches
        # most: largest number of hypotheses.
        self.problem, self.scene, self.image, self.most = problem, scene, image, most
        # solved: number of minimal problems solved so far.
        # fixing: number of matches that fix a pose.
        self.fixing, self.solved, self._pace = fixing, 0, HYPOTHESIS_SECONDS
        self.ended: Ended | None = None  # why the enumeration ended, as in `Enumerated`; None before
        self._predicted, self._safe = predicted_pose(problem.prior), 0.0
        self._last_reach = stages[-1].reach if stages else 0.0
        self._stages = [stage for stage in stages if stage.matches >= fixing]
        self._stage: Stage | None = None
        self._is_checked = self._is_complete = True
        m, n = len(image.arrays.rays), len(scene.arrays.points)
        # Inputs of the compiled loops.
        self.tables = EnumerationTables(scene.arrays, image.arrays, prior, heading, fixing, image.density)
        self.kept = Kept(
            poses=np.zeros((kept, 4, 3)),
            evidence=np.full(kept, -math.inf),
            counts=np.zeros(kept, np.int64),
            point=np.full((kept, m), -1),
            distance2=np.zeros((kept, m)),
            best=np.zeros(1, np.int64),
            most=np.zeros(1),
            basin_count=np.zeros(kept, np.int64),
            last=np.full(kept, -1),
            at=np.zeros(1, np.int64),
        )
        self._may_match = fit_any(image.arrays.grid.labels, scene.arrays.labels)
        matches = Matches(np.empty(m, np.int64), np.empty(m))
        self.work = Work(np.empty((4, 4, 3)), matches, np.empty((8, 6)))  # buffers of the compiled loops
        seen = SEEN_WITNESSES * n / max(m - fixing, 1)
        near = int(np.clip(seen, FEWEST_WITNESSES, MOST_WITNESSES))
        self._witnesses = np.ascontiguousarray(scene.nearest[:, :near])
        problems = _log_choose(m, fixing) + _log_choose(n, fixing) + math.lgamma(fixing + 1) + log_share
        # Logarithm of the number of minimal problems of these points times the number of radii tested.
        self.tests = math.log(TESTED_RADII) + max(problems, 0.0)
        self._done: dict[tuple[int, float], tuple[int, int]] = {}
        none = np.empty((0, fixing), np.int64)
        empty = np.zeros(m, np.int64)
        self._block = Block(
            size=fixing,
            sets=none,
            orders=ORDERS[fixing],
            triangles=pairs(none),
            by_label=empty[:0],
            low=empty,
            high=empty,
            free=0,
            old_image=0,
            old_scene=0,
            witnesses=self._witnesses,
            need=0,
            reach=1.0,
        )

    @property
    def is_significant(self) -> bool:
        """True if the best pose explains more than chance after all tests."""
        return self.best >= self.tests

    @property
    def safe_margin(self) -> float:
        """Margin in nats above which the best pose ends the enumeration; it falls with the hypotheses solved."""
        return self._safe * (1 - self.solved / PATIENCE)

    @property
    def is_long(self) -> bool:
        """True if enough hypotheses are solved for a significant pose to end the enumeration."""
        return self.solved >= 2 * PATIENCE

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
        return SET_SECONDS * image + (FACING_SET_SECONDS if len(self.scene.arrays.normals) else SET_SECONDS) * scene

    def begin(self, stage: Stage) -> None:
        """Continue with the hypotheses of a stage, without those solved before."""
        m, n = len(self.image.arrays.rays), len(self.scene.arrays.points)
        sets = sets_within(self.image.nearest, stage.near2d, stage.matches)
        sets = sets[self._may_match[sets].all(-1)]
        triangles = self.scene.triangles(stage.matches, stage.near3d)
        before = self._done.get((stage.matches, stage.reach), (0, 0))
        self._done[stage.matches, stage.reach] = len(sets), len(triangles.triples)
        # The required number of preverification points depends on the expected number of chance matches.
        chance = self._witnesses.shape[1] * m * self.image.density * stage.reach**2
        one, two = WITNESS_CHANCES
        need = (1 if chance < one else 2 if chance < two else 3) + (stage.matches == 2)
        need = min(need, m - stage.matches, n - stage.matches)
        size, orders = stage.matches, ORDERS[stage.matches]
        by_label, sorted_labels = self.scene.by_label(size, stage.near3d)
        labels, free = self.image.arrays.grid.labels, int(np.searchsorted(sorted_labels, 0))
        low, high = (np.searchsorted(sorted_labels, labels, side) for side in ("left", "right"))
        low, high = np.where(labels < 0, free, low), np.where(labels < 0, len(by_label), high)
        self._block = Block(
            *(size, sets, orders, triangles, by_label, low, high, free, *before),
            *(self._witnesses, need, stage.reach),
        )
        self._row, self._triangle = 0, 0
        self.kept.most[0] = 0.0

    def advance(self, deadline: float) -> bool:
        """Continue until the best pose is significant, or to the end; return False at the end, which `ended` explains.

        The predicted pose of the prior is tried first, then the hypotheses stage by stage. Once a pose is significant,
        the function returns after every `HYPOTHESES_A_LOOK` hypotheses. The deadline is a time of `Clock`.
        """
        if self._predicted is not None:
            predicted, self._predicted = self._predicted, None
            self.propose(*predicted, self.reach)
            if self.is_significant:
                return True
        self._safe = SAFE_NATS
        while self.ended is None:
            self._advance(deadline)
            if not self._is_checked and self.is_significant:
                return True
        return False

    def _advance(self, deadline: float) -> None:
        """Solve some hypotheses of the current stage, begin the next stage, or end."""
        stage = self._stage
        late = not self._is_checked and deadline - Clock.now() < SHORTEST_SECONDS
        if not self._is_checked and (late or self.solved > self.most):
            self.ended = "interrupted" if late else "most"
            return
        self._is_checked = True
        if stage is not None and self._row < len(self._block.sets) * len(self._block.orders):
            self.sweep(HYPOTHESES_A_LOOK if self.is_significant else HYPOTHESES_A_SWEEP, deadline)
            self._is_checked = False
            return
        m, n = len(self.problem.bearings), len(self.problem.points3d)
        if stage is not None:
            self._is_complete = stage.near2d >= m - 1 and stage.near3d >= n - 1
            if self._is_complete and stage.matches == 3 and stage.reach == self._last_reach:
                self._stages = []
        if not self._stages:
            self.ended = "exhausted" if stage is not None and self._is_complete else "most"
        elif self.seconds_to_begin(self._stages[0]) > deadline - Clock.now():
            self.ended = "interrupted"
        else:
            self._stage = self._stages.pop(0)
            self.begin(self._stage)

    def sweep(self, most: int, deadline: float) -> None:
        """Solve `most` hypotheses of the stage.

        Fewer are solved if a better significant pose is found, half of the time is over, or labels exclude almost all.
        """
        start, stop = Clock.now(), max(self.best + 1e-9, self.tests)
        most = int(min(most, max(0.5 * (deadline - start) / self._pace, 1)))
        self._row, self._triangle, solved, visited = self._explored(self._row, self._triangle, most, stop, 1.0)
        self.solved += solved
        if (done := max(solved, visited // VISITED_PAIRS)) >= most:
            self._pace = max((Clock.now() - start) / done, LEAST_PACE)

    def propose(self, rotation: Array, translation: Array, reach: float) -> None:
        """Refine a pose (3, 3), (3,) from matches within `reach` radii, and keep it."""
        turn = self.image.turn
        self.refine(np.vstack([turn @ rotation, turn @ translation]), reach)

    def refine(self, pose: Array, reach: float) -> None:
        """Refine a pose (4, 3), in the frame of the arrays, from matches within `reach` radii, and keep it."""
        self.work.poses[0] = pose
        self._explored(0, 0, 0, 0.0, reach)

    def poses(self) -> Hypotheses:
        """Return the kept poses, likeliest first, after the best one was refined again on wider matches."""
        kept = self.kept
        for reach in (0.5 * self.reach, self.reach) if math.isfinite(self.best) else ():
            self.refine(kept.poses[int(kept.evidence.argmax())], reach)
        order = np.argsort(-kept.evidence, kind="stable")
        order = order[np.isfinite(kept.evidence[order])]
        rotation = self.image.turn.T @ kept.poses[order, :3]
        translation = kept.poses[order, 3] @ self.image.turn
        matches, radii = kept.point[order], np.sqrt(kept.distance2[order])
        matched, angle = matches >= 0, radii / self.image.arrays.per_radian
        count = matched.sum(-1)
        free = np.maximum(2 * count - 2 * self.fixing, 1)  # degrees of freedom
        return Hypotheses.from_poses(
            rotation,
            translation,
            match_count=count,
            scale=np.sqrt((np.where(matched, angle, 0.0) ** 2).sum(-1) / free),
            basin_count=kept.basin_count[order],
            evidence=kept.evidence[order] - self.tests,
            matches=matches,
            residual=np.where(matched, angle, math.inf),
        )

    def _explored(self, *where: int | float) -> tuple[int, int, int, int]:
        """Call the compiled loops; return the next row and triangle, and the numbers of hypotheses and of pairs."""
        return explore(*where, self._block, self.tables, self.kept, self.work)


def enumerate_poses(
    problem: Problem,
    *,
    radius: float | None = None,
    deadline: float = math.inf,
    to_the_end: bool = False,
    most: int = MOST_HYPOTHESES,
    kept: int = KEPT_POSES,
) -> Enumerated:
    """Enumerate poses under which image points see scene points, one-to-one within a radius in radians.

    The default radius is the match radius of the problem. With prior gravity, or a rotation within a few degrees, two
    matches fix a pose. A predicted pose is tried first. Unless it runs `to_the_end`, the enumeration stops once the
    best pose is significant and leads every other pose by a safe margin.

    >>> import numpy as np
    >>> rng = np.random.default_rng(0)
    >>> points = rng.uniform(-1, 1, (8, 3))
    >>> seen = points[:6] + [0, 0, 5]
    >>> problem = Problem(seen / np.linalg.norm(seen, axis=1, keepdims=True), points)
    >>> found = enumerate_poses(problem, radius=2e-3).poses
    >>> np.allclose(found.rotation[0], np.eye(3)), found.matches[0].tolist()
    (True, [0, 1, 2, 3, 4, 5])
    """
    run = Enumeration(problem, problem.match_radius if radius is None else radius, most=most, kept=kept)
    while run.advance(deadline):
        if not to_the_end and margin(poses := run.poses(), problem) >= run.safe_margin:
            return Enumerated(poses, "safe")
        if run.is_long:
            run.ended = "most"
            break
    assert run.ended is not None
    return Enumerated(run.poses(), run.ended)


def _reach(problem: Problem, radius: float, stages: Sequence[Stage]) -> float:
    """Return the largest radius of a match, in match radii.

    It covers the uncertainty of a predicted pose, up to `WIDEST_REACH`.
    """
    needed = max([1.0, *(stage.reach for stage in stages)])
    if (predicted := predicted_pose(problem.prior)) is not None and isinstance(problem.prior, PosePrior):
        distance = max(float(np.linalg.norm(predicted[1])), 1e-12)
        turn = math.radians(problem.prior.rotation_sigma_deg) * min(1 / distance, 1.0)
        off = 2 * math.hypot(turn, problem.prior.translation_sigma / distance)
        needed = max(needed, min(off / radius, WIDEST_REACH))
    return needed


def margin(poses: Hypotheses, problem: Problem) -> float:
    """Return the nats by which the best pose exceeds both chance after all tests, and every different pose."""
    if poses.evidence is None or not len(poses):
        return -math.inf
    other = poses.evidence[~problem.same_as(poses.pose(), poses.rotation, poses.translation)]
    margin = float(poses.evidence[0] - other.max()) if len(other) else math.inf
    return min(float(poses.evidence[0]), margin)


def _log_choose(n: int, k: int) -> float:
    """Return log C(n, k), or 0 for n < k."""
    return math.lgamma(n + 1) - math.lgamma(k + 1) - math.lgamma(n - k + 1) if n >= k else 0.0


def is_enumerable(problem: Problem) -> bool:
    """Return whether the points are few enough to be enumerated."""
    products = len(problem.bearings) * len(problem.points3d)
    return products <= (MOST_PRODUCTS if problem.fixing_matches == 3 else MOST_PRODUCTS_KNOWN)


def exceeds_enumeration(problem: Problem) -> bool:
    """Return whether the points are too many to be enumerated without a prior.

    With a prior they may be enumerated, but the enumeration may miss a pose.
    """
    return not is_enumerable(replace(problem, prior=None))
