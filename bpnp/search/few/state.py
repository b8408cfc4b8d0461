"""An enumeration under way: the poses that were kept so far, and what the compiled loops work on."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bpnp.search.few.arrays import ImageArrays, SceneArrays
from bpnp.search.few.enumeration import sweep
from bpnp.search.few.kept import vary
from bpnp.search.few.matching import RADII
from bpnp.search.few.priors import Knowledge, sweep_pairs
from bpnp.search.few.triangles import orders_of_triples

Array = NDArray[np.float64]
Labels = NDArray[np.int64]
SEEN_WITNESSES = 3.0  # of those that check a hypothesis, if the image points are spread evenly over the scene
FEWEST_WITNESSES, MOST_WITNESSES = 10, 32


class Stage(NamedTuple):
    """A block of hypotheses: the `near2d` nearest of an image point with the `near3d` nearest of a scene point.

    pairs: of a hypothesis, 3, or 2 where a prior lets them fix a pose. reach: radii within which a point counts for
    such a pose, before it is refined.
    """

    pairs: int
    near2d: int
    near3d: int
    reach: float


class Enumeration:
    """One pair of point sets. kept: distinct poses at most. reach: the largest at which matches are looked up."""

    def __init__(self, scene: SceneArrays, image: ImageArrays, known: Knowledge, kept: int, reach: float) -> None:
        self.scene, self.image, self.known, self.widest = scene, image, known, reach
        m, n = len(image.rays), len(scene.arrays[0])
        self.found = (
            np.zeros((kept, 12)), np.full(kept, -math.inf), np.zeros(kept, np.int64), np.full((kept, m), -1),
            np.zeros((kept, m)), np.zeros(1, np.int64), np.zeros(2),
        )  # fmt: skip
        self.work = (
            np.empty((4, 3)), np.empty((3, 3)), np.empty(12), np.empty(m, np.int64), np.empty(m), np.empty((8, 6)),
            np.empty((2, 12)), known.place, np.empty(12), np.empty(m, np.int64),
        )  # fmt: skip
        self.used, k = known.pairs, known.pairs
        self._data = image.rays, scene.arrays, image.arrays, k, image.density, known.directions, self.found, self.work
        near = int(np.clip(SEEN_WITNESSES * n / max(m - k, 1), FEWEST_WITNESSES, MOST_WITNESSES))
        self._witnesses = np.ascontiguousarray(scene.order[:, :near])
        problems = _log_choose(m, k) + _log_choose(n, k) + math.lgamma(k + 1) + known.log_share
        self.tests = math.log(RADII) + max(problems, 0.0)
        self.solved = 0
        self._done: dict[tuple[int, float], tuple[int, int]] = {}

    @property
    def best(self) -> float:
        """Evidence of the best pose, nats."""
        return float(self.found[1].max())

    def begin(self, stage: Stage) -> int:
        """How many image triples, or pairs, the stage has; those that were done before are not solved again."""
        m, n = len(self.image.rays), len(self.scene.arrays[0])
        self.stage = stage
        if stage.pairs == 3:
            self._image, self._scene = self.image.triples(stage.near2d), self.scene.triples(stage.near3d)
            self._orders = orders_of_triples(self.image.rays[:, :3], self._image)
        else:
            self._image, self._pairs = self.image.pairs(stage.near2d), self.scene.pairs(stage.near3d)
        self._count = len(self._scene[0] if stage.pairs == 3 else self._pairs)
        self._before = self._done.get((stage.pairs, stage.reach), (0, 0))
        self._done[stage.pairs, stage.reach] = len(self._image), self._count
        # How many witnesses make a hypothesis worth a look depends on what chance gives it.
        chance = self._witnesses.shape[1] * m * self.image.density * stage.reach**2
        need = (1 if chance < 0.05 else 2 if chance < 0.3 else 3) + (stage.pairs == 2)
        self._need = min(need, m - stage.pairs, n - stage.pairs)
        self.found[6][1] = 0.0
        return len(self._image)

    def sweep(self, place: int, chunk: int) -> int:
        """The image triple, or pair, after about `chunk` hypotheses, or after the best pose has become better."""
        stop = max(self.best + 1e-9, self.tests)
        block = place, len(self._image), *self._before, self._count, stop, chunk, self.image.rays
        rest = self._witnesses, self._need, self.stage.reach, *self._data[1:]
        if self.stage.pairs == 3:
            place, solved = sweep(*block, self._orders, self._scene, *rest)
        else:
            place, solved = sweep_pairs(*block, self._image, self._pairs, self.known.upright, self.known.turned, *rest)
        self.solved += solved
        return int(place)

    def vary_best(self) -> None:
        """Refine the best pose again on wider and on other matches, and its mirror twin: its nearly flat matched points
        seen at the opposite tilt."""
        if not math.isfinite(self.best):
            return
        for reach in (0.5 * self.widest, self.widest):
            self.refine(self.found[0][int(self.found[1].argmax())], reach, exchanged=reach == self.widest)
        best = int(self.found[1].argmax())
        matched = self.found[3][best]
        seen = self.scene.arrays[0][matched[matched >= 0]]
        if len(seen) < 3:
            return
        rotation, translation = self.found[0][best, :9].reshape(3, 3), self.found[0][best, 9:]
        centre = seen.mean(0)
        normal = np.linalg.svd(seen - centre)[2][2]
        middle = rotation @ centre + translation
        sight = middle / np.linalg.norm(middle)
        turned = (np.eye(3) - 2 * np.outer(sight, sight)) @ rotation @ (np.eye(3) - 2 * np.outer(normal, normal))
        self.refine(np.concatenate([turned.ravel(), middle - turned @ centre]), self.widest)

    def refine(self, pose: Array, reach: float, *, exchanged: bool = False) -> None:
        """Refine a pose (12,) of these frames from matches within `reach` radii, and keep it.

        exchanged: and what follows from the best pose with other matches.
        """
        self.work[2][:] = pose
        vary(reach, exchanged, *self._data)

    def best_pose(self) -> tuple[Array, Array]:
        """Rotation (3, 3) and translation (3,) of the best pose, of the given points."""
        rotation, translation = self.leave(self.found[0][[int(self.found[1].argmax())]])
        return rotation[0], translation[0]

    def enter(self, rotation: Array, translation: Array) -> Array:
        """A pose of the given points as (12,) in these frames."""
        turned = self.image.turn @ rotation
        middle = self.image.turn @ (rotation @ self.scene.centre + translation)
        return np.concatenate([turned.ravel(), middle / self.scene.size])

    def leave(self, poses: Array) -> tuple[Array, Array]:
        """Poses (c, 12) of these frames as rotations (c, 3, 3) and translations (c, 3) of the given points."""
        rotation = self.image.turn.T @ poses[:, :9].reshape(-1, 3, 3)
        return rotation, self.scene.size * poses[:, 9:] @ self.image.turn - rotation @ self.scene.centre


def _log_choose(n: int, k: int) -> float:
    return math.lgamma(n + 1) - math.lgamma(k + 1) - math.lgamma(n - k + 1) if n >= k else 0.0
