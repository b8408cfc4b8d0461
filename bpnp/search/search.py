"""Poses from two unmatched point sets, without training: searched everywhere, turn after turn until one is certain, or
from proposed poses; refined from given ones; and every loop of it compiled beforehand."""

import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from bpnp.loops.parallel import NEVER, Deadline, one_blas_thread
from bpnp.search.annealing import anneal_on_clusters, anneal_on_points, finish, run_batch
from bpnp.search.enumeration.search import exceeds_enumeration, is_enumerable, search_by_enumeration
from bpnp.search.evidence.rivals import against_rivals
from bpnp.search.hypotheses import Hypotheses, merge_hypotheses, to_problem_frame
from bpnp.search.infinity.kernels import Image
from bpnp.search.infinity.search import search_rotation
from bpnp.search.kernels.sides import FORWARD
from bpnp.search.pool import Pool
from bpnp.search.problem import Problem
from bpnp.search.propose.known_matches import known_matches, poses_of_matches
from bpnp.search.propose.minimal_solvers import p3p_poses
from bpnp.search.propose.symmetries import self_motions
from bpnp.search.raster_search import around_each, looked_up
from bpnp.search.scene import Scene, degenerate
from bpnp.search.schedule import Proposals, only_proposed, turns
from bpnp.search.settings import DEFAULT, SearchSettings
from bpnp.search.starts import Prior
from bpnp.search.verdict import REFINED, SearchResult, judged, no_pose

Progress = Callable[[int, float], None]  # batches so far, seconds
WARMING = 8  # points of the problem that compiles the loops


