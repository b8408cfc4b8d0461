"""Search for the rotation of a camera that sees unmatched directions.

An image point is compared with every direction by their neighbours. A neighbour of the direction at the distance of
another image point votes for the rotation that aligns both pairs. The rotations with the most votes are fitted and
judged.

A rotation that could compete with the best one explains a minimum number of points. Each of these points, when tried,
proposes it. If no competing rotation was found, this bounds the miss probability.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.special import betaln

from bpnp.loops.parallel import NEVER, Deadline
from bpnp.search.config import DEFAULT as SEARCH
from bpnp.search.evidence import reasons
from bpnp.search.evidence.reasons import CONFIDENT, objection
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
from bpnp.search.loop import Step, run
from bpnp.search.pose_model import FIXING_ROTATION
from bpnp.search.verdict import SearchResult, no_pose

BINS = (6, 7)  # log2 of the smallest and largest number of azimuth bins


@dataclass(frozen=True)
class InfinitySettings:
    """Constants of the search for a rotation.

    Attributes:
        noise: Standard deviations of image points, pixels, that are tried one after the other.
        reach: Distance, in standard deviations, within which a point is a match.
        cell: Cell of the hash table, in reaches; a point with a larger reach gets no match yet.
        around: Number of image points around one that vote.
        narrowest: Smallest chord to them, in errors of a chord, which limits the azimuth error to 1/10 radian.
        first: Number of the nearest of them that preselect directions.
        promising: Number of preselected directions, which all of them vote on.
        refined: Number of rotations of a point that are fitted.
        sample: Number of further points that a rotation is fitted to before it is fitted to all.
        rounds: Steps of the fit to the points around one.
        last_rounds: Steps of the fit to the sample, and of that to all points.
        contests: Smallest evidence on the sample of a rotation that is fitted to all points, as a fraction of that of
            the best one.
        power: Fraction of the true matches that propose their rotation.
        turns: Largest number of image points that are tried.
        rougher: Largest noise of the matches, in multiples of the tried one, before the next one is tried.
        strained: Largest number of matches that are tested for an error of the camera model.
        least_share: Fraction of the image points that a rotation explains. An unsuccessful search ends when it would
            have found such a rotation.
        zoom: Factor from one focal length to the next if it is unknown.
        zoom_noise: Noise of the first search at each focal length, pixels; it includes the error of the focal length
            near the edge. If it fails, `noise` is tried, since many directions are not significant at a large noise.
        zoom_share: `least_share` of these searches.
        zoom_alarms: Largest log10 NFA from which the focal length is fitted to the matches; by chance it is mostly
            above 8.
        zoom_rounds: Largest number of rounds of fit and search.
        zoom_same: Relative change of the focal length below which these end.
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
    """One problem at one noise.

    Attributes:
        image: Image points.
        catalogue: Directions with their neighbours.
        sky: Directions for look-up.
        known: Constants of the number of false alarms.
        reach: Largest distance of a match, pixels.
        density: Median density of the directions, per steradian.
        sample: Indices of the sample of image points.
        settings: Constants.
    """

    image: Image
    catalogue: Catalogue
    sky: Sky
    known: Background
    reach: float
    density: float
    sample: Labels
    settings: InfinitySettings


