"""Poses of few points (4 to some hundred a side) by exact enumeration: every small group of points is tried.

Triples of an image point and its nearest are paired with triples of a scene point and its nearest, nearest first, and
each pair is solved (P3P), rejected by the points beside it, or refined on all points, one-to-one. The neighbourhoods
grow until the verdict is safe, every triple was tried, or the time is up.
"""

import math
import time
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bpnp.search.few.arrays import ImageArrays, SceneArrays, scene_arrays
from bpnp.search.few.priors import knowledge_of, predicted_pose
from bpnp.search.few.state import Enumeration, Stage
from bpnp.search.few.symmetries import near_symmetries
from bpnp.search.point_sets import PointSets
from bpnp.search.starts import PosePrior, Prior

Array = NDArray[np.float64]
Labels = NDArray[np.int64]


class FewSettings(NamedTuple):
    """Constants of the enumeration.

    stages: what is tried, one after the other; those of two pairs only where a prior lets two pairs fix a pose.
    kept: distinct poses. other_deg: poses farther apart answer differently. safe: nats beyond chance and ahead of
    any other pose at which the search ends at once; after `patience` hypotheses none are asked for, and after twice
    as many it ends with any pose that exceeds chance. look, chunk: hypotheses between looks at the best pose, when
    it exceeds chance and before. most: hypotheses in all. widest: radii within which points are matched to a
    predicted pose.
    """

    stages: tuple[Stage, ...] = (
        Stage(2, 5, 9, 0.6), Stage(2, 9, 16, 0.6), Stage(2, 63, 63, 0.6), Stage(2, 63, 63, 2.0),
        Stage(3, 3, 5, 0.5), Stage(3, 4, 7, 0.5), Stage(3, 3, 5, 2.0), Stage(3, 5, 9, 0.5), Stage(3, 5, 9, 2.0),
        Stage(3, 8, 13, 0.5), Stage(3, 8, 13, 2.0), Stage(3, 24, 32, 0.5), Stage(3, 24, 32, 2.0),
        Stage(3, 63, 63, 0.5), Stage(3, 63, 63, 2.0),
    )  # fmt: skip
    kept: int = 16
    other_deg: float = 10.0
    safe: float = math.log(1e6)
    patience: int = 25_000
    look: int = 3_000
    chunk: int = 20_000
    most: int = 200_000
    widest: float = 12.0


SETTINGS = FewSettings()


class FewPoses(NamedTuple):
    """Distinct poses camera = R p + t, likeliest first.

    rotation: (c, 3, 3). translation: (c, 3). evidence: (c,) nats beyond chance, before the number of tests counts.
    match: (c, m) the scene point that each image point is, -1 for none. residual: (c, m) its angle, radians, infinite
    where there is none. used: matches that fix the pose. tests: log of the number of minimal problems that these points
    hold, times the radii that were looked at. solved: how many were solved. exhausted: whether all were.
    """

    rotation: Array
    translation: Array
    evidence: Array
    match: Labels
    residual: Array
    used: int
    tests: float
    solved: int
    exhausted: bool


