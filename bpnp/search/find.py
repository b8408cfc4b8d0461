"""Search for poses from two unmatched point sets, without training.

`search_poses` searches over all poses, or from proposed poses only; `warm_up` compiles the loops in advance.
"""

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bpnp.runtime import NEVER, Deadline, one_blas_thread
from bpnp.search.few_points.enumeration import enumerate_poses, exceeds_enumeration, is_enumerable
from bpnp.search.few_points.steps import EnumeratedPoses, EnumerationPlan
from bpnp.search.hypotheses import Hypotheses
from bpnp.search.loop import Progress, run, teller
from bpnp.search.pool import Pool
from bpnp.search.problem import Problem
from bpnp.search.propose.density_map import LOCAL, preselect
from bpnp.search.propose.known_matches import known_matches, poses_of_matches
from bpnp.search.propose.minimal_solvers import p3p_poses
from bpnp.search.propose.symmetries import self_motions
from bpnp.search.refine.annealing import run_batch
from bpnp.search.schedule import Plan, Proposals
from bpnp.search.search_frame import SearchFrame, degenerate
from bpnp.search.settings import DEFAULT, SearchSettings
from bpnp.search.starts import Prior
from bpnp.search.verdict.competitors import WIDER_RADIUS
from bpnp.search.verdict.contest import contest, rivals_of
from bpnp.search.verdict.decide import Case, SearchResult, decide, fits_by_chance
from bpnp.search.verdict.reasons import objection
from bpnp.search.verdict.rivals import SceneOf

# Clusters keep every one of so small a set, and further iterations end at the same poses.
ENUMERATED_ITERATIONS = 12  # iterations, at most, for points few enough to be enumerated [iterations; calibration]
# Fewer points have no smooth optimum and are only enumerated.
LEAST_ANNEALED = 12  # least number of points of the smaller set for annealing [points; calibration]
WARMING_POINTS = 8  # number of points of the problem that compiles the loops [points; convention]


def search_poses(problem: Problem, **options: Any) -> SearchResult:
    """Search for the pose of a problem, and decide; options as for `find_case`."""
    return decide(find_case(problem, **options))


