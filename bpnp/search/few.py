"""Poses of few points (4 to some hundred a side) by exact enumeration: every small group of points is tried.

Triples of an image point and its nearest are paired with triples of a scene point and its nearest, nearest first, and
each pair is solved (P3P), rejected by the points beside it, or refined on all points, one-to-one. The neighbourhoods
grow until the verdict is safe, every triple was tried, or the time is up.
"""

import math
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bpnp.search.constellation.arrays import ImageArrays, SceneArrays, scene_arrays
from bpnp.search.constellation.enumeration import sweep
from bpnp.search.constellation.kept import try_pose
from bpnp.search.constellation.matching import RADII

Array = NDArray[np.float64]
Labels = NDArray[np.int64]
USED_BY_TRIPLE = 3  # matches that fix a pose, and are no evidence for it


class FewSettings(NamedTuple):
    """Constants of the enumeration.

    stages: what is tried, one after the other: neighbours of an image point and of a scene point whose triples are
    solved, and the radii within which a point counts for a pose of three pairs, before it is refined.
    kept: distinct poses. witnesses: near points that reject a pose first. other_deg: poses farther apart answer
    differently. safe: nats beyond chance and ahead of any other pose at which the search ends at once; after
    `patience` hypotheses none are asked for. look, chunk: hypotheses between looks at the best pose, when it exceeds
    chance and before. most: hypotheses in all.
    """

    stages: tuple[tuple[int, int, float], ...] = (
        (3, 5, 0.5), (4, 7, 0.5), (3, 5, 2.0), (5, 9, 0.5), (5, 9, 2.0), (8, 13, 0.5), (8, 13, 2.0), (24, 32, 0.5),
        (24, 32, 2.0), (63, 63, 0.5), (63, 63, 2.0),
    )  # fmt: skip
    kept: int = 16
    witnesses: int = 10
    other_deg: float = 10.0
    safe: float = math.log(1e6)
    patience: int = 30_000
    look: int = 3_000
    chunk: int = 20_000
    most: int = 200_000


SETTINGS = FewSettings()


class FewPoses(NamedTuple):
    """Distinct poses camera = R p + t, likeliest first.

    rotation: (c, 3, 3). translation: (c, 3). evidence: (c,) nats beyond chance, before the number of tests counts.
    match: (c, m) the scene point that each image point is, -1 for none. residual: (c, m) its angle, radians, infinite
    where there is none. visible: (c,) scene points that could be seen among the image points; expected: (c,) that
    should be seen, by their normals. used: matches that fix the pose. tests: log of the number of minimal problems that
    these points hold, times the radii that were looked at. solved: how many were solved. exhausted: whether all were.
    """

    rotation: Array
    translation: Array
    evidence: Array
    match: Labels
    residual: Array
    visible: Labels
    expected: Labels
    used: int
    tests: float
    solved: int
    exhausted: bool

    def matches_within(self, radius: float) -> Labels:
        """Matches of each pose within `radius`, radians (c,)."""
        return np.asarray((self.residual <= radius).sum(-1))


def enumerate_poses(
    bearings: Array,
    points3d: Array,
    *,
    radius: float | Array,
    normals3d: Array | None = None,
    labels2d: Labels | None = None,
    labels3d: Labels | None = None,
    deadline: float = math.inf,
    is_safe: Callable[[FewPoses], bool] | None = None,
    settings: FewSettings = SETTINGS,
) -> FewPoses:
    """Poses under which image points see scene points, one-to-one within `radius`.

    bearings: (m, 3) unit. points3d: (n, 3), any unit and origin. radius: radians, one for all or one for each bearing:
    the largest residual of a match, a few standard deviations of the noise. normals3d: (n, 3) outward unit normals: a
    point faces the camera or is not seen. labels2d, labels3d: only points of one label can be partners, -1 fits any.
    deadline: of `time.monotonic`. is_safe: asked whether to stop, once the best pose exceeds chance and every other
    pose; None for always.
    """
    scene = scene_arrays(points3d, normals3d, labels3d, settings.witnesses)
    run = _Enumeration(scene, ImageArrays(bearings, radius, labels2d, max(settings.stages)[2]), settings)
    done: dict[float, tuple[int, int]] = {}
    complete = False
    for near2d, near3d, reach in settings.stages:
        triples2d, (tables, count3d) = run.image.triples(near2d), scene.triples(near3d)
        place, before = 0, done.get(reach, (0, 0))
        done[reach] = len(triples2d), count3d
        run.begin(reach)
        while place < len(triples2d):
            place = run.sweep(triples2d, place, before, tables, count3d)
            if run.best() >= run.tests:
                run.vary_best()
                found = run.poses(exhausted=False)
                needed = settings.safe * (1 - run.solved / settings.patience)
                if margin(found, settings) >= needed and (is_safe is None or is_safe(found)):
                    return found
            if time.monotonic() > deadline or run.solved > settings.most:
                run.vary_best()
                return run.poses(exhausted=False)
        complete = near2d >= len(bearings) - 1 and near3d >= len(points3d) - 1
        if complete and reach == settings.stages[-1][2]:
            break
    run.vary_best()
    return run.poses(exhausted=complete)