def enumerate_poses(
    sets: PointSets,
    *,
    radius: float | Array,
    deadline: float = math.inf,
    is_safe: Callable[[FewPoses], bool] | None = None,
    settings: FewSettings = SETTINGS,
) -> FewPoses:
    """Poses under which image points see scene points, one-to-one within `radius`.

    radius: radians, one for all or one for each bearing: the largest residual of a match, a few standard deviations of
    the noise. deadline: of `time.monotonic`. is_safe: asked whether to stop, once the best pose exceeds chance and
    every other pose; None for always. Where gravity is known, or the rotation to a few degrees, two pairs fix a pose;
    where a whole pose is known, it is tried first.

    >>> import numpy as np
    >>> rng = np.random.default_rng(0)
    >>> points = rng.uniform(-1, 1, (8, 3))
    >>> seen = points[:6] + [0, 0, 5]
    >>> sets = PointSets(seen / np.linalg.norm(seen, axis=1, keepdims=True), points)
    >>> found = enumerate_poses(sets, radius=2e-3)
    >>> np.allclose(found.rotation[0], np.eye(3)), found.match[0].tolist()
    (True, [0, 1, 2, 3, 4, 5])
    """
    prior = sets.prior
    scene = scene_arrays(sets.points3d, sets.normals3d, sets.labels3d)
    lookup = _lookup(prior, scene, radius, settings)
    image = ImageArrays(sets.bearings, radius, sets.labels2d, lookup)
    symmetries = near_symmetries(sets.points3d)
    run = Enumeration(scene, image, knowledge_of(sets, scene, image), settings.kept, lookup)

    def vary() -> None:
        run.vary_best()
        for turn, shift in symmetries:
            rotation, translation = run.best_pose()
            run.refine(run.enter(rotation @ turn, rotation @ shift + translation), run.widest)

    def enough(safe: float = settings.safe) -> FewPoses | None:
        if run.best < run.tests:
            return None
        vary()
        found = _found(run, exhausted=False)
        needed = safe * (1 - run.solved / settings.patience)
        doubtful = margin(found, settings) < needed or not (is_safe is None or is_safe(found))
        return None if doubtful and run.solved < 2 * settings.patience else found

    if (predicted := predicted_pose(prior)) is not None:
        run.refine(run.enter(*predicted), lookup)
        if (found := enough(0.0)) is not None:
            return found
    complete = False
    for stage in settings.stages:
        if stage.pairs < run.used:
            continue
        place, count = 0, run.begin(stage)
        while place < count:
            place = run.sweep(place, settings.look if run.best >= run.tests else settings.chunk)
            if (found := enough()) is not None:
                return found
            if time.monotonic() > deadline or run.solved > settings.most:
                vary()
                return _found(run, exhausted=False)
        complete = stage.near2d >= len(sets.bearings) - 1 and stage.near3d >= len(sets.points3d) - 1
        if complete and stage.pairs == 3 and stage.reach == settings.stages[-1].reach:
            break
    vary()
    return _found(run, exhausted=complete)


def _lookup(prior: Prior | None, scene: SceneArrays, radius: float | Array, settings: FewSettings) -> float:
    """Radii within which points are looked up: as far as a predicted pose may be off, `settings.widest` at most."""
    needed = max([1.0, *(stage.reach for stage in settings.stages)])
    if (predicted := predicted_pose(prior)) is not None and isinstance(prior, PosePrior):
        middle = predicted[0] @ scene.centre + predicted[1]
        distance = max(float(np.linalg.norm(middle)), 1e-12)
        turn = math.radians(prior.rotation_sigma_deg) * min(scene.size / distance, 1.0)
        off = 2 * math.hypot(turn, prior.translation_sigma / distance)
        needed = max(needed, min(off / float(np.mean(radius)), settings.widest))
    return needed


def _found(run: Enumeration, *, exhausted: bool) -> FewPoses:
    """The kept poses, likeliest first."""
    poses, values, _, matches, distances2, *_ = run.found
    order = np.argsort(-values, kind="stable")
    order = order[np.isfinite(values[order])]
    rotation, translation = run.leave(poses[order])
    residual = np.where(matches[order] >= 0, np.sqrt(distances2[order]) / run.image.rays[:, 3], math.inf)
    return FewPoses(
        rotation, translation, values[order], matches[order], residual, run.used, run.tests, run.solved, exhausted
    )


def margin(found: FewPoses, settings: FewSettings = SETTINGS) -> float:
    """Nats by which the best pose exceeds both chance after all tests, and every different pose."""
    if not len(found.evidence):
        return -math.inf
    traces = np.einsum("cij,ij->c", found.rotation, found.rotation[0])
    other = found.evidence[traces < 1 + 2 * math.cos(math.radians(settings.other_deg))]
    lead = float(found.evidence[0] - other.max()) if len(other) else math.inf
    return min(float(found.evidence[0]) - found.tests, lead)
