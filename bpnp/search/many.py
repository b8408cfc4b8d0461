"""Pose from two unmatched point sets, without training: many starts, annealed; batch after batch until one is safe."""

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache

import numpy as np
from numpy.typing import NDArray

from bpnp.compilation import NEVER, Deadline
from bpnp.search.annealing import finish, run_batch
from bpnp.search.anywhere import anywhere
from bpnp.search.candidates import Candidates, best_distinct, in_user_frame, merged
from bpnp.search.evidence.repetitions import decades_behind, repeated_poses
from bpnp.search.few.search import is_few, search_few
from bpnp.search.nearby import beside, cooled, drawn_around, is_near, likeliest, nearby_batch
from bpnp.search.point_sets import PointSets
from bpnp.search.scene import Scene, degenerate
from bpnp.search.settings import DEFAULT, Evidence, SearchSettings
from bpnp.search.starts import PosePrior, Prior, draw_poses
from bpnp.search.verdict import (
    SearchResult,
    is_certain,
    is_exhausted,
    is_unique,
    judged,
    no_pose,
    weighed_leaders,
    with_false_alarms,
)

ROUND = 3  # batches with a prior, of which the last is without
Progress = Callable[[int, float], None]  # batches so far, seconds
Proposals = Callable[[], tuple[NDArray[np.float64], NDArray[np.float64]]]  # rotations (s, 3, 3), translations (s, 3)


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

    Few points (`bpnp.search.few`) are enumerated first, and annealed only if that leaves a doubt.

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
    start, rule, few = time.monotonic(), settings.evidence, no_pose("no pose was found")

    @cache
    def entered() -> Scene:
        return Scene(sets, seed, settings, deadline)

    # With a prior more points are enumerated, whose noise may exceed what the enumeration allows: it may miss a pose.
    crowd = not is_few(replace(sets, prior=None))
    if is_few(sets) and not deadline.passed():
        found, exhausted = search_few(sets, deadline, settings)
        few = judged(found, sets, batches=0, exhaustive=True, rule=rule)
        few = _against_repetitions(few, sets, entered, rule, exhaustive=True)
        if progress is not None:
            progress(0, time.monotonic() - start)
        # More search helps only where no pose exceeds chance yet, and there are enough points to anneal.
        small = min(len(sets.bearings), len(sets.points3d)) < settings.least_annealed
        if few.verdict == "confident" or small or not crowd and (exhausted or few.log10_false_alarms <= 0):
            return few
    if degenerate(sets.bearings) or degenerate(sets.points3d):
        counts = f"{len(sets.bearings)} 2D and {len(sets.points3d)} 3D points"
        return no_pose(f"no pose fits: {counts}, too few or all on one line")
    scene = entered()
    guess, known = (None if prior is None else scene.enter_prior(prior) for prior in (around, sets.prior))
    candidates = turned = Candidates.none()  # turned: the likeliest ones of different rotations
    if len(few.candidates):
        rotation, translation = scene.enter(few.candidates.rotation, few.candidates.translation)
        candidates = replace(few.candidates, rotation=rotation, translation=translation)
    batches, best = 0, -math.inf
    near = isinstance(known, PosePrior) and is_near(scene, known)
    cones = sets.cones3d is not None and crowd  # few points were enumerated
    searched, bettered = 0.0, 0.0  # starts in full batches: so far, and when the best pose was bettered last

    def finished(poses: Candidates, annealed: int) -> SearchResult:
        ends = finish(scene, poses, annealed) if len(poses) else poses
        if sets.prior is not None and len(ends):  # of a pose before and after, that which chance explains less
            ends, _ = weighed_leaders(ends, scene, sets)
            ends = best_distinct(Candidates.concatenated([ends, poses]), scene, settings.kept)
        result = judged(in_user_frame(ends, scene), sets, batches=batches, rule=rule)
        if few.log10_false_alarms < result.log10_false_alarms:
            return replace(few, batches=batches)
        return _against_repetitions(result, sets, entered, rule)

    def certain(leaders: Candidates) -> SearchResult | None:
        """The result, if it holds on all bearings too."""
        if not is_certain(leaders, sets, rule, batches=batches):
            return None
        result = finished(candidates[np.isfinite(candidates.log10_false_alarms)], 1)
        return result if result.verdict == "confident" else None

    def different(parts: list[Candidates]) -> Candidates:
        together = Candidates.concatenated(parts)
        return best_distinct(together, scene, settings.beside_poses, degrees=settings.beside_deg, shift=math.inf)

    def looks() -> Iterator[Candidates]:
        """Poses that clusters hide, look after look."""
        yield from around_each(turned)
        for rule in settings.anywhere if cones else ():
            yield (found := anywhere(scene, rule))
            yield from around_each(different([found]))
        if proposals is not None and sets.prior is None and crowd:
            yield (found := proposed(proposals))
            yield from around_each(different([found]))

    def proposed(by: Proposals) -> Candidates:
        return likeliest(scene, Candidates.unscored(*scene.enter(*by())), settings.nearby)

    def around_each(poses: Candidates) -> Iterator[Candidates]:
        since = 0  # looks since the best pose was bettered
        for k in range(len(poses)):
            if since == settings.beside_patience:
                break
            best = candidates.preference.max()
            yield beside(scene, poses[k : k + 1], settings.beside)
            since = 0 if candidates.preference.max() > best else since + 1

    exhausted = False
    while searched < settings.max_batches and not (exhausted or deadline.passed()):
        if guess is not None and batches < settings.around:
            found, _ = _batch(scene, batches, guess, candidates)
            found = replace(found, hits=np.zeros_like(found.hits))
        else:
            found, size = _batch(scene, batches - (0 if guess is None else settings.around), known, candidates)
            searched += size
        if near:
            found, _ = weighed_leaders(found, scene, sets)
        candidates = merged([candidates, found], scene)
        batches += 1
        if progress is not None:
            progress(batches, time.monotonic() - start)
        if not len(candidates):
            continue
        stalled = candidates.score[0] < best + rule.better
        bettered = bettered if stalled else searched
        best = float(candidates.score[0])
        candidates, leaders = weighed_leaders(candidates, scene, sets)
        # A pose that was just found may be an optimum beside a better one, which starts around it will find.
        settled = stalled or is_unique(leaders, sets, rule)
        if settled and (safe := certain(leaders)) is not None:
            return safe
        turned = different([turned, found])
        exhausted = is_exhausted(candidates, scene, 0.0 if near else searched - bettered)
        if near and batches >= ROUND * rule.hits and not (candidates.log10_false_alarms < 0).any():
            # The prior may be wrong: what was found near it would only be in the way.
            known, near, best, searched, bettered = None, False, -math.inf, 0.0, 0.0
            candidates = turned = Candidates.none()
    result = finished(candidates, settings.finished)
    # Where most batches end at one pose, and chance explains it for want of points, none is hidden beside it.
    ended_alike = len(candidates) and candidates.hits[0] > batches / 2
    doubtful = result.log10_false_alarms > (0.0 if sets.prior is None else rule.false_alarms)
    if doubtful and (cones or not ended_alike) and not deadline.passed():
        for found in looks():
            candidates = merged([candidates, found], scene)
            candidates, leaders = weighed_leaders(candidates, scene, sets)
            if (safe := certain(leaders)) is not None:
                return safe
            if deadline.passed():
                break
        result = finished(candidates, settings.finished)
    while result.verdict != "confident" and result.log10_false_alarms <= 0 and not deadline.passed():
        best_pose = Candidates.unscored(*scene.enter(*(values[None] for values in result.best)))
        candidates = merged([candidates, beside(scene, best_pose, settings.beside)], scene)
        better = finished(candidates, settings.finished)
        if better.verdict != "confident" and better.log10_false_alarms > result.log10_false_alarms - rule.lead:
            break
        result = better
    if proposals is None or sets.prior is None or result.verdict == "confident" or deadline.passed():
        return result
    return finished(merged([candidates, proposed(proposals)], scene), settings.finished)


