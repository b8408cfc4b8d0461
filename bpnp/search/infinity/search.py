"""The rotation of a camera that sees directions, of which nobody knows which is which.

Two matches fix it: each pair of image points is compared with all pairs of directions at the same angle. A rotation has
to explain the image points around the pair, and the best are fitted to all points; what is left is weighed.

Of an alternative that could contest the best rotation it is known how many points it explains at least, and every pair
of them gives it: that none was met bounds the probability that there is one.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.special import betaln

from bpnp.loops.parallel import NEVER, Deadline
from bpnp.search.evidence.alternatives import number
from bpnp.search.infinity.catalogue import Catalogue, catalogue_of
from bpnp.search.infinity.evidence import FIXING, Background, background_of, how_well_known, log10_false_alarms
from bpnp.search.infinity.kernels import Fit, Image, Patch, Sky, fit, propose
from bpnp.search.infinity.settings import DEFAULT, InfinitySettings
from bpnp.search.settings import DEFAULT as SEARCH
from bpnp.search.verdict import Verdict

Array = NDArray[np.float64]
Labels = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Rotated:
    """A rotation (3, 3), camera = R d, and how it explains m image points: place of each one's direction, -1 for none,
    squared distance in squared pixels, decades of evidence; log10 of its false alarms."""

    rotation: Array
    match: Labels
    squared: Array
    decades: Array
    log10_false_alarms: float


@dataclass(frozen=True, eq=False)
class RotationResult:
    """The rotations that were met, the best first, and what is to be said of that one; see `bpnp.search.verdict`.

    turns: pairs of image points that were tried.
    """

    found: list[Rotated]
    verdict: Verdict
    reason: str
    turns: int = 0


class Sight(NamedTuple):
    """One problem at one noise: what is looked for where."""

    image: Image
    catalogue: Catalogue
    sky: Sky
    known: Background
    reach: float
    sample: Labels
    settings: InfinitySettings


@dataclass
class TriedPairs:
    """Which pairs of image points were tried: how many, how many without a common point; `first` points all pairs of
    which were, and `every` if no pair is left."""

    turns: int = 0
    apart: int = 0
    first: int = 0
    every: bool = False
    used: set[int] = field(default_factory=set)

    def log10_missed(self, count: int, least: int, power: float) -> float:
        """Of the probability that a rotation that explains `least` of `count` points was not met, which a tried pair of
        them does but with 1 - power. The first points have h of them (hypergeometric) and so h (h - 1) / 2 pairs; of
        pairs apart each point is one of them with its share."""
        if self.every:
            return -math.inf
        inside = 0.0
        if self.first:
            hit = np.arange(self.first + 1)
            chosen = _log_choose(least, hit) + _log_choose(count - least, self.first - hit)
            unmet = chosen - _log_choose(count, np.array([self.first])) + hit * (hit - 1) / 2 * math.log(1 - power)
            inside = float(np.logaddexp.reduce(unmet)) / math.log(10)
        return min(inside, self.apart * math.log10(1 - power * (least / count) ** 2))


def _log_choose(n: int, k: Labels) -> Array:
    inside = np.clip(k, 0, n)
    return np.where(inside == k, -np.log(n + 1) - betaln(n - inside + 1, inside + 1), -np.inf)


def search_rotation(
    image: Image,
    directions: Array,
    *,
    scores: Array | None = None,
    noise: float | None = None,
    zooms: float = 0.0,
    seed: int = 0,
    deadline: Deadline = NEVER,
    settings: InfinitySettings = DEFAULT,
) -> RotationResult:
    """The rotation under which image points (m) see unit directions (n, 3).

    scores (m,): pairs of points with the largest ones are tried first. noise: standard deviation of the image points,
    pixels, if it is known. zooms: of a focal length that is one of several, the log of the largest over the smallest.
    """
    catalogue = catalogue_of(directions, settings.table)
    scales = settings.noise if noise is None else (noise,)

    @cache
    def sight(scale: float) -> Sight:
        return _sight(image, catalogue, scale, zooms, seed, settings)

    result, turns = RotationResult([], "failed", "no rotation was found"), 0
    for scale in scales:
        if turns and deadline.passed():
            break
        result = _search(sight(scale), scores, seed, deadline)
        turns += result.turns
        rougher = (sight(other) for other in settings.noise if other > scale)
        if result.verdict != "failed" and not any(_explains_better(one, result.found[0]) for one in rougher):
            break
    return replace(result, turns=turns)


def _explains_better(sight: Sight, best: Rotated) -> bool:
    """Whether the best rotation explains the points better at the noise of a sight that was not yet searched for."""
    weight = _information(sight.image, np.flatnonzero(best.match >= 0))
    return _fitted(sight, best.rotation, weight).log10_false_alarms < best.log10_false_alarms


def _information(image: Image, places: Labels) -> Array:
    """Normal matrix (3, 3) of a turn by image points of one pixel's noise."""
    bearings, weight = image.bearings[places], image.pixel[places] ** -2.0
    return np.asarray(weight.sum() * np.eye(3) - (weight[:, None] * bearings).T @ bearings)


