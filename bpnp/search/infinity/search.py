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
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.special import betaln

from bpnp.loops.parallel import NEVER, Deadline
from bpnp.search.evidence import reasons
from bpnp.search.evidence.false_alarms import FIXING_ROTATION
from bpnp.search.hypotheses import Hypotheses
from bpnp.search.infinity.evidence import (
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
from bpnp.search.verdict import SearchResult, no_pose

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
) -> SearchResult:
    """Search the rotation under which image points see directions.

    Args:
        image: Image points (m).
        directions: (n, 3) unit vectors.
        scores: (m,) points with the largest ones are tried first.
        noise: Standard deviation of the image points, pixels; None if it is unknown.
        zooms: Logarithm of the largest over the smallest focal length, of one that is one of several.
        seed: Of the order in which points are tried.
        deadline: When to stop.
        settings: Constants.

    Returns:
        The verdict and the rotations, with translations of 0; `batches` is the number of image points that were tried.
    """
    catalogue, sample = catalogue_of(directions), np.random.default_rng(seed).permutation(len(image.bearings))
    density = float(np.median(catalogue.density))
    result, turns = no_pose("no rotation was found"), 0
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
        turns += new.batches
        if new.log10_false_alarms <= result.log10_false_alarms:
            result = new
        if result.verdict != "failed" and noise_of(*_matches(sight, result.candidates)) < settings.rougher * scale:
            break
    return replace(result, batches=turns)


def _matches(sight: Sight, found: Hypotheses) -> tuple[Array, Array, Array]:
    """Return the matches of the best rotation: directions in the camera (k, 3), bearings (k, 3) and angles of a pixel
    (k,)."""
    assert found.matches is not None
    matched = np.flatnonzero(found.matches[0] >= 0)
    seen = sight.catalogue.directions[found.matches[0, matched]] @ found.rotation[0].T
    return seen, sight.image.bearings[matched], sight.image.pixel[matched]


def _search(sight: Sight, scores: Array | None, seed: int, deadline: Deadline) -> SearchResult:
    settings, count, found = sight.settings, len(sight.image.bearings), Hypotheses.empty()
    order, tried = np.random.default_rng(seed).permutation(count), 0
    tree = cKDTree(sight.image.bearings, balanced_tree=False)
    if scores is not None:
        order = order[np.argsort(-scores[order], kind="stable")]
    result = _judged(found, sight, tried)
    for i in order.tolist():
        around, rays, bins = _rays(sight, i, tree)
        if len(around) < FIXING_ROTATION:
            continue
        tried += 1
        near = np.r_[i, around]
        some = np.union1d(near, sight.sample)
        for rotation, farthest in _agreeing(sight, i, around, rays, bins):
            one = _fitted(sight, rotation, near, farthest, some, found)
            found = found if one is None else _merge(found, one, sight)
        result = _judged(found, sight, tried)
        least = max(math.ceil(settings.least_share * count), FIXING_ROTATION + 1)
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
        if agrees.any(1).sum() >= FIXING_ROTATION:
            k, e = np.nonzero(agrees)
            seen, directions = np.r_[i, around[k]], np.r_[a, neighbours.place[a, e]]
            left, _, right = np.linalg.svd(sight.image.bearings[seen].T @ sight.catalogue.directions[directions])
            yield left * [1, 1, np.linalg.det(left @ right)] @ right, int(seen[-1])  # with least squares


def _fitted(
    sight: Sight, rotation: Array, near: Labels, farthest: int, some: Labels, found: Hypotheses
) -> Hypotheses | None:
    """Fit a rotation to the points near a first one, then to some others, and to all of them.

    It is known as well as two points fix it, the first and the farthest that agrees.

    Returns:
        The rotation (1,); None where it does not compete with the best one that was found, or is one of those.
    """
    image, settings, m = sight.image, sight.settings, len(sight.image.bearings)
    two, weight = image.bearings[[near[0], farthest]], image.pixel[[near[0], farthest]] ** -2.0
    known = weight.sum() * np.eye(3) - (weight[:, None] * two).T @ two
    state, scratch = Fit(rotation, known, np.full(m, -1), np.full(m, np.inf)), np.empty((4, 3))
    fit(image, near, sight.sky, sight.reach, settings.rounds, state, scratch)
    nats = fit(image, some, sight.sky, sight.reach, settings.last_rounds, state, scratch)
    best = 0.0 if found.evidence is None else max(settings.contests * float(found.evidence[0]) * len(some) / m, 0.0)
    if nats <= best or _is_same(sight, found.rotation, state.rotation, some).any():
        return None
    nats = fit(image, np.arange(m), sight.sky, sight.reach, settings.last_rounds, state, scratch)
    if (state.match >= 0).sum() <= FIXING_ROTATION:
        return None
    left, _, right = np.linalg.svd(state.rotation)
    squared = np.where(state.match >= 0, state.squared, np.inf)
    alarms, nats_of_points = log10_false_alarms(squared, sight.catalogue.density[state.match], sight.known)
    return Hypotheses.from_poses(
        (left @ right)[None],
        np.zeros((1, 3)),
        log_likelihood=nats_of_points.mean(keepdims=True),
        match_count=(state.match >= 0).sum(keepdims=True),
        log10_false_alarms=np.array([alarms]),
        evidence=np.array([nats]),
        matches=state.match[None],
        residual=(np.sqrt(squared) * image.pixel)[None],
        point_evidence=nats_of_points[None],
    )


