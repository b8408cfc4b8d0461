"""The rotation of a camera that sees directions, of which nobody knows which is which.

An image point is compared with every direction by what lies around it: a neighbour at the distance of another image
point votes for the turn about the two that takes the one to the other. The rotations with most votes are fitted, and
what is left is weighed.

Of an alternative that could contest the best rotation it is known how many points it explains at least, and each of
them gives it: that none was met bounds the probability that there is one.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import betaln

from bpnp.loops.parallel import NEVER, Deadline
from bpnp.search.evidence import reasons
from bpnp.search.infinity.evidence import (
    FIXING,
    Array,
    Background,
    Labels,
    background_of,
    how_well_known,
    log10_false_alarms,
    noise_of,
    strain_of,
)
from bpnp.search.infinity.kernels import (
    CROWDED,
    TURN,
    Catalogue,
    Fit,
    Image,
    Rays,
    Sky,
    azimuths,
    catalogue_of,
    fit,
    vote,
)
from bpnp.search.kernels.neighbours import hashed
from bpnp.search.settings import DEFAULT as SEARCH
from bpnp.search.verdict import Verdict

BINS = (6, 7)  # log2 of the fewest and most bins of azimuths


@dataclass(frozen=True)
class InfinitySettings:
    """Every constant that tunes the search for a rotation.

    noise: standard deviations of image points, pixels, for which it is searched, one after the other.
    reach: standard deviations within which a point is a match. cell: of the hash table, in reaches; what is less
        certain is no match yet.
    around: image points around one whose turn about it has to agree. narrowest: least distance of them, in those by
        which a chord may be off, so that their azimuths are known to a tenth.
    first, promising: of these, how many nearest ones choose how many directions, which all of them look at.
    refined: rotations of a point that are fitted: in `rounds` steps to the points around it, then in `last_rounds` to
        `sample` others too, and to all.
    contests: share of the nats of the best rotation that one of a sample of the points has to have to be fitted to all.
    power: share of the true matches that give their rotation. turns: image points that are tried, at most.
    rougher: of the noise that is searched for, how much more matches may show before a larger one is.
    strained: matches, at most, that are asked whether another camera explains them better.
    least_share: of the image points that a rotation explains, for which those that were tried have to be enough
        where chance explains all that was found.
    zoom: factor from one focal length to the next, where it is unknown. zoom_noise: pixels, of the first search with
        each, since points near the edge are off by the error of the focal length; where it fails, `noise` is tried,
        since among many directions chance fits as well at the rough one. zoom_share: `least_share` of these searches.
        zoom_alarms: log10 of the false alarms up to which the focal length is fitted to the matches; those of chance
        are mostly above 8. zoom_rounds: of fits and searches, until the focal length changes by less than zoom_same.
    """

    noise: tuple[float, ...] = (0.35, 1.4)
    reach: float = 3.2
    cell: float = 4.0
    around: int = 24
    narrowest: float = 10.0
    first: int = 8
    promising: int = 384
    refined: int = 4
    sample: int = 200
    rounds: int = 6
    last_rounds: int = 3
    contests: float = 0.7
    power: float = 0.9
    turns: int = 200
    rougher: float = 1.2
    strained: int = 1000
    least_share: float = 0.25
    zoom: float = 1.02
    zoom_noise: float = 3.0
    zoom_share: float = 0.4
    zoom_alarms: float = 5.0
    zoom_rounds: int = 6
    zoom_same: float = 1e-4


DEFAULT = InfinitySettings()


@dataclass(frozen=True, eq=False)
class Rotated:
    """A rotation (3, 3), camera = R d, and how it explains m image points: place of each one's direction, -1 for none,
    squared distance in squared pixels, decades of evidence; the nats by which its matches are likelier than by chance,
    as `fit` counts them; log10 of its false alarms."""

    rotation: Array
    match: Labels
    squared: Array
    decades: Array
    nats: float
    log10_false_alarms: float


@dataclass(frozen=True, eq=False)
class RotationResult:
    """The rotations that were met, the best first, and what is to be said of that one; see `bpnp.search.verdict`.

    turns: image points that were tried.
    """

    found: list[Rotated]
    verdict: Verdict
    reason: str
    turns: int = 0

    @property
    def log10_false_alarms(self) -> float:
        return self.found[0].log10_false_alarms if self.found else math.inf


class Sight(NamedTuple):
    """One problem at one noise: what is looked for where."""

    image: Image
    catalogue: Catalogue
    sky: Sky
    known: Background
    reach: float
    density: float
    sample: Labels
    settings: InfinitySettings


def log10_missed(tried: int, count: int, least: int, power: float) -> float:
    """Compute log10 of the probability that a rotation which explains `least` of `count` points was not found.

    Each tried point that it explains gives it with the probability `power`, so that a rotation may be missed even where
    all points were tried. The number of tried points among the explained ones is hypergeometric.

    >>> round(log10_missed(10, 10, 4, 0.9), 6)
    -4.0
    """
    hit = np.arange(tried + 1)
    chosen = _log_choose(least, hit) + _log_choose(count - least, tried - hit)
    unmet = chosen - _log_choose(count, np.array([tried])) + hit * math.log(1 - power)
    return round(float(np.logaddexp.reduce(unmet)) / math.log(10), 9)  # exact where all were tried


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

    scores (m,): points with the largest ones are tried first. noise: standard deviation of the image points,
    pixels, if it is known. zooms: of a focal length that is one of several, the log of the largest over the smallest.
    """
    catalogue, sample = catalogue_of(directions), np.random.default_rng(seed).permutation(len(image.bearings))
    density = float(np.median(catalogue.density))
    result, turns = RotationResult([], "failed", "no rotation was found"), 0
    for scale in settings.noise if noise is None else (noise,):
        if turns and deadline.passed():
            break
        reach = settings.reach * scale
        # A copy may be written to, as the points that are looked up elsewhere: the loops are compiled once.
        table = hashed(directions.copy(), settings.cell * reach * float(np.median(image.pixel)))
        background = background_of(image.bearings, image.pixel, len(directions), 2 * scale, zooms)
        sight = Sight(
            image,
            catalogue,
            Sky(table, catalogue.density),
            background,
            reach,
            density,
            sample[: settings.sample],
            settings,
        )
        new = _search(sight, scores, seed, deadline)
        turns += new.turns
        if new.log10_false_alarms <= result.log10_false_alarms:
            result = new
        if result.verdict != "failed" and noise_of(*_matches(sight, result.found[0])) < settings.rougher * scale:
            break
    return replace(result, turns=turns)


