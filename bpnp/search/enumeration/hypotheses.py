"""An enumeration under way: the blocks of hypotheses that it solves, and the poses that it has kept so far."""

import math
import time

import numpy as np

from bpnp.search.enumeration.matching import Matches, PosePriorArrays, Problem
from bpnp.search.enumeration.points import Array, ImageSide, SceneSide, sets_within
from bpnp.search.enumeration.refinement import Kept, Work, vary
from bpnp.search.enumeration.settings import EnumerationSettings, Stage
from bpnp.search.enumeration.sweep import Block, sweep

ORDERS = {
    2: np.array([[0, 1, 1], [1, 0, 0]]),
    3: np.array([[0, 1, 2], [1, 2, 0], [2, 0, 1], [0, 2, 1], [1, 0, 2], [2, 1, 0]]),
}


SLOWEST = 2e-6  # seconds a hypothesis, before it is known
BUILT, BUILT_FACING = 5e-7, 5e-6  # seconds a set of points when a stage begins, and one with normals


class Enumeration:
    """Of one problem. fixing: matches that fix a pose. reach: largest radius at which matches are looked up.

    tests: log of the number of minimal problems that these points hold, times the radii that are looked at. solved: how
    many were solved.
    """

    def __init__(
        self, scene: SceneSide, image: ImageSide, prior: tuple[PosePriorArrays, float], fixing: int, reach: float,
        settings: EnumerationSettings,
    ) -> None:  # fmt: skip
        self.scene, self.image, self.settings, self.reach = scene, image, settings, reach
        self.fixing, self.solved, self._pace = fixing, 0, SLOWEST
        m, n, kept = len(image.arrays.rays), len(scene.arrays.points), settings.kept
        self.problem = Problem(scene.arrays, image.arrays, prior[0], fixing, image.density, settings.rules)
        self.kept = Kept(
            np.zeros((kept, 4, 3)), np.full(kept, -math.inf), np.zeros(kept, np.int64), np.full((kept, m), -1),
            np.zeros((kept, m)), np.zeros(1, np.int64), np.zeros(1),
        )  # fmt: skip
        matches = Matches(np.empty(m, np.int64), np.empty(m))
        self.work = Work(
            np.empty((4, 3)), np.empty((3, 3)), np.empty((4, 4, 3)), np.empty((4, 3)), matches, np.empty((8, 6)),
            np.empty((4, 3)), np.empty(m, np.int64),
        )  # fmt: skip
        seen = settings.seen_witnesses * n / max(m - fixing, 1)
        near = int(np.clip(seen, settings.fewest_witnesses, settings.most_witnesses))
        self._witnesses = np.ascontiguousarray(scene.nearest[:, :near])
        problems = _log_choose(m, fixing) + _log_choose(n, fixing) + math.lgamma(fixing + 1) + prior[1]
        self.tests = math.log(settings.rules.ladder) + max(problems, 0.0)
        self._done: dict[tuple[int, float], tuple[int, int]] = {}

    @property
    def best(self) -> float:
        """Evidence of the best pose, nats."""
        return float(self.kept.evidence.max())

    @property
    def best_pose(self) -> Array:
        """(4, 3), in these frames."""
        return self.kept.poses[int(self.kept.evidence.argmax())]

    def seconds_to_begin(self, stage: Stage) -> float:
        """About how long the sets of a stage take to build."""
        image, scene = (
            len(side) * min(near, side.shape[1]) ** (stage.matches - 1) / 2
            for side, near in ((self.image.nearest, stage.near2d), (self.scene.nearest, stage.near3d))
        )
        if self.scene.has_triangles(stage.matches, stage.near3d):
            scene = 0
        return BUILT * image + (BUILT_FACING if len(self.scene.arrays.normals) else BUILT) * scene

    def begin(self, stage: Stage) -> None:
        """Go on with the hypotheses of a stage; those that were solved before are not solved again."""
        m, n = len(self.image.arrays.rays), len(self.scene.arrays.points)
        sets, triangles = (
            sets_within(self.image.nearest, stage.near2d, stage.matches),
            self.scene.triangles(stage.matches, stage.near3d),
        )
        before = self._done.get((stage.matches, stage.reach), (0, 0))
        self._done[stage.matches, stage.reach] = len(sets), len(triangles.triples)
        # How many witnesses make a hypothesis worth a look depends on what chance gives it.
        chance = self._witnesses.shape[1] * m * self.image.density * stage.reach**2
        one, two = self.settings.witness_chances
        need = (1 if chance < one else 2 if chance < two else 3) + (stage.matches == 2)
        need = min(need, m - stage.matches, n - stage.matches)
        self._block = Block(
            stage.matches, sets, ORDERS[stage.matches], triangles, *before, self._witnesses, need, stage.reach
        )
        self._row, self._triangle = 0, 0
        self.kept.most[0] = 0.0

    @property
    def ended(self) -> bool:
        """Whether all hypotheses of the stage were tried."""
        return self._row >= len(self._block.sets) * len(self._block.orders)

    def sweep(self, most: int, deadline: float) -> None:
        """Solve `most` hypotheses, or fewer if the best pose becomes better, or half of the time to the deadline is
        over."""
        start, stop = time.monotonic(), max(self.best + 1e-9, self.tests)
        most = int(min(most, max(0.5 * (deadline - start) / self._pace, 1)))
        self._row, self._triangle, solved = sweep(
            self._row, self._triangle, most, stop, self._block, self.problem, self.kept, self.work
        )
        self.solved += solved
        if solved >= most:
            self._pace = (time.monotonic() - start) / solved

    def vary_best(self) -> None:
        """Refine the best pose again on wider and on other matches, and its mirror twin: its nearly flat matched points
        seen at the opposite tilt."""
        if not math.isfinite(self.best):
            return
        for reach in (0.5 * self.reach, self.reach):
            self.refine(self.best_pose, reach, exchanged=reach == self.reach)
        matched = self.kept.point[int(self.kept.evidence.argmax())]
        seen = self.scene.arrays.points[matched[matched >= 0]]
        if len(seen) < 3:
            return
        rotation, translation = self.best_pose[:3], self.best_pose[3]
        centre = seen.mean(0)
        normal = np.linalg.svd(seen - centre)[2][2]
        middle = rotation @ centre + translation
        sight = middle / np.linalg.norm(middle)
        turned = (np.eye(3) - 2 * np.outer(sight, sight)) @ rotation @ (np.eye(3) - 2 * np.outer(normal, normal))
        self.refine(np.vstack([turned, middle - turned @ centre]), self.reach)

    def refine(self, pose: Array, reach: float, *, exchanged: bool = False) -> None:
        """Refine a pose (4, 3) of these frames from matches within `reach` radii, and keep it.

        exchanged: and what follows from the best pose with other matches.
        """
        self.work.pose[:] = pose
        vary(reach, exchanged, self.problem, self.kept, self.work)

    def enter(self, rotation: Array, translation: Array) -> Array:
        """A pose of the given points as (4, 3) in these frames."""
        middle = self.image.turn @ (rotation @ self.scene.centre + translation)
        return np.vstack([self.image.turn @ rotation, middle / self.scene.size])

    def leave(self, poses: Array) -> tuple[Array, Array]:
        """Poses (c, 4, 3) of these frames as rotations (c, 3, 3) and translations (c, 3) of the given points."""
        rotation = self.image.turn.T @ poses[:, :3]
        return rotation, self.scene.size * poses[:, 3] @ self.image.turn - rotation @ self.scene.centre


def _log_choose(n: int, k: int) -> float:
    return math.lgamma(n + 1) - math.lgamma(k + 1) - math.lgamma(n - k + 1) if n >= k else 0.0
