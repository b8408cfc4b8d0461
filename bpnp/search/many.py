"""Pose from two unmatched point sets, without training: many starts, annealed; batch after batch until one is safe."""

import math
import time
from collections.abc import Callable
from dataclasses import replace

from bpnp.search.annealing import Deadline, finish, run_batch
from bpnp.search.candidates import Candidates, in_user_frame, merged
from bpnp.search.few.search import is_few, judged_few, search_few
from bpnp.search.nearby import cooled, nearby_batch
from bpnp.search.point_sets import PointSets
from bpnp.search.scene import Scene, degenerate
from bpnp.search.settings import DEFAULT, SearchSettings
from bpnp.search.starts import PosePrior, Prior
from bpnp.search.verdict import SearchResult, is_certain, is_exhausted, judged, no_pose, weighed

Progress = Callable[[int, float], None]  # batches so far, seconds
LEADERS = 3  # candidates that are weighed after a batch; all of them are in the end


def search_poses(
    sets: PointSets,
    *,
    around: Prior | None = None,
    clutter: float | None = None,
    seed: int = 0,
    deadline: Deadline | None = None,
    settings: SearchSettings = DEFAULT,
    progress: Progress | None = None,
) -> SearchResult:
    """Every distinct pose (R, t) found that explains the bearings f_i by the points p_j, in no known order.

    Maximises the likelihood of the bearings under the mixture
    p(f_i) = (1 - w)/n sum_j exp((f_i . g(R p_j + t) - 1)/s^2) / 2 pi s^2 + w/A, g(y) = y/|y|, over pose and scale s,
    A the solid angle of the view, by annealing s from starts over all rotations, or around `sets.prior`.

    Few points (`bpnp.search.few`) are enumerated first, and annealed only if that leaves a doubt.

    around: where to start instead, if that is no more than a guess from the same points. seed: of all that is random.
    clutter: share of the points without a partner to expect, from 0 to below 1; it is then the only one
        that is tried, which saves time at the end. None for that of the settings, and several at the end.
    deadline: after it no batch of starts begins, and one that has begun goes on with the poses it has; the result then
        depends on the machine. progress: called after each batch, and with 0 after the enumeration of few points.

    With fewer than 4 points of a side, or all bearings or all points on one line or in one place, there are no
    candidates. Raises ValueError for `clutter` out of range.
    """
    if clutter is not None and not 0 <= clutter < 1:
        raise ValueError(f"expected `clutter` in [0, 1), a share of the points, got {clutter}")
    start, end = time.monotonic(), deadline or Deadline()
    few = Candidates.none()
    if is_few(sets) and not end.passed():
        few, exhausted = search_few(sets, end, settings)
        result = judged_few(sets, few, settings)
        if progress is not None:
            progress(0, time.monotonic() - start)
        # More search helps only where no pose exceeds chance yet, and there are enough points to anneal.
        small = min(len(sets.bearings), len(sets.points3d)) < settings.least_annealed
        if exhausted or small or result.log10_false_alarms <= settings.evidence.false_alarms:
            return result
    if degenerate(sets.bearings) or degenerate(sets.points3d):
        counts = f"{len(sets.bearings)} 2D and {len(sets.points3d)} 3D points"
        return no_pose(f"no pose fits: {counts}, too few or all on one line")
    scene, prior = Scene(sets, seed, settings), around or sets.prior
    known = None if prior is None else scene.enter_prior(prior)
    share = settings.outliers if clutter is None else max(clutter, settings.least_outliers)
    candidates = Candidates.none()
    if len(few):
        rotation, translation = scene.enter(few.rotation, few.translation)
        candidates = replace(few, rotation=rotation, translation=translation)
    batches, stalled, best = 0, 0, -math.inf
    over = False
    while batches < settings.max_batches and not (over or end.passed()):
        found = _batch(scene, batches, known, candidates, share, end)
        candidates = merged([candidates, found], scene)
        batches += 1
        if len(candidates):
            stalled = stalled + 1 if candidates.score[0] < best + settings.evidence.better else 0
            best = float(candidates.score[0])
            leaders = weighed(in_user_frame(candidates[:LEADERS], scene), sets, settings.evidence)
            over = is_certain(leaders, sets, settings.evidence) or is_exhausted(candidates, scene, stalled)
        if progress is not None:
            progress(batches, time.monotonic() - start)
    if len(candidates):
        candidates = finish(scene, candidates, share, end, None if clutter is None else ())
    return judged(in_user_frame(candidates, scene), sets, batches=batches, rule=settings.evidence)


def _batch(
    scene: Scene, number: int, prior: Prior | None, best: Candidates, outliers: float, deadline: Deadline
) -> Candidates:
    """One batch of starts; of a rough pose every other one is looked up in a raster, which finds other poses."""
    recipes = scene.settings.recipes
    if not isinstance(prior, PosePrior) or prior.translation is None or not math.isfinite(prior.translation_sigma):
        return run_batch(scene, recipes[number % len(recipes)], prior, best, outliers, deadline)
    if number % 2 == 0:
        return nearby_batch(scene, prior, outliers, deadline)
    recipe = cooled(recipes[number // 2 % len(recipes)], prior, scene)
    return run_batch(scene, recipe, prior, best, outliers, deadline)