def _fitted(sight: Sight, rotation: Array, weight: Array) -> Rotated:
    every = np.arange(len(sight.image.bearings))
    state = Fit(rotation.copy(), weight, np.empty_like(every), np.full(len(every), np.inf))
    fit(sight.image, every, sight.sky, sight.reach, sight.settings.rounds, state, np.empty((4, 3)))
    return _weighed(sight, state)


def _sight(
    image: Image, catalogue: Catalogue, noise: float, zooms: float, seed: int, settings: InfinitySettings
) -> Sight:
    """What is looked for at a noise of so many pixels."""
    reach = settings.reach * noise
    cell = settings.cell * reach * float(np.median(image.pixel))
    background = background_of(image.bearings, image.pixel, len(catalogue.directions), 2 * noise, zooms)
    sample = np.random.default_rng(seed).permutation(len(image.bearings))[: settings.sample]
    return Sight(image, catalogue, catalogue.sky(cell), background, reach, sample, settings)


def _search(sight: Sight, scores: Array | None, seed: int, deadline: Deadline) -> RotationResult:
    settings, count = sight.settings, len(sight.image.bearings)
    found: list[Rotated] = []
    tried = TriedPairs()
    for i, k, last in _image_pairs(sight, scores, seed, tried):
        for one in _rotations(sight, i, k, found):
            found = _merged(found, one, sight)
        tried.turns += 1
        if not {i, k} & tried.used:
            tried.apart += 1
            tried.used |= {i, k}
        if not last:
            continue
        result = _judged(found, sight, tried)
        least = max(math.ceil(settings.least_share * count), FIXING + 1)
        hopeless = tried.log10_missed(count, least, settings.power) <= SEARCH.evidence.missed
        if result.verdict == "confident" or (result.verdict == "failed" and hopeless):
            return result
        if tried.turns >= settings.turns or deadline.passed():
            return result
    tried.every = True
    return _judged(found, sight, tried)


def _image_pairs(sight: Sight, scores: Array | None, seed: int, tried: TriedPairs) -> Iterator[tuple[int, int, bool]]:
    """Pairs of image points, and whether the verdict is to be asked: of few points all pairs of the first ones, of more
    each one with a near partner."""
    bearings, settings, rng = sight.image.bearings, sight.settings, np.random.default_rng(seed)
    order = rng.permutation(len(bearings))
    if scores is not None:
        order = order[np.argsort(-scores[order], kind="stable")]
    few = len(order) <= settings.together
    if few and float(np.max(np.linalg.norm(bearings[:, None] - bearings, axis=-1))) <= sight.catalogue.widest:
        for t in range(1, len(order)):
            for s in range(t):
                if s == t - 1:
                    tried.first = t + 1
                yield int(order[t]), int(order[s]), s == t - 1
        return
    tree = cKDTree(bearings)
    distance, place = tree.query(bearings, min(settings.patch + 1, len(bearings)))
    usable = (distance >= settings.narrowest * distance[:, -1:]) & (distance <= sight.catalogue.widest) & (distance > 0)
    done: set[tuple[int, int]] = set()
    for _ in range(settings.patch):
        for i in order.tolist():
            partners = place[i][usable[i]]
            if len(partners):
                k = int(rng.choice(partners))
                if (min(i, k), max(i, k)) not in done:
                    done.add((min(i, k), max(i, k)))
                    yield i, k, True