def _is_same(sight: Sight, rotations: Array, other: Array, indices: Labels) -> NDArray[np.bool_]:
    """Return which of rotations (c, 3, 3) see some points where another one does, to within the reach."""
    limit = sight.reach * float(np.median(sight.image.pixel[indices]))
    return np.asarray((np.linalg.norm(sight.image.bearings[indices] @ (rotations - other), axis=-1) < limit).all(-1))


def _merge(found: Hypotheses, new: Hypotheses, sight: Sight) -> Hypotheses:
    """Return the rotations with another one (1,), the best first; of those that are the same the best, and of those
    that are not significant none but a first one."""
    alike = _is_same(sight, found.rotation, new.rotation[0], np.arange(len(sight.image.bearings)))
    if (found.log10_false_alarms[alike] <= new.log10_false_alarms).any():
        return found
    every = Hypotheses.concatenate([found[~alike], new]) if len(found) else new
    every = every[np.argsort(every.log10_false_alarms, kind="stable")]
    return every[(every.log10_false_alarms <= 0) | (np.arange(len(every)) == 0)][: SEARCH.kept]


def _judged(found: Hypotheses, sight: Sight, turns: int) -> SearchResult:
    """Judge rotations, best first, by the rules of `bpnp.search.verdict`."""
    rule = SEARCH.evidence
    if found.matches is None or found.point_evidence is None:
        return no_pose("no rotation was found", turns)
    alarms = float(found.log10_false_alarms[0])
    if alarms > 0:
        return SearchResult(found, "failed", reasons.against("no rotation fits better than chance", alarms), turns)
    hit = np.flatnonzero(found.matches[0] >= 0)
    worth = found.point_evidence[0, hit] / math.log(10)
    most = float(worth.mean() + 2 * worth.std() / math.sqrt(len(hit)))  # that a match of an alternative may be worth
    least = max(math.ceil((float(worth.sum()) - rule.lead) / most), FIXING_ROTATION + 1)
    count = len(sight.image.bearings)
    missed = log10_missed(turns, count, min(least, count), sight.settings.power)
    lead = float(found.log10_false_alarms[1]) - alarms if len(found) > 1 else math.inf
    doubt = known = None
    if alarms > rule.false_alarms:
        return SearchResult(found, "ambiguous", reasons.insignificant(alarms, rule.false_alarms), turns)
    if lead < rule.lead:
        doubt = f"another rotation fits about as well (margin {lead:.1f} decades)"
    elif missed > rule.missed:
        doubt = f"a better rotation may exist (miss probability up to {reasons.number(missed)})"
    else:  # what costs more is asked only where the verdict depends on it
        seen, bearings, pixel = _matches(sight, found)
        some = np.linspace(0, len(hit) - 1, min(len(hit), sight.settings.strained)).astype(np.int64)
        known = how_well_known(seen, bearings, pixel)
        strain = strain_of(seen[some], bearings[some], pixel[some], sight.image.bearings)
        if strain > sight.reach:
            doubt = f"a camera other than the given one, by {strain:.2g} pixels, explains the points better"
        elif not math.isfinite(known.bound):
            doubt = f"its {len(hit)} matches do not fix it"
    if doubt is not None or known is None:
        return SearchResult(found, "ambiguous", reasons.against(doubt or "", alarms), turns)
    reason = reasons.confident(alarms, rule.lead, math.degrees(known.bound))
    return SearchResult(found, "confident", reason, turns)