def _matches(sight: Sight, one: Rotated) -> tuple[Array, Array, Array]:
    """Of a rotation: directions in the camera (k, 3), bearings (k, 3) and angles of a pixel (k,)."""
    hit = np.flatnonzero(one.match >= 0)
    seen = sight.catalogue.directions[one.match[hit]] @ one.rotation.T
    return seen, sight.image.bearings[hit], sight.image.pixel[hit]


def _search(sight: Sight, scores: Array | None, seed: int, deadline: Deadline) -> RotationResult:
    settings, count = sight.settings, len(sight.image.bearings)
    found: list[Rotated] = []
    order, tried = np.random.default_rng(seed).permutation(count), 0
    tree = cKDTree(sight.image.bearings, balanced_tree=False)
    if scores is not None:
        order = order[np.argsort(-scores[order], kind="stable")]
    result = _judged(found, sight, tried)
    for i in order.tolist():
        around, rays, bins = _rays(sight, i, tree)
        if len(around) < FIXING:
            continue
        tried += 1
        near = np.r_[i, around]
        some = np.union1d(near, sight.sample)
        for rotation, farthest in _agreeing(sight, i, around, rays, bins):
            one = _fitted(sight, rotation, near, farthest, some, found)
            found = found if one is None else _merged(found, one, sight)
        result = _judged(found, sight, tried)
        least = max(math.ceil(settings.least_share * count), FIXING + 1)
        hopeless = log10_missed(tried, count, least, settings.power) <= SEARCH.evidence.missed
        if result.verdict == "confident" or (result.verdict == "failed" and hopeless):
            break
        if tried >= settings.turns or deadline.passed():
            break
    return result