@one_blas_thread
def search_poses(
    problem: Problem,
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
    A the solid angle of the view, by annealing s from starts over all rotations, or around `problem.prior`.

    Few points (`bpnp.search.enumeration`) are enumerated first, and annealed only if that leaves a doubt.

    around: a guess from the same points, such as a network's pose: the first `Schedule.around` batches start there, and
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
    if clutter is not None:
        settings, problem = settings.expecting(clutter), replace(problem, clutter=clutter)
    start, enumerated = time.monotonic(), no_pose("no pose was found")

    def tell(batches: int) -> None:
        if progress is not None:
            progress(batches, time.monotonic() - start)

    @cache
    def entered() -> Scene:
        return Scene(problem, seed, settings, deadline)

    many = exceeds_enumeration(problem)
    matches = known_matches(problem)
    if matches is not None and (problem.prior is None or not is_enumerable(problem)):
        return _of_known_matches(problem, *matches, entered, seed, settings)
    if not many:
        settings = settings.limited(min(settings.schedule.turns, settings.schedule.enumerated))
    if is_enumerable(problem) and not deadline.passed():
        found, exhaustive = search_by_enumeration(problem, deadline, settings)
        rule = settings.evidence
        enumerated = judged(found, problem, batches=0, looks=REFINED, exhaustive=exhaustive, rule=rule)
        enumerated = against_rivals(
            enumerated, problem, entered, rule, looks=REFINED, exhaustive=exhaustive, contested=True
        )
        if matches is not None and enumerated.log10_false_alarms > 0:  # their residuals may exceed its radius
            return _of_known_matches(problem, *matches, entered, seed, settings)
        tell(0)
        # More search helps only where no pose exceeds chance yet, and there are enough points to anneal.
        small = min(len(problem.bearings), len(problem.points3d)) < settings.least_annealed
        settled = exhaustive or enumerated.log10_false_alarms <= 0
        if enumerated.verdict == "confident" or small or (settled and not many):
            return enumerated
    if degenerate(problem.bearings) or degenerate(problem.points3d):
        counts = f"{len(problem.bearings)} 2D and {len(problem.points3d)} 3D points"
        return no_pose(f"no pose fits: {counts}, too few or all on one line")
    scene = entered()
    if lacks_partners(scene):
        return no_pose("no pose fits: too few points with a label of the other side, or all on one line")
    pool = Pool(scene, problem, enumerated)
    return _until_certain(pool, turns(pool, around, proposals if many else None), tell)


def _of_known_matches(
    problem: Problem,
    i: NDArray[np.int64],
    j: NDArray[np.int64],
    entered: Callable[[], Scene],
    seed: int,
    settings: SearchSettings,
) -> SearchResult:
    """Judge the poses that known matches, indices (k,) of image points and of scene points, fit best."""
    found, rule = poses_of_matches(problem, i, j, seed), settings.evidence
    result = judged(found, problem, batches=0, exhaustive=True, rule=rule)
    return against_rivals(result, problem, entered, rule, exhaustive=True)


def lacks_partners(scene: Scene) -> bool:
    """Whether the points with a label of the other side are too few, or all on one line."""
    lacking = (side for side in (scene.image, scene.seen) if not side.weights.all())
    return any(degenerate(side.points[side.weights > 0].astype(np.float64)) for side in lacking)


def _until_certain(
    pool: Pool, turns: Iterator[Hypotheses], tell: Callable[[int], None] = lambda turns: None
) -> SearchResult:
    """Turn after turn until the verdict is settled or the budget is spent."""
    settings, finished = pool.scene.settings, 0.0
    thinned = len(pool.problem.bearings) > settings.fine.bearings
    while pool.turns < settings.schedule.turns and not pool.scene.deadline.passed():
        found = next(turns, None)
        if found is None:
            break
        pool.turns += 1
        pool.merge(found)
        tell(pool.turns)
        bettered = thinned and pool.alarms < finished - settings.evidence.lead  # on all points more of them match
        if bettered or pool.missed <= settings.evidence.missed:
            finished, result = min(finished, pool.alarms), pool.result(1)
            if result.verdict == "confident" or result.settled:
                return result
    return pool.result()


@one_blas_thread
def search_proposed(
    problem: Problem,
    proposals: Proposals,
    *,
    clutter: float | None = None,
    seed: int = 0,
    deadline: Deadline = NEVER,
    settings: SearchSettings = DEFAULT,
) -> SearchResult:
    """The pose of many points that starts at proposed poses alone, such as those that a network finds likely, lead to.

    What `search_poses` does with proposals, without its own starts; the arguments are the same ones.
    """
    if degenerate(problem.bearings) or degenerate(problem.points3d):
        return no_pose("no pose fits: too few points, or all on one line")
    if clutter is not None:
        settings, problem = settings.expecting(clutter), replace(problem, clutter=clutter)
    pool = Pool(Scene(problem, seed, settings, deadline), problem, no_pose("no pose was proposed"))
    return _until_certain(pool, only_proposed(pool, proposals))


@one_blas_thread
def refine_poses(problem: Problem, rotation: NDArray[np.float64], translation: NDArray[np.float64]) -> SearchResult:
    """The likeliest poses that annealing reaches from given ones and from poses around them.

    The objective is that of `search_poses`. A start may be some 10 degrees off, and more where there are many: those
    beyond `refined_directly` are first annealed on clusters, as the search does, and the likeliest go on.

    rotation (s, 3, 3), translation (s, 3): the starts; those with NaN are missing.

    `batches` of the result is the number of starts that were annealed. Without a start, or with points that fix no
    pose, there are no candidates.
    """
    settings, scene = DEFAULT, Scene(problem, 0, DEFAULT)
    starts = _entered(scene, rotation, translation)
    if not len(starts) or degenerate(problem.bearings) or degenerate(problem.points3d):
        return no_pose("no start, or points that fix no pose")
    crowd = len(starts)
    if crowd > settings.refined_directly:
        starts = anneal_on_clusters(scene, starts, (*settings.coarse, *settings.middle), settings.starts)
    around = Hypotheses.concatenate([starts, around_each(scene, starts[: settings.copied])])
    first_scale = settings.middle[-1].last_scale * scene.spread
    clustered = anneal_on_clusters(scene, around, settings.middle, settings.starts)
    clustered = anneal_on_points(scene, clustered, first_scale)
    # A start that is right already needs no clusters, which would only shake it.
    direct = anneal_on_points(scene, starts, first_scale)
    poses = finish(scene, merge_hypotheses([clustered, direct], scene))
    annealed = crowd + len(around) - len(starts)
    return judged(to_problem_frame(poses, scene), problem, batches=annealed, rule=settings.evidence)


@one_blas_thread
def score_poses(
    problem: Problem, rotation: NDArray[np.float64], translation: NDArray[np.float64], deadline: Deadline
) -> SearchResult:
    """Poses (c, 3, 3), (c, 3) annealed a little and scored as those of a search; NaN for a missing one.

    Their residuals are taken to be the median distance of a point to the nearest bearing. Their basin counts are 0,
    since no other starts were tried: only overwhelming evidence makes the best of them certain.
    """
    scene = Scene(problem, 0, DEFAULT, deadline)
    starts = _entered(scene, rotation, translation)
    if not len(starts):
        return no_pose("the module found no pose")
    camera = scene.points3d @ starts.rotation.transpose(0, 2, 1) + starts.translation[:, None]
    length = np.maximum(np.linalg.norm(camera, axis=-1, keepdims=True), 1e-12)
    distance, _ = cKDTree(scene.offsets + FORWARD).query(camera / length)
    scale = np.asarray(np.maximum(np.median(distance, -1), scene.smallest_scale), np.float32)
    poses = finish(scene, replace(starts, scale=scale))
    return judged(to_problem_frame(poses, scene), problem, batches=len(starts))


def _entered(scene: Scene, rotation: NDArray[np.float64], translation: NDArray[np.float64]) -> Hypotheses:
    """Return the poses of a problem that are not missing, in the frame of a scene."""
    known = np.isfinite(rotation).all((-2, -1)) & np.isfinite(translation).all(-1)
    return Hypotheses.from_poses(*scene.enter(rotation[known], translation[known]))


@one_blas_thread
def warm_up() -> None:
    """Compile the loops of the search, for some seconds; at once where they were compiled before.

    A tracker calls it before its first frame: what is kept on disk still has to be read, at the first call of each.
    """
    points = np.random.default_rng(0).uniform(-1, 1, (WARMING, 3))
    rays = points + (0, 0, 6)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    problem = Problem(rays, points)
    search_by_enumeration(problem, NEVER, DEFAULT)
    p3p_poses(rays[None, :3], points[None, :3])
    self_motions(points, 0.1)
    search_rotation(Image(rays, np.full(WARMING, 1e-3)), rays)
    scene = Scene(problem, 0, DEFAULT)
    start = Hypotheses.from_poses(*scene.enter(np.eye(3)[None], np.array([[0, 0, 6.0]])))
    run_batch(scene, start)
    looks = DEFAULT.beside.raster, DEFAULT.beside.narrowing.first_scale
    looked_up(scene, start, *looks, WARMING, 1)