def _rotations(sight: Sight, i: int, k: int, found: list[Rotated]) -> Iterator[Rotated]:
    """The fitted rotations that a pair of image points gives and that could contest the best one found."""
    settings = sight.settings
    bearings, pixel = sight.image.bearings, sight.image.pixel
    one, other = bearings[i], bearings[k]
    chord = float(np.linalg.norm(one - other))
    slack = sight.reach * math.hypot(pixel[i], pixel[k])
    low, high = np.searchsorted(sight.catalogue.pairs.chord, [chord - slack, chord + slack])
    if not chord > slack or low == high:
        return
    axes = np.stack([(one + other) / np.linalg.norm(one + other), (one - other) / chord, np.zeros(3)])
    axes[2] = np.cross(axes[0], axes[1])
    off = np.linalg.norm(bearings - axes[0], axis=-1)
    off[[i, k]] = np.inf
    near = np.argsort(off, kind="stable")[: min(settings.patch, len(bearings) - 2)]
    squared = (sight.reach * pixel[near]) ** 2 * (1.5 + 2 * (off[near] / chord) ** 2)
    patch = Patch(np.ascontiguousarray(bearings[near] @ axes.T), np.minimum(squared, sight.sky.table.tolerance**2))
    kept, value = np.empty((settings.refined, 3, 3)), np.full(settings.refined, -math.inf)
    propose(sight.sky, sight.catalogue.pairs, int(low), int(high), patch, settings.abandoned, kept, value)
    weight = _information(sight.image, np.array([i, k]))
    m, scratch = len(bearings), np.empty((4, 3))
    some, every = np.union1d(np.r_[near, i, k], sight.sample), np.arange(m)
    for frame in kept[np.isfinite(value)]:
        state = Fit(axes.T @ frame, weight.copy(), np.empty(m, np.int64), np.full(m, np.inf))
        nats = fit(sight.image, some, sight.sky, sight.reach, settings.rounds, state, scratch)
        best = found[0].decades.sum() * math.log(10) if found else 0.0
        if nats > best * len(some) / m - settings.margin:
            fit(sight.image, every, sight.sky, sight.reach, settings.last_rounds, state, scratch)
            yield _weighed(sight, state)


def _weighed(sight: Sight, state: Fit) -> Rotated:
    left, _, right = np.linalg.svd(state.rotation)
    squared = np.where(state.match >= 0, state.squared, np.inf)
    density = sight.catalogue.density[state.match]
    alarms, decades = log10_false_alarms(squared, density, sight.known)
    return Rotated(left @ right, state.match, squared, decades, alarms)


def _merged(found: list[Rotated], new: Rotated, sight: Sight) -> list[Rotated]:
    """With a rotation more, the best first; of those that see all points alike, to within the reach, the best."""
    limit = sight.reach * float(np.median(sight.image.pixel))

    def same(one: Rotated) -> bool:
        return bool((np.linalg.norm(sight.image.bearings @ (one.rotation - new.rotation), axis=-1) < limit).all())

    alike = [one for one in found if same(one)]
    if any(one.log10_false_alarms <= new.log10_false_alarms for one in alike):
        return found
    rest = [one for one in found if not any(one is other for other in alike)]
    return sorted([*rest, new], key=lambda one: one.log10_false_alarms)[: SEARCH.kept]


def _judged(found: list[Rotated], sight: Sight, tried: TriedPairs) -> RotationResult:
    """The verdict on rotations, best first, by the rules of `bpnp.search.verdict`."""
    rule, turns = SEARCH.evidence, tried.turns
    if not found:
        return RotationResult(found, "failed", "no rotation was found", turns)
    best = found[0]
    alarms = best.log10_false_alarms
    chance = f"unrelated points are expected to fit as well under {number(alarms)} of all rotations"
    if alarms > 0:
        return RotationResult(found, "failed", f"no rotation fits better than chance: {chance}", turns)
    hit = np.flatnonzero(best.match >= 0)
    worth = best.decades[hit]
    most = float(worth.mean() + 2 * worth.std() / math.sqrt(len(hit)))  # that a match of an alternative may be worth
    least = max(math.ceil((float(worth.sum()) - rule.lead) / most), FIXING + 1)
    missed = tried.log10_missed(len(sight.image.bearings), min(least, len(sight.image.bearings)), sight.settings.power)
    lead = found[1].log10_false_alarms - alarms if len(found) > 1 else math.inf
    doubt = known = None
    if alarms > rule.false_alarms:
        doubt = ": too many to be sure"
    elif lead < rule.lead:
        doubt = f", but another rotation fits almost as well ({number(found[1].log10_false_alarms)})"
    elif missed > rule.missed:
        doubt = f", but a better rotation was missed with a probability of up to {number(missed)}"
    else:  # what costs more is asked only where the verdict depends on it
        seen = sight.catalogue.directions[best.match[hit]] @ best.rotation.T
        known = how_well_known(seen, sight.image.bearings[hit], sight.image.pixel[hit], sight.image.bearings)
        if known.strain > sight.reach:
            doubt = f", but a camera other than the given one, by {known.strain:.2g} pixels, explains the points better"
        elif not math.isfinite(known.bound):
            doubt = f", but its {len(hit)} matches do not fix it"
    if doubt is not None or known is None:
        return RotationResult(found, "ambiguous", f"{chance}{doubt}", turns)
    off = f"it is known to {math.degrees(known.bound):.1g} deg, but for one case in a thousand"
    return RotationResult(found, "confident", f"{chance}, and no alternative comes near; {off}", turns)