def _rays(sight: Sight, i: int, tree: cKDTree) -> tuple[Labels, Rays, int]:
    """The image points around one (k,), what they say of its neighbours, and in how many bins their votes are counted.

    A chord is off by the noise of both ends, and an azimuth by as much over the chord.
    """
    settings, bearings, pixel = sight.settings, sight.image.bearings, sight.image.pixel
    chord, around = tree.query(bearings[i], min(4 * settings.around, len(bearings)))
    slack = sight.reach * np.hypot(pixel[i], pixel[around])
    usable = np.flatnonzero(chord > settings.narrowest * slack)[: settings.around]
    usable = usable[np.argsort((chord - slack)[usable], kind="stable")]
    chord, slack, around = chord[usable], slack[usable], around[usable]
    if not len(around):
        return around, Rays(*np.empty((4, 0))), 0
    bins = 1 << int(np.clip(math.log2(2 * math.pi / float((slack / chord).max())), *BINS))
    chance = np.minimum(sight.density * 2 * slack * 2 * chord * 2 * math.pi / bins, CROWDED)
    azimuth = azimuths(bearings[i : i + 1], bearings[around][None])[0]
    low, high, nats = (x.astype(np.float32) for x in (chord - slack, chord + slack, np.log(0.5 / chance)))
    return around, Rays(low, high, azimuth, nats), bins