def log10_missed(tried: int, count: int, least: int, power: float) -> float:
    """Compute log10 of the probability that a rotation which explains `least` of `count` points was missed.

    Each tried point that it explains proposes it with the probability `power`, so a rotation may be missed even if all
    points were tried. The number of tried points among the explained ones is hypergeometric.

    Args:
        tried: Number of image points that were tried.
        count: Number of image points.
        least: Number of image points that the rotation explains.
        power: Probability that one of these, when tried, proposes the rotation.

    >>> round(log10_missed(10, 10, 4, 0.9), 6)
    -4.0
    """
    hit = np.arange(tried + 1)
    chosen = _log_choose(least, hit) + _log_choose(count - least, tried - hit)
    unmet = chosen - _log_choose(count, np.array([tried])) + hit * math.log(1 - power)
    return round(float(np.logaddexp.reduce(unmet)) / math.log(10), 9)  # exact if all were tried


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
    """Search for the rotation under which image points see directions.

    Args:
        image: Image points (m).
        directions: (n, 3) unit vectors.
        scores: (m,) scores; points with the largest ones are tried first. None: random order.
        noise: Standard deviation of the image points, pixels; None if it is unknown.
        zooms: Logarithm of the largest over the smallest focal length, if this is one of several; default 0.
        seed: Random seed of the order in which points are tried.
        deadline: When to stop.
        settings: Constants.

    Returns:
        Verdict and rotations, with translations of 0; `batches` is the number of image points that were tried.
    """
    catalogue, sample = catalogue_of(directions), np.random.default_rng(seed).permutation(len(image.bearings))
    density = float(np.median(catalogue.density))
    result, turns = no_pose("no rotation was found"), 0
    for scale in settings.noise if noise is None else (noise,):
        if turns and deadline.passed():
            break
        reach = settings.reach * scale
        # A writable copy has the type of other look-up points, so that the loops are compiled once.
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
        poses = RotationPoses(sight)
        new = run(RotationPlan(poses, scores, seed), poses, most=settings.turns, deadline=deadline)
        turns += new.batches
        if new.log10_false_alarms <= result.log10_false_alarms:
            result = new
        if result.verdict != "failed" and noise_of(*_matches(sight, result.candidates)) < settings.rougher * scale:
            break
    return replace(result, batches=turns)


def _matches(sight: Sight, found: Hypotheses) -> tuple[Array, Array, Array]:
    """Return the matches of the best rotation.

    Returns:
        Directions in the camera's frame (k, 3), bearings (k, 3) and angles of a pixel (k,).
    """
    assert found.matches is not None
    matched = np.flatnonzero(found.matches[0] >= 0)
    seen = sight.catalogue.directions[found.matches[0, matched]] @ found.rotation[0].T
    return seen, sight.image.bearings[matched], sight.image.pixel[matched]


class RotationPoses:
    """Rotations that a search has found so far, best first.

    Attributes:
        sight: The problem.
        found: Rotations.
        turns: Number of image points that were tried.
    """

    def __init__(self, sight: Sight) -> None:
        self.sight, self.found, self.turns = sight, Hypotheses.empty(), 0

    def add(self, step: Step, found: Hypotheses) -> None:
        """Add the rotations that an image point proposed."""
        self.turns += 1
        for k in range(len(found)):
            self.found = _merge(self.found, found[k : k + 1], self.sight)

    def may_be_decided(self) -> bool:
        """Return True: the verdict on a rotation is cheap."""
        return True

    def result(self, *, ended: bool = True) -> SearchResult:
        """Compute the verdict; a failed one is settled if a rotation of enough points would have been found."""
        settings, count = self.sight.settings, len(self.sight.image.bearings)
        result = _judged(self.found, self.sight, self.turns)
        least = max(math.ceil(settings.least_share * count), FIXING_ROTATION + 1)
        hopeless = log10_missed(self.turns, count, least, settings.power) <= SEARCH.evidence.missed
        return replace(result, settled=result.verdict == "failed" and hopeless)


class RotationPlan:
    """Steps of a search for a rotation: the image points, one after the other.

    Args:
        poses: Rotations found so far.
        scores: (m,) scores of the image points, largest first; None for a random order.
        seed: Seed of the order.
    """

    def __init__(self, poses: RotationPoses, scores: Array | None, seed: int) -> None:
        bearings = poses.sight.image.bearings
        order = np.random.default_rng(seed).permutation(len(bearings))
        if scores is not None:
            order = order[np.argsort(-scores[order], kind="stable")]
        self._poses, self._order = poses, iter(order.tolist())
        self._tree = cKDTree(bearings, balanced_tree=False)

    def next_step(self) -> Step | None:
        """Return the step of the next image point with enough others around it; None after the last one."""
        for i in self._order:
            around, rays, bins = _rays(self._poses.sight, i, self._tree)
            if len(around) >= FIXING_ROTATION:
                return Step(partial(self._propose, i, around, rays, bins))
        return None

    def _propose(self, i: int, around: Labels, rays: Rays, bins: int) -> Hypotheses:
        """Return the rotations that an image point proposes and that may compete with the best one."""
        sight, found, new = self._poses.sight, self._poses.found, list[Hypotheses]()
        near = np.r_[i, around]
        some = np.union1d(near, sight.sample)
        for rotation, farthest in _agreeing(sight, i, around, rays, bins):
            one = _fitted(sight, rotation, near, farthest, some, found)
            if one is not None:
                new.append(one)
                found = _merge(found, one, sight)
        return Hypotheses.concatenate(new) if new else Hypotheses.empty()