@one_blas_thread
def find_case(
    problem: Problem,
    *,
    around: Prior | None = None,
    proposals: Proposals | None = None,
    only_proposals: bool = False,
    clutter: float | None = None,
    seed: int = 0,
    deadline: Deadline = NEVER,
    settings: SearchSettings = DEFAULT,
    progress: Progress | None = None,
) -> Case:
    """Search for distinct poses (R, t) that explain the bearings f_i by the points p_j, in no known order.

    The search maximises the likelihood of the bearings under the mixture
    p(f_i) = (1 - w)/n sum_j exp((f_i . g(R p_j + t) - 1)/s^2) / 2 pi s^2 + w/A, g(y) = y/|y|, over pose and scale s,
    A the solid angle of the view, by annealing s from starts over all rotations, or around `problem.prior`.

    Few points (`bpnp.search.few_points`) are enumerated first, and annealed only if the result is not conclusive.
    There are no candidates with fewer than 4 points of a side, or if all bearings or all points coincide or lie on one
    line.

    The first `GUESSED_BATCHES` batches start `around` a guess from the same points, such as that of a network; their
    basin counts are 0, since they are dependent. Those of `proposals`, such as the likeliest poses of a network, are 0
    too. They are called once, after `UNAIDED_ROUNDS` rounds without a significant pose (near a prior after two), and
    only with too many points to enumerate; with `only_proposals`, known matches, the enumeration and the guess are not
    used. `clutter` is the expected outlier fraction, in [0, 1) (`SearchSettings.expecting`). After the deadline no
    batch begins; a running batch continues with the poses that it has, and the result depends on the machine.
    `progress` gets the numbers of batches and of seconds after each batch, and 0 batches after the enumeration of few
    points.
    """
    if clutter is not None:
        settings, problem = settings.expecting(clutter), replace(problem, clutter=clutter)
    tell, enumerated = teller(progress), Case.without_pose(problem)

    @cache
    def scene_of() -> SearchFrame:
        return SearchFrame(problem, seed, settings, deadline)

    many = exceeds_enumeration(problem)
    matches = None if only_proposals else known_matches(problem)
    known = None if matches is None else _of_known_matches(problem, *matches, scene_of, seed, deadline)
    if known is not None and (problem.prior is None or not is_enumerable(problem) or known.objection is None):
        return known
    if not many:
        settings = settings.limited(min(settings.iterations, ENUMERATED_ITERATIONS))
    if not only_proposals and is_enumerable(problem) and not deadline.passed():
        poses = EnumeratedPoses(problem, scene_of, deadline)
        enumerated = run(EnumerationPlan(poses, deadline), poses, most=1, deadline=NEVER)
        if enumerated.is_rough and problem.radius is None:
            wide = replace(problem, radius=WIDER_RADIUS * problem.match_radius)
            wider = EnumeratedPoses(wide, scene_of, deadline)
            again = run(EnumerationPlan(wider, deadline), wider, most=1, deadline=NEVER)
            if again.log10_false_alarms < enumerated.log10_false_alarms:
                poses, enumerated = wider, again
        by_chance = fits_by_chance(enumerated.log10_false_alarms)
        if known is not None and by_chance:  # residuals may exceed its match radius
            return known
        tell(0)
        # More search helps only if no pose is significant yet, and there are enough points to anneal.
        small = min(len(problem.bearings), len(problem.points3d)) < LEAST_ANNEALED
        settled = poses.is_exhausted or not by_chance
        if enumerated.objection is None or small or (settled and not many):
            return enumerated
    if degenerate(problem.bearings) or degenerate(problem.points3d):
        counts = f"{len(problem.bearings)} 2D and {len(problem.points3d)} 3D points"
        return fixing_no_pose(problem, f"{counts}, too few or all on one line")
    scene = scene_of()
    if lacks_partners(scene):
        return fixing_no_pose(problem, "too few points with a label of the other side, or all on one line")
    pool = Pool(scene, problem, enumerated)
    is_asked = many or only_proposals
    plan = Plan.of(pool, around, proposals if is_asked else None, only_proposals=only_proposals)
    return run(plan, pool, most=settings.iterations, deadline=deadline, tell=tell)


def _of_known_matches(
    problem: Problem,
    i: NDArray[np.int64],
    j: NDArray[np.int64],
    scene_of: SceneOf,
    seed: int,
    deadline: Deadline,
) -> Case:
    """Return the case of the poses that known matches, indices (k,) of image and of scene points, fit best."""
    poses = poses_of_matches(problem, i, j, seed)
    case = Case.of(poses, problem, exhaustive=True, is_fitted=True)
    return contest(case, rivals_of(scene_of, deadline))


def fixing_no_pose(problem: Problem, why: str) -> Case:
    """Return a case without a pose, since the points fix none."""
    return Case.without_pose(problem, objection("degenerate", why=f"no pose fits: {why}"), exhaustive=True)


def lacks_partners(scene: SearchFrame) -> bool:
    """Return True if the points whose label occurs on the other side are too few or all on one line."""
    lacking = (side for side in (scene.image, scene.seen) if not side.weights.all())
    return any(degenerate(side.points[side.weights > 0].astype(np.float64)) for side in lacking)


@one_blas_thread
def warm_up() -> None:
    """Compile the loops of the search; this takes some seconds, or none if they were compiled before.

    A tracker calls it before its first frame, since loops cached on disk are still loaded at their first call.
    """
    points = np.random.default_rng(0).uniform(-1, 1, (WARMING_POINTS, 3))
    rays = points + (0, 0, 6)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    problem = Problem(rays, points)
    enumerate_poses(problem)
    p3p_poses(rays[None, :3], points[None, :3])
    self_motions(points, 0.1)
    scene = SearchFrame(problem, 0, DEFAULT)
    start = Hypotheses.from_poses(*scene.enter(np.eye(3)[None], np.array([[0, 0, 6.0]])))
    run_batch(scene, start)
    local_searches = LOCAL.density_map, LOCAL.narrowing.first_scale
    preselect(scene, start, *local_searches, WARMING_POINTS, 1)
