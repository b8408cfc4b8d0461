"""Order in which a search draws initial poses, until a pose is confident or the budget is spent.

| best pose so far                | iterations                                                                 |
|---------------------------------|----------------------------------------------------------------------------|
| near a rough prior              | density-map search, then a batch of starts over all rotations              |
| not significant                 | a batch of starts over all rotations, and density-map searches over all    |
|                                 | rotations of equal duration; once the proposals of a network; after each,  |
|                                 | local searches around its likeliest poses                                  |
| significant, not yet confident  | batches and searches over all rotations, and local searches around it      |

Each iteration draws starts, preselects them, anneals the best, and yields distinct poses, which the pool merges.
"""

from collections.abc import Callable, Iterator
from itertools import count, islice

import numpy as np
from numpy.typing import NDArray

from bpnp.search.annealing import multistart
from bpnp.search.evidence.alternatives import far_missed, near_missed
from bpnp.search.hypotheses import Hypotheses, select_distinct, to_scene_frame
from bpnp.search.pool import Pool
from bpnp.search.raster_search import (
    admitted,
    is_near,
    raster_search,
    search_beside,
    search_everywhere,
    search_near,
)
from bpnp.search.starts import PosePrior, Prior
from bpnp.search.verdict import is_symmetric, starts_met

Proposals = Callable[[], tuple[NDArray[np.float64], NDArray[np.float64]]]  # rotations (s, 3, 3), translations (s, 3)


def turns(pool: Pool, around: Prior | None, proposals: Proposals | None) -> Iterator[Hypotheses]:
    """Yield the poses of one iteration after the other.

    The caller merges the poses of an iteration into the pool before it requests the next.

    Args:
        pool: Poses found so far.
        around: Guess of the pose in the frame of the problem, used before all other sources; None for none.
        proposals: Function that returns poses to start from; None for none.
    """
    scene, settings = pool.scene, pool.scene.settings
    guess, known = (None if prior is None else scene.enter_prior(prior) for prior in (around, pool.problem.prior))
    if guess is not None:
        for number in range(settings.schedule.around):
            yield multistart(scene, number, guess).as_dependent()
    if isinstance(known, PosePrior) and is_near(scene, known):
        near = _near(pool, known, proposals)
        yield from islice(near, settings.schedule.near)
        while pool.alarms < 0:
            yield from _sure(pool, near)
        # The prior may be wrong: poses found near it would only displace others.
        pool.forget()
        known = None
    yield from _anywhere(pool, known, proposals)


def _near(pool: Pool, known: PosePrior, proposals: Proposals | None) -> Iterator[Hypotheses]:
    """Yield poses near a prior, alternating with batches over all rotations, and proposals once."""
    scene = pool.scene
    for number in count():
        yield search_near(scene, known)
        yield multistart(scene, number, None)
        if number == 1 and proposals is not None and pool.alarms > scene.settings.evidence.false_alarms:
            yield proposed(pool, proposals)


def _anywhere(pool: Pool, known: Prior | None, proposals: Proposals | None) -> Iterator[Hypotheses]:
    """Yield poses from all rotations or a wide prior, with local searches and proposals, without end."""
    drawn = _drawn(pool, known)
    yield next(drawn)
    for number in count():
        if pool.alarms < 0:
            yield from _sure(pool, drawn)
            continue
        yield from _with_surroundings(pool, next(drawn))
        if pool.alarms > 0 and proposals is not None and number >= pool.scene.settings.schedule.unaided:
            yield from _with_surroundings(pool, proposed(pool, proposals))
            proposals = None


def _sure(pool: Pool, drawn: Iterator[Hypotheses]) -> Iterator[Hypotheses]:
    """Run the step that reduces the larger miss probability.

    The step is a local search around the best pose, or the next source of starts.
    """
    leaders, settings = pool.leaders(), pool.scene.settings
    looks, rule = pool.looks(leaders), settings.evidence
    symmetric = bool(pool.problem.registered) and is_symmetric(leaders, pool.problem, rule)
    basin_count = starts_met(leaders, pool.problem, rule, symmetric=symmetric)
    far = far_missed(basin_count, rule, symmetric=symmetric)
    if looks < settings.schedule.looks and near_missed(basin_count, looks, rule) > far:
        yield _look(pool)
    else:
        yield next(drawn)


def _look(pool: Pool) -> Hypotheses:
    """Run a local search around the best pose."""
    leader = to_scene_frame(pool.leaders()[:1], pool.scene)
    pool.look_around(leader)
    return search_beside(pool.scene, leader, pool.scene.settings.beside)


def _drawn(pool: Pool, known: Prior | None) -> Iterator[Hypotheses]:
    """Yield poses of batches of starts and of density-map searches over all rotations that take as long.

    Every third batch ignores the prior, which may be wrong.
    """
    scene, searches = pool.scene, count()
    for number in count():
        yield multistart(scene, number, None if number % 3 == 2 else known)
        for _ in range(scene.settings.batch(number) // scene.settings.schedule.starts_a_search):
            yield search_everywhere(scene, next(searches), known)


def _with_surroundings(pool: Pool, found: Hypotheses) -> Iterator[Hypotheses]:
    """Yield poses, then local searches around the best of different rotations.

    Poses whose surroundings were searched before are skipped. The searches end after several without a better pose, or
    with a significant pose.
    """
    yield found
    settings, since = pool.scene.settings, 0
    poses = select_distinct(found, pool.scene, settings.schedule.around_each, settings.schedule.apart_deg)
    for k in range(len(poses)):
        if since == settings.schedule.in_vain or pool.alarms < 0:
            break
        if not pool.is_searched(poses[k : k + 1]):
            best = pool.candidates.sort_key.max(initial=-np.inf)
            pool.searched.append(poses[k : k + 1])
            yield search_beside(pool.scene, poses[k : k + 1], settings.beside)
            since = 0 if pool.candidates.sort_key.max(initial=-np.inf) > best else since + 1


def proposed(pool: Pool, proposals: Proposals) -> Hypotheses:
    """Run a density-map search from proposed poses that the prior of the problem admits.

    Args:
        pool: Poses found so far.
        proposals: Function that returns poses in the frame of the problem.

    Returns:
        Distinct poses in the frame of the scene. Their basin counts are 0, since proposals are dependent.
    """
    poses = admitted(pool.scene, Hypotheses.from_poses(*pool.scene.enter(*proposals())), pool.problem.prior)
    return raster_search(pool.scene, poses, pool.scene.settings.proposed)


def only_proposed(pool: Pool, proposals: Proposals) -> Iterator[Hypotheses]:
    """Yield proposed poses and local searches around them, and no other starts."""
    yield from _with_surroundings(pool, proposed(pool, proposals))
    while pool.alarms < 0 and pool.looks(pool.leaders()) < pool.scene.settings.schedule.looks:
        yield _look(pool)
