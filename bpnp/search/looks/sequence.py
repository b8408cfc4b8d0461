"""Which looks a search takes, one after the other, and when one of them has found a pose that is certain."""

from collections.abc import Callable, Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from bpnp.search.candidates import Candidates
from bpnp.search.looks.anywhere import anywhere
from bpnp.search.looks.nearby import admitted, beside, likeliest
from bpnp.search.pool import Pool
from bpnp.search.settings import Nearby
from bpnp.search.verdict import SearchResult

Proposals = Callable[[], tuple[NDArray[np.float64], NDArray[np.float64]]]  # rotations (s, 3, 3), translations (s, 3)


def from_looks(pool: Pool, anywhere_rules: Sequence[Nearby], proposals: Proposals | None) -> SearchResult | None:
    """Look after look for poses that clusters hide, until one is certain: its result.

    A pose that exceeds chance by more than those before is annealed on all points at once: more of them match then.
    """
    exceeded = 0.0
    for found in _looks(pool, anywhere_rules, proposals):
        pool.merge(found)
        leaders = pool.leaders()
        if (safe := pool.certain(leaders)) is not None:
            return safe
        if len(leaders) and leaders.log10_false_alarms[0] < exceeded - pool.scene.settings.evidence.lead:
            exceeded, result = leaders.log10_false_alarms[0], pool.result()
            if result.verdict == "confident":
                return result
        if pool.scene.deadline.passed():
            break
    return None


def _looks(pool: Pool, anywhere_rules: Sequence[Nearby], proposals: Proposals | None) -> Iterator[Candidates]:
    """Around the likeliest poses of different rotations, from within the cones of the points, from those proposed."""
    yield from _around_each(pool, pool.turned)
    for rule in anywhere_rules:
        yield (found := anywhere(pool.scene, rule))
        yield from _around_each(pool, pool.different([found]))
    if proposals is not None:
        yield (found := proposed(pool, proposals))
        yield from _around_each(pool, pool.different([found]))


def _around_each(pool: Pool, poses: Candidates) -> Iterator[Candidates]:
    settings, since = pool.scene.settings, 0  # looks since the best pose was bettered
    for k in range(len(poses)):
        if since == settings.beside_patience:
            break
        best = pool.candidates.preference.max()
        yield beside(pool.scene, poses[k : k + 1], settings.beside)
        since = 0 if pool.candidates.preference.max() > best else since + 1


def beside_best(pool: Pool, result: SearchResult) -> SearchResult:
    """Looks beside a pose that exceeds chance but leaves a doubt, an optimum beside a better one, while they help."""
    scene = pool.scene
    while result.verdict != "confident" and result.log10_false_alarms <= 0 and not scene.deadline.passed():
        best = Candidates.unscored(*scene.enter(*(values[None] for values in result.best)))
        pool.merge(beside(scene, best, scene.settings.beside))
        better = pool.result()
        lead = scene.settings.evidence.lead
        if better.verdict != "confident" and better.log10_false_alarms > result.log10_false_alarms - lead:
            break
        result = better
    return result


def proposed(pool: Pool, proposals: Proposals) -> Candidates:
    """Distinct poses from those proposed, in the user's coordinates, that a prior of the user admits."""
    poses = admitted(pool.scene, Candidates.unscored(*pool.scene.enter(*proposals())), pool.sets.prior)
    return likeliest(pool.scene, poses, pool.scene.settings.proposed)
