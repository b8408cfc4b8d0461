"""Pose from two unmatched point sets, without training: many starts, annealed; batch after batch until one is safe."""

import math
import time
from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np

from bpnp.loops.parallel import NEVER, Deadline, one_blas_thread
from bpnp.search.annealing import run_batch
from bpnp.search.candidates import Candidates
from bpnp.search.enumeration.search import is_crowd, is_few, search_few
from bpnp.search.looks.nearby import cooled, drawn_around, is_near, nearby_batch
from bpnp.search.looks.sequence import Proposals, beside_best, from_looks, proposed
from bpnp.search.point_sets import PointSets
from bpnp.search.pool import Pool, against_repetitions
from bpnp.search.scene import Scene, degenerate
from bpnp.search.settings import DEFAULT, SearchSettings
from bpnp.search.starts import PosePrior, Prior, draw_poses
from bpnp.search.verdict import SearchResult, is_exhausted, judged, no_pose, weighed_leaders

ROUND = 3  # batches with a prior, of which the last is without
Progress = Callable[[int, float], None]  # batches so far, seconds


@one_blas_thread
def search_poses(
    sets: PointSets,
    *,
    around: Prior | None = None,
    proposals: Proposals | None = None,
    clutter: float | None = None,
    seed: int = 0,
    deadline: Deadline = NEVER,
    settings: SearchSettings = DEFAULT,
    progress: Progress | None = None,
) -> SearchResult:
    """Every distinct pose (R, t) found that explains the bearings f_i by the points p_j, in no known order.

    Maximises the likelihood of the bearings under the mixture
    p(f_i) = (1 - w)/n sum_j exp((f_i . g(R p_j + t) - 1)/s^2) / 2 pi s^2 + w/A, g(y) = y/|y|, over pose and scale s,
    A the solid angle of the view, by annealing s from starts over all rotations, or around `sets.prior`.

    Few points (`bpnp.search.enumeration`) are enumerated first, and annealed only if that leaves a doubt.

    around: a guess from the same points, such as a network's pose: the first `settings.around` batches start there, and
        that they end alike is no evidence. proposals: gives poses to start from, such as those that a network finds
        likely, and no evidence either; asked where the search ends in doubt, without a prior of many points alone, and
        where no pose exceeds chance. seed: of all that is random.
    clutter: share of the points without a partner to expect, from 0 to below 1 (`SearchSettings.expecting`); None for
        that of the settings, and several at the end.
    deadline: after it no batch of starts begins, and one that has begun goes on with the poses it has; the result then
        depends on the machine. progress: called after each batch, and with 0 after the enumeration of few points.

    With fewer than 4 points of a side, or all bearings or all points on one line or in one place, there are no
    candidates. Raises ValueError for `clutter` out of range.
    """
    settings = settings if clutter is None else settings.expecting(clutter)
    start, few = time.monotonic(), no_pose("no pose was found")

    def tell(batches: int) -> None:
        if progress is not None:
            progress(batches, time.monotonic() - start)

    @cache
    def entered() -> Scene:
        return Scene(sets, seed, settings, deadline)

    crowd = is_crowd(sets)
    if is_few(sets) and not deadline.passed():
        few, exhausted = _enumerated(sets, entered, settings, deadline)
        tell(0)
        # More search helps only where no pose exceeds chance yet, and there are enough points to anneal.
        small = min(len(sets.bearings), len(sets.points3d)) < settings.least_annealed
        if few.verdict == "confident" or small or not crowd and (exhausted or few.log10_false_alarms <= 0):
            return few
    if degenerate(sets.bearings) or degenerate(sets.points3d):
        counts = f"{len(sets.bearings)} 2D and {len(sets.points3d)} 3D points"
        return no_pose(f"no pose fits: {counts}, too few or all on one line")
    scene = entered()
    lacking = (side for side in (scene.image, scene.seen) if not side.weights.all())
    if any(degenerate(side.points[side.weights > 0].astype(np.float64)) for side in lacking):
        return no_pose("no pose fits: too few points with a label of the other side, or all on one line")
    pool = Pool(scene, sets, few)
    if (safe := _from_batches(pool, around, tell)) is not None:
        return safe
    result = pool.result()
    # Where most batches end at one pose, and chance explains it for want of points, none is hidden beside it.
    ended_alike = len(pool.candidates) and pool.candidates.hits[0] > pool.batches / 2
    cones = sets.cones3d is not None and crowd  # few points were enumerated
    doubtful = result.log10_false_alarms > (0.0 if sets.prior is None else settings.evidence.false_alarms)
    if doubtful and (cones or not ended_alike) and not deadline.passed():
        asked = proposals if sets.prior is None and crowd else None
        if (safe := from_looks(pool, settings.anywhere if cones else (), asked)) is not None:
            return safe
        result = pool.result()
    result = beside_best(pool, result)
    if proposals is None or sets.prior is None or result.verdict == "confident" or deadline.passed():
        return result
    pool.merge(proposed(pool, proposals))
    return pool.result()