def margin(found: FewPoses, settings: FewSettings = SETTINGS) -> float:
    """Nats by which the best pose exceeds both chance after all tests, and every different pose."""
    if not len(found.evidence):
        return -math.inf
    traces = np.einsum("cij,ij->c", found.rotation, found.rotation[0])
    other = found.evidence[traces < 1 + 2 * math.cos(math.radians(settings.other_deg))]
    lead = float(found.evidence[0] - other.max()) if len(other) else math.inf
    return min(float(found.evidence[0]) - found.tests, lead)


class _Enumeration:
    """The poses that were kept so far, and what the compiled loops work on."""

    def __init__(self, scene: SceneArrays, image: ImageArrays, settings: FewSettings) -> None:
        self.scene, self.image, self.settings = scene, image, settings
        m, n, kept = len(image.rays), len(scene.arrays[0]), settings.kept
        self.found = (
            np.zeros((kept, 12)), np.full(kept, -math.inf), np.zeros((kept, 3), np.int64),
            np.full((kept, m), -1), np.zeros((kept, m)), np.zeros(1, np.int64),
            np.zeros(2),
        )  # fmt: skip
        self.work = (
            np.empty((4, 3)), np.empty((3, 3)), np.empty(12), np.empty(m, np.int64), np.empty(m),
            np.empty((6, 6)), np.empty(6), np.empty(6),
        )  # fmt: skip
        self.prior = np.empty((0, 8))
        self.used = USED_BY_TRIPLE
        self.tests = math.log(RADII) + math.log(6) + _log_choose(m, self.used) + _log_choose(n, self.used)
        self.solved, self.reach, self.need = 0, 1.0, 1

    def begin(self, reach: float) -> None:
        """A new stage: how many witnesses make a hypothesis worth a look depends on what chance gives it."""
        m, n = len(self.image.rays), len(self.scene.arrays[0])
        chance = self.scene.witnesses.shape[1] * m * self.image.density * reach**2
        self.reach, self.need = reach, min(1 if chance < 0.05 else 2 if chance < 0.3 else 3, m - 3, n - 3)
        self.found[6][1] = 0.0

    def best(self) -> float:
        return float(self.found[1].max())

    def sweep(
        self, triples2d: NDArray[np.int64], place: int, before: tuple[int, int], tables: Any, count3d: int
    ) -> int:
        """The next image triple after a chunk of hypotheses, the smaller the likelier the best pose is."""
        promising = self.best() >= self.tests
        stop = max(self.best() + 1e-9, self.tests)
        chunk = self.settings.look if promising else self.settings.chunk
        place, solved = sweep(
            place, len(triples2d), *before, count3d, stop, chunk, self.image.rays, triples2d, tables,
            self.scene.witnesses, self.need, self.scene.arrays, self.image.arrays, self.reach, self.used,
            self.image.density, self.prior, self.found, self.work,
        )  # fmt: skip
        self.solved += solved
        return place

    def vary_best(self) -> None:
        """Refine the best pose again on other matches, and its mirror twin: its nearly flat matched points seen at the
        opposite tilt."""
        for reach in sorted({reach for *_, reach in self.settings.stages}):
            self._try(self.found[0][int(self.found[1].argmax())], reach)
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
        self._try(np.concatenate([turned.ravel(), middle - turned @ centre]), max(self.settings.stages)[2])

    def _try(self, pose: Array, reach: float) -> None:
        self.work[2][:] = pose
        try_pose(
            self.image.rays, self.scene.arrays, self.image.arrays, reach, self.used, self.image.density, self.prior,
            self.found, self.work,
        )  # fmt: skip

    def poses(self, exhausted: bool) -> FewPoses:
        """The kept poses in the frames of the given points."""
        poses, values, counts, matches, distances2, *_ = self.found
        order = np.argsort(-values, kind="stable")
        order = order[np.isfinite(values[order])]
        turned = poses[order, :9].reshape(-1, 3, 3)
        rotation = self.image.turn.T @ turned
        translation = self.scene.size * poses[order, 9:] @ self.image.turn - rotation @ self.scene.centre
        residual = np.where(matches[order] >= 0, np.sqrt(distances2[order]) / self.image.rays[:, 3], math.inf)
        return FewPoses(
            rotation, translation, values[order], matches[order].copy(), residual, counts[order, 1], counts[order, 2],
            self.used, self.tests, self.solved, exhausted,
        )  # fmt: skip


def _log_choose(n: int, k: int) -> float:
    return math.lgamma(n + 1) - math.lgamma(k + 1) - math.lgamma(n - k + 1)