def _rays(sight: Sight, i: int, tree: cKDTree) -> tuple[Labels, Rays, int]:
    """Return the indices (k,) of the image points around one, their rays, and the number of azimuth bins.

    The error of a chord is the noise of both ends. That of an azimuth is this error over the chord.
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
    """Propose rotations that the neighbours of an image point support.

    Yields:
        Rotation (3, 3), most votes first, and the index of the farthest image point that supports it.
    """
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
            yield left * [1, 1, np.linalg.det(left @ right)] @ right, int(seen[-1])  # least squares


def _fitted(
    sight: Sight, rotation: Array, near: Labels, farthest: int, some: Labels, found: Hypotheses
) -> Hypotheses | None:
    """Fit a rotation to the points near a first one, then to a sample, and then to all points.

    Its initial uncertainty is that of a rotation fixed by two points, the first and the farthest that supports it.

    Args:
        sight: The problem.
        rotation: (3, 3) initial rotation.
        near: Indices of the first point and those around it.
        farthest: Index of the farthest point that supports the rotation.
        some: Indices of these points and the sample.
        found: Rotations that were found, best first.

    Returns:
        The rotation (1,); None if it cannot compete with the best one, or was found before.
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
    """Return which rotations (c, 3, 3) agree with another one to within the reach at the points `indices`."""
    limit = sight.reach * float(np.median(sight.image.pixel[indices]))
    return np.asarray((np.linalg.norm(sight.image.bearings[indices] @ (rotations - other), axis=-1) < limit).all(-1))


def _merge(found: Hypotheses, new: Hypotheses, sight: Sight) -> Hypotheses:
    """Add a rotation (1,) to the others, best first.

    Only the best of equal rotations is kept, and a rotation that is not significant only if it is the best of all.
    """
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
    result = SearchResult(found, "confident", "", turns, CONFIDENT)
    if alarms > 0:
        return replace(result.doubt(objection("chance", what="no rotation fits")), verdict="failed")
    if alarms > rule.false_alarms:
        reason = reasons.insignificant(alarms, rule.false_alarms)
        return replace(result, verdict="ambiguous", reason=reason, code="insignificant")
    lead = float(found.log10_false_alarms[1]) - alarms if len(found) > 1 else math.inf
    if lead < rule.lead:
        return result.doubt(objection("competing_rotation", lead))
    hit = np.flatnonzero(found.matches[0] >= 0)
    worth = found.point_evidence[0, hit] / math.log(10)
    most = float(worth.mean() + 2 * worth.std() / math.sqrt(len(hit)))  # largest for a competing rotation
    least = max(math.ceil((float(worth.sum()) - rule.lead) / most), FIXING_ROTATION + 1)
    count = len(sight.image.bearings)
    missed = log10_missed(turns, count, min(least, count), sight.settings.power)
    if missed > rule.missed:
        return result.doubt(objection("incomplete", what="rotation", probability=reasons.number(missed)))
    seen, bearings, pixel = _matches(sight, found)
    some = np.linspace(0, len(hit) - 1, min(len(hit), sight.settings.strained)).astype(np.int64)
    strain = strain_of(seen[some], bearings[some], pixel[some], sight.image.bearings)
    if strain > sight.reach:
        return result.doubt(objection("other_camera_by_pixels", pixels=strain))
    bound = how_well_known(seen, bearings, pixel).bound
    if not math.isfinite(bound):
        return result.doubt(objection("rotation_not_fixed", count=len(hit), what="it"))
    return replace(result, reason=reasons.confident(alarms, rule.lead, math.degrees(bound)))