def _against_repetitions(
    result: SearchResult, sets: PointSets, entered: Callable[[], Scene], rule: Evidence, *, exhaustive: bool = False
) -> SearchResult:
    """A confident result once more, beside the poses that a repeated structure would confuse with it; if one of these
    is better, so is that one."""
    if result.verdict != "confident":
        return result
    best, scale = result.best, max(result.residual, sets.image.scales[0])
    repeated, compared = repeated_poses(sets, *best, scale, rule)
    if not len(repeated[0]):
        return result
    scene = entered()
    starts = Candidates.unscored(*scene.enter(*repeated))
    starts = replace(starts, scale=np.full(len(starts), scale, np.float32))
    ends = finish(scene, starts)  # none after the deadline
    rivals = with_false_alarms(in_user_frame(ends if len(ends) else starts, scene), sets)
    behind = decades_behind(sets, best, repeated, (rivals.rotation, rivals.translation), scale)
    behind = np.maximum(behind, 0) if compared else np.zeros(len(rivals))
    alarms = np.minimum(rivals.log10_false_alarms, result.log10_false_alarms + behind)
    candidates = Candidates.concatenated([result.candidates, replace(rivals, log10_false_alarms=alarms)])
    beside = judged(candidates, sets, batches=result.batches, exhaustive=exhaustive, rule=rule)
    if np.array_equal(beside.best[1], best[1]):
        return beside
    return _against_repetitions(beside, sets, entered, rule, exhaustive=exhaustive)


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
