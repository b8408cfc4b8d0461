"""Poses of few points (4 to some hundred a side) by exact enumeration: every small group of points is tried.

Triples of an image point and its nearest are paired with triples of a scene point and its nearest, nearest first, and
each pair is solved (P3P), rejected by the points beside it, or refined on all points, one-to-one. The neighbourhoods
grow until the verdict is safe, every triple was tried, or the time is up.
"""

import math
import time
from collections.abc import Callable
from typing import Literal, NamedTuple

import numpy as np

from bpnp.search.enumeration.hypotheses import Enumeration
from bpnp.search.enumeration.points import Array, ImageSide, Places, SceneSide, scene_side
from bpnp.search.enumeration.priors import predicted_pose, prior_arrays
from bpnp.search.enumeration.settings import DEFAULT, EnumerationSettings
from bpnp.search.enumeration.symmetries import near_symmetries
from bpnp.search.point_sets import PointSets
from bpnp.search.starts import PosePrior

SHORTEST = 5e-5  # seconds, in which no hypothesis is begun
Ended = Literal["exhausted", "safe", "interrupted", "most"]


class EnumeratedPoses(NamedTuple):
    """Distinct poses camera = R p + t, likeliest first.

    rotation: (c, 3, 3). translation: (c, 3). evidence: (c,) nats beyond chance, before the number of tests counts.
    match: (c, m) the scene point that each image point is, -1 for none. residual: (c, m) its angle, radians, infinite
    where there is none. fixing, tests, solved: of `Enumeration`. ended: why; "exhausted" where every hypothesis was
    tried, "safe" where `is_safe` said so, "interrupted" by the deadline, "most" after as many as are allowed.
    """

    rotation: Array
    translation: Array
    evidence: Array
    match: Places
    residual: Array
    fixing: int
    tests: float
    solved: int
    ended: Ended


def enumerate_poses(
    sets: PointSets,
    *,
    radius: float | Array,
    deadline: float = math.inf,
    is_safe: Callable[[EnumeratedPoses], bool] | None = None,
    settings: EnumerationSettings = DEFAULT,
) -> EnumeratedPoses:
    """Poses under which image points see scene points, one-to-one within `radius`.

    radius: radians, one for all or one for each bearing: the largest residual of a match, a few standard deviations of
    the noise. deadline: of `time.monotonic`. is_safe: asked whether to stop, once the best pose exceeds chance and
    every other pose; None for always. Where gravity is known, or the rotation to a few degrees, two matches fix a pose;
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
    scene = scene_side(sets.points3d, sets.normals3d, sets.labels3d)
    reach = _reach(sets, scene, radius, settings)
    image = ImageSide(sets.bearings, radius, sets.labels2d, reach)
    prior = prior_arrays(sets, scene, image, settings)
    run = Enumeration(scene, image, prior, sets.pairs_that_fix, reach, settings)

    def vary() -> None:
        run.vary_best()
        for turn, shift in near_symmetries(sets.points3d):
            (rotation,), (translation,) = run.leave(run.best_pose[None])
            run.refine(run.enter(rotation @ turn, rotation @ shift + translation), run.reach)

    def enough(safe: float = settings.safe) -> EnumeratedPoses | None:
        if run.best < run.tests:
            return None
        vary()
        poses = _poses(run, "safe")
        if margin(poses, settings) >= safe * (1 - run.solved / settings.patience) and (
            is_safe is None or is_safe(poses)
        ):
            return poses
        return poses._replace(ended="most") if run.solved >= 2 * settings.patience else None

    complete = False
    if (predicted := predicted_pose(sets.prior)) is not None:
        run.refine(run.enter(*predicted), reach)
        if (poses := enough(0.0)) is not None:
            return poses
    for stage in settings.stages:
        if stage.matches < run.fixing:
            continue
        if run.seconds_to_begin(stage) > deadline - time.monotonic():
            vary()
            return _poses(run, "interrupted")
        run.begin(stage)
        while not run.ended:
            run.sweep(settings.look if run.best >= run.tests else settings.chunk, deadline)
            if (poses := enough()) is not None:
                return poses
            late = deadline - time.monotonic() < SHORTEST
            if late or run.solved > settings.most:
                vary()
                return _poses(run, "interrupted" if late else "most")
        complete = stage.near2d >= len(sets.bearings) - 1 and stage.near3d >= len(sets.points3d) - 1
        if complete and stage.matches == 3 and stage.reach == settings.stages[-1].reach:
            break
    vary()
    return _poses(run, "exhausted" if complete else "most")


def _reach(sets: PointSets, scene: SceneSide, radius: float | Array, settings: EnumerationSettings) -> float:
    """Radii within which points are looked up: as far as a predicted pose may be off, `settings.widest` at most."""
    needed = max([1.0, *(stage.reach for stage in settings.stages)])
    if (predicted := predicted_pose(sets.prior)) is not None and isinstance(sets.prior, PosePrior):
        distance = max(float(np.linalg.norm(predicted[0] @ scene.centre + predicted[1])), 1e-12)
        turn = math.radians(sets.prior.rotation_sigma_deg) * min(scene.size / distance, 1.0)
        off = 2 * math.hypot(turn, sets.prior.translation_sigma / distance)
        needed = max(needed, min(off / float(np.mean(radius)), settings.widest))
    return needed


def _poses(run: Enumeration, ended: Ended) -> EnumeratedPoses:
    """The kept poses, likeliest first."""
    kept = run.kept
    order = np.argsort(-kept.evidence, kind="stable")
    order = order[np.isfinite(kept.evidence[order])]
    rotation, translation = run.leave(kept.poses[order])
    match, radii = kept.point[order], np.sqrt(kept.distance2[order])
    residual = np.where(match >= 0, radii / run.image.arrays.rays[:, 3], math.inf)
    evidence = kept.evidence[order]
    return EnumeratedPoses(rotation, translation, evidence, match, residual, run.fixing, run.tests, run.solved, ended)


def margin(poses: EnumeratedPoses, settings: EnumerationSettings = DEFAULT) -> float:
    """Nats by which the best pose exceeds both chance after all tests, and every different pose."""
    if not len(poses.evidence):
        return -math.inf
    traces = np.einsum("cij,ij->c", poses.rotation, poses.rotation[0])
    other = poses.evidence[traces < 1 + 2 * math.cos(math.radians(settings.other_deg))]
    lead = float(poses.evidence[0] - other.max()) if len(other) else math.inf
    return min(float(poses.evidence[0]) - poses.tests, lead)