def _agreeing(sight: Sight, i: int, around: Labels, rays: Rays, bins: int) -> Iterator[tuple[Array, int]]:
    """The rotations for which most speaks that lies around an image point, likeliest first, and the farthest point that
    does so."""
    settings, neighbours = sight.settings, sight.catalogue.neighbours
    shift = (TURN // bins).bit_length() - 1
    places, bin_of = np.arange(len(neighbours.chord)), np.empty(0, np.int64)
    for used, most in ((settings.first, settings.promising), (len(around), settings.refined)):
        value, bin_of = np.empty(len(places), np.float32), np.empty(len(places), np.int64)
        vote(
            neighbours,
            places,
            Rays._make(values[:used] for values in rays),
            shift,
            np.empty(bins, np.float32),
            value,
            bin_of,
        )
        best = np.argpartition(-value, most)[:most] if len(places) > most else np.arange(len(places))
        best = best[np.argsort(-value[best], kind="stable")]
        places, bin_of = places[best], bin_of[best]
    low, high, azimuth = rays.low[:, None], rays.high[:, None], rays.azimuth[:, None]
    for a, c in zip(places.tolist(), bin_of.tolist(), strict=True):
        chord, turned = neighbours.chord[a], ((neighbours.azimuth[a] - azimuth) & (TURN - 1)) >> shift
        agrees = (chord >= low) & (chord <= high) & ((c - turned) & (bins - 1) < 2)
        if agrees.any(1).sum() >= FIXING:
            k, e = np.nonzero(agrees)
            seen, directions = np.r_[i, around[k]], np.r_[a, neighbours.place[a, e]]
            left, _, right = np.linalg.svd(sight.image.bearings[seen].T @ sight.catalogue.directions[directions])
            yield left * [1, 1, np.linalg.det(left @ right)] @ right, int(seen[-1])  # with least squares


def _fitted(
    sight: Sight, rotation: Array, near: Labels, farthest: int, some: Labels, found: list[Rotated]
) -> Rotated | None:
    """A rotation fitted to the points near a first one, then to some others, and to all of them; None where it does not
    contest the best one that was found, or is one of those.

    It is known as well as two points fix it, the first and the farthest that agrees.
    """
    image, settings, m = sight.image, sight.settings, len(sight.image.bearings)
    two, weight = image.bearings[[near[0], farthest]], image.pixel[[near[0], farthest]] ** -2.0
    known = weight.sum() * np.eye(3) - (weight[:, None] * two).T @ two
    state, scratch = Fit(rotation, known, np.full(m, -1), np.full(m, np.inf)), np.empty((4, 3))
    fit(image, near, sight.sky, sight.reach, settings.rounds, state, scratch)
    nats = fit(image, some, sight.sky, sight.reach, settings.last_rounds, state, scratch)
    best = max(settings.contests * found[0].nats * len(some) / m, 0.0) if found else 0.0
    if nats <= best or any(_is_same(sight, one.rotation, state.rotation, some) for one in found):
        return None
    nats = fit(image, np.arange(m), sight.sky, sight.reach, settings.last_rounds, state, scratch)
    if (state.match >= 0).sum() <= FIXING:
        return None
    left, _, right = np.linalg.svd(state.rotation)
    squared = np.where(state.match >= 0, state.squared, np.inf)
    alarms, decades = log10_false_alarms(squared, sight.catalogue.density[state.match], sight.known)
    return Rotated(left @ right, state.match, squared, decades, nats, alarms)


def _is_same(sight: Sight, one: Array, other: Array, places: Labels) -> bool:
    """Whether two rotations see some points alike, to within the reach."""
    limit = sight.reach * float(np.median(sight.image.pixel[places]))
    return bool((np.linalg.norm(sight.image.bearings[places] @ (one - other), axis=-1) < limit).all())


def _merged(found: list[Rotated], new: Rotated, sight: Sight) -> list[Rotated]:
    """With a rotation more, the best first; of those that are the same the best, and of those that chance explains none
    but a first one."""
    every = np.arange(len(sight.image.bearings))
    alike = [one for one in found if _is_same(sight, one.rotation, new.rotation, every)]
    if any(one.log10_false_alarms <= new.log10_false_alarms for one in alike):
        return found
    rest = [one for one in found if not any(one is other for other in alike)]
    first, *others = sorted([*rest, new], key=lambda one: one.log10_false_alarms)
    return [first, *(one for one in others if one.log10_false_alarms <= 0)][: SEARCH.kept]


def _judged(found: list[Rotated], sight: Sight, turns: int) -> RotationResult:
    """The verdict on rotations, best first, by the rules of `bpnp.search.verdict`."""
    rule = SEARCH.evidence
    if not found:
        return RotationResult(found, "failed", "no rotation was found", turns)
    best = found[0]
    alarms = best.log10_false_alarms
    if alarms > 0:
        return RotationResult(found, "failed", reasons.against("no rotation fits better than chance", alarms), turns)
    hit = np.flatnonzero(best.match >= 0)
    worth = best.decades[hit]
    most = float(worth.mean() + 2 * worth.std() / math.sqrt(len(hit)))  # that a match of an alternative may be worth
    least = max(math.ceil((float(worth.sum()) - rule.lead) / most), FIXING + 1)
    count = len(sight.image.bearings)
    missed = log10_missed(turns, count, min(least, count), sight.settings.power)
    lead = found[1].log10_false_alarms - alarms if len(found) > 1 else math.inf
    doubt = known = None
    if alarms > rule.false_alarms:
        return RotationResult(found, "ambiguous", reasons.insignificant(alarms, rule.false_alarms), turns)
    if lead < rule.lead:
        doubt = f"another rotation fits about as well (margin {lead:.1f} decades)"
    elif missed > rule.missed:
        doubt = f"a better rotation may exist (miss probability up to {reasons.number(missed)})"
    else:  # what costs more is asked only where the verdict depends on it
        seen, bearings, pixel = _matches(sight, best)
        some = np.linspace(0, len(hit) - 1, min(len(hit), sight.settings.strained)).astype(np.int64)
        known = how_well_known(seen, bearings, pixel)
        strain = strain_of(seen[some], bearings[some], pixel[some], sight.image.bearings)
        if strain > sight.reach:
            doubt = f"a camera other than the given one, by {strain:.2g} pixels, explains the points better"
        elif not math.isfinite(known.bound):
            doubt = f"its {len(hit)} matches do not fix it"
    if doubt is not None or known is None:
        return RotationResult(found, "ambiguous", reasons.against(doubt or "", alarms), turns)
    reason = reasons.confident(alarms, rule.lead, math.degrees(known.bound))
    return RotationResult(found, "confident", reason, turns)