@one_blas_thread
def search_proposed(
    sets: PointSets, proposals: Proposals, *, clutter: float | None = None, seed: int = 0, deadline: Deadline = NEVER,
    settings: SearchSettings = DEFAULT,
) -> SearchResult:  # fmt: skip
    """The pose of many points that starts at proposed poses alone, such as those that a network finds likely, lead to.

    What `search_poses` does with proposals, without its own starts; the arguments are the same ones.
    """
    if degenerate(sets.bearings) or degenerate(sets.points3d):
        return no_pose("no pose fits: too few points, or all on one line")
    settings = settings if clutter is None else settings.expecting(clutter)
    pool = Pool(Scene(sets, seed, settings, deadline), sets, no_pose("no pose was proposed"))
    pool.batches = 1
    return from_looks(pool, (), proposals) or beside_best(pool, pool.result())


def _enumerated(
    sets: PointSets, entered: Callable[[], Scene], settings: SearchSettings, deadline: Deadline
) -> tuple[SearchResult, bool]:
    """The result of few points, and whether every hypothesis was tried."""
    found = search_few(sets, deadline, settings)
    few = judged(found.candidates, sets, batches=0, exhaustive=True, rule=settings.evidence)
    return against_repetitions(few, sets, entered, settings.evidence, exhaustive=True), found.exhausted


def _from_batches(pool: Pool, around: Prior | None, tell: Callable[[int], None]) -> SearchResult | None:
    """Batch after batch of starts until a pose is certain: its result; None where more of them would not help."""
    scene, sets, settings, rule = pool.scene, pool.sets, pool.scene.settings, pool.scene.settings.evidence
    guess, known = (None if prior is None else scene.enter_prior(prior) for prior in (around, sets.prior))
    near = isinstance(known, PosePrior) and is_near(scene, known)
    guesses = 0 if guess is None else settings.around
    best, searched, bettered = -math.inf, 0.0, 0.0  # starts in full batches: so far, when the best pose was bettered
    exhausted = False
    while searched < settings.max_batches and not (exhausted or scene.deadline.passed()):
        if pool.batches < guesses:
            found, _ = _batch(scene, pool.batches, guess, pool.candidates)
            found = replace(found, hits=np.zeros_like(found.hits))
        else:
            found, size = _batch(scene, pool.batches - guesses, known, pool.candidates)
            searched += size
        if near:
            found, _ = weighed_leaders(found, scene, sets)
        pool.merge(found)
        pool.batches += 1
        tell(pool.batches)
        if not len(pool.candidates):
            continue
        pool.new = bool(pool.candidates.score[0] >= best + rule.better)
        bettered = searched if pool.new else bettered
        best = float(pool.candidates.score[0])
        if pool.is_settled() and (safe := pool.certain(pool.leaders())) is not None:
            return safe
        pool.turned = pool.different([pool.turned, found])
        exhausted = is_exhausted(pool.candidates, scene, 0.0 if near else searched - bettered)
        if near and pool.batches >= ROUND * rule.hits and not (pool.candidates.log10_false_alarms < 0).any():
            # The prior may be wrong: what was found near it would only be in the way.
            known, near, best, searched, bettered = None, False, -math.inf, 0.0, 0.0
            pool.candidates = pool.turned = Candidates.none()
    return None


def _batch(scene: Scene, number: int, prior: Prior | None, best: Candidates) -> tuple[Candidates, float]:
    """One batch of starts, and its share of a full one.

    Every third one does not know the prior, which may be wrong. Of the others those around a rough pose are full, and
    looked up in a raster or annealed in turn, which finds other poses.
    """
    settings, coarse = scene.settings, scene.settings.coarse
    if prior is not None:
        number, kind = divmod(number, ROUND)
        if kind == 2:
            prior = None
        elif isinstance(prior, PosePrior) and is_near(scene, prior):
            if kind == 0:
                return nearby_batch(scene, prior), 1.0
            poses = drawn_around(scene, prior, settings.starts)
            return run_batch(scene, poses, cooled(coarse, prior, scene), best), 1.0
        else:
            number = 2 * number + kind
    recipe = settings.recipes[number % len(settings.recipes)]
    drawn = draw_poses(scene.spread, scene.bulk3d, settings.batch(number), recipe, prior, scene.rng)
    poses = Candidates.unscored(*drawn, hits=1)
    return run_batch(scene, poses, coarse, best), len(poses) / settings.starts
