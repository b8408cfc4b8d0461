"""Search for the rotation of a camera that sees unmatched directions.

An image point is compared with every direction by their neighbours. A neighbour of the direction at the distance of
another image point votes for the rotation that aligns both pairs. The rotations with the most votes are fitted and
judged.

A rotation that could compete with the best one explains a minimum number of points. Each of these points, when tried,
proposes it. If no competing rotation was found, this bounds the miss probability.

With a prior, only rotations within `ENUMERATION.sigmas` standard deviations are proposed. If none of them is
significant, the search is repeated over all rotations, whose number of tests remains that of the prior.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.special import betaln

from bpnp.poses import rotation_angle
from bpnp.runtime import NEVER, Deadline
from bpnp.search.config import DEFAULT, ENUMERATION, INFINITY, SKY, InfinitySettings
from bpnp.search.hypotheses import Hypotheses
from bpnp.search.infinity.evidence import (
    Array,
    Background,
    Labels,
    background_of,
    how_well_known,
    log10_false_alarms,
    noise_of,
    prior_information,
    strain_of,
)
from bpnp.search.infinity.kernels import TURN, Catalogue, Fit, Image, Rays, Sky, azimuths, catalogue_of, fit, vote
from bpnp.search.kernels.neighbours import hashed
from bpnp.search.loop import Progress, Step, run, teller
from bpnp.search.pose_model import FIXING_ROTATION
from bpnp.search.problem import Problem
from bpnp.search.starts import PosePrior
from bpnp.search.verdict import reasons
from bpnp.search.verdict.decide import SearchResult, fits_by_chance, no_pose
from bpnp.search.verdict.reasons import CONFIDENT, objection

NO_LABELS = np.empty(0, np.int64)


class Sight(NamedTuple):
    """One problem at one noise.

    Attributes:
        problem: Image points and directions, with their annotations.
        image: Image points.
        catalogue: Directions with their neighbours.
        sky: Directions for look-up.
        background: Constants of the number of false alarms.
        reach: Largest distance of a match, pixels.
        density: Median density of the directions, per steradian.
        sample: Indices of the sample of image points.
        settings: Constants.
        is_near: True if only rotations near the prior are proposed.
    """

    problem: Problem
    image: Image
    catalogue: Catalogue
    sky: Sky
    background: Background
    reach: float
    density: float
    sample: Labels
    settings: InfinitySettings
    is_near: bool

    @property
    def least_share(self) -> float:
        """Fraction of the image points that a rotation explains, if there is one."""
        clutter = self.problem.clutter
        return self.settings.least_share if clutter is None else (1 - clutter) / 2

    def odds(self, match: Labels) -> Array:
        """Return how much likelier each match is by classes and scores than a mean one.

        Args:
            match: (m,) index of the direction of each image point; -1 for none, with any value.
        """
        odds, problem = np.ones(len(match)), self.problem
        if problem.scores3d is not None:
            candidates = 1.0 if problem.candidate_scores is None else problem.candidate_scores
            odds = problem.scores3d[match] / (candidates * problem.scores3d.mean())
        if problem.odds2d is not None and problem.classes3d is not None:
            odds = odds * np.maximum((problem.odds2d * problem.classes3d[match]).sum(-1), 1e-12)
        return np.asarray(odds)

    def densities(self, match: Labels) -> Array:
        """Return the density (m,) of the directions that may match each image point, around its match."""
        labels = self.image.labels
        if not len(labels):
            return self.catalogue.density[0, match]
        fitting = ((labels >= 0) & (self.sky.labels[match] >= 0)).astype(np.int64)
        return self.catalogue.density[fitting, match]


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
    problem: Problem,
    pixel: Array,
    *,
    noise: float | None = None,
    seed: int = 0,
    deadline: Deadline = NEVER,
    settings: InfinitySettings = INFINITY,
    progress: Progress | None = None,
) -> SearchResult:
    """Search for the rotation under which image points see directions.

    Args:
        problem: Image points (m) and directions, unit vectors as `points3d`. Points with the largest `scores2d` are
            tried first. A prior restricts the rotation.
        pixel: (m,) angle of a pixel at each image point, radians.
        noise: Standard deviation of the image points, pixels; None if it is unknown.
        seed: Random seed of the order in which points are tried.
        deadline: When to stop.
        settings: Constants.
        progress: Callback with the number of tried image points and the seconds, after each of them. None for no
            callback.

    Returns:
        Verdict and rotations, with translations of 0; `batches` is the number of image points that were tried.
    """
    result, iterations, tell = no_pose("no rotation was found"), 0, teller(progress)
    for is_near in (False,) if problem.prior is None else (True, False):
        new = _at_each_noise(problem, pixel, noise, seed, deadline, settings, _after(iterations, tell), is_near=is_near)
        iterations += new.batches
        result = min(new, result, key=lambda one: one.log10_false_alarms)
        if result.log10_false_alarms <= DEFAULT.evidence.false_alarms or deadline.passed():
            break
    return replace(result, batches=iterations)


def _at_each_noise(
    problem: Problem,
    pixel: Array,
    noise: float | None,
    seed: int,
    deadline: Deadline,
    settings: InfinitySettings,
    tell: Callable[[int], None],
    *,
    is_near: bool,
) -> SearchResult:
    """Search at one noise after the other; arguments as for `search_rotation` and `run`, with `is_near` of `Sight`."""
    unlabelled = problem.labels2d is None or problem.labels3d is None
    labels2d = NO_LABELS if unlabelled or problem.labels2d is None else np.array(problem.labels2d)
    labels3d = NO_LABELS if unlabelled or problem.labels3d is None else np.array(problem.labels3d)
    image, directions = Image(problem.bearings, pixel, labels2d), problem.points3d
    # With class probabilities, `Sight.odds` has the evidence of the classes.
    catalogue = catalogue_of(directions, None if unlabelled or problem.odds2d is not None else labels3d)
    sample = np.random.default_rng(seed).permutation(len(image.bearings))
    density = float(np.median(catalogue.density[0]))
    result, iterations = no_pose("no rotation was found"), 0
    for scale in settings.noise if noise is None else (noise,):
        if iterations and deadline.passed():
            break
        reach = settings.reach * scale
        # A writable copy has the type of other look-up points, so that the loops are compiled once.
        table = hashed(directions.copy(), settings.cell * reach * float(np.median(image.pixel)))
        sight = Sight(
            problem,
            image,
            catalogue,
            Sky(table, catalogue.density, labels3d),
            background_of(problem, pixel, 2 * scale),
            reach,
            density,
            sample[: settings.sample],
            settings,
            is_near,
        )
        poses = RotationPoses(sight)
        new = run(
            RotationPlan(poses, seed), poses, most=settings.iterations, deadline=deadline, tell=_after(iterations, tell)
        )
        iterations += new.batches
        if new.log10_false_alarms <= result.log10_false_alarms:
            result = new
        if result.verdict != "failed" and noise_of(*_matches(sight, result.candidates)) < settings.rougher * scale:
            break
    return replace(result, batches=iterations)


def _after(iterations: int, tell: Callable[[int], None]) -> Callable[[int], None]:
    """Return a function that calls `tell` with its argument plus the number of earlier iterations."""
    return lambda new: tell(iterations + new)


def _matches(sight: Sight, found: Hypotheses) -> tuple[Array, Array, Array]:
    """Return the matches of the best rotation.

    Returns:
        Directions in the camera's frame (k, 3), bearings (k, 3) and angles of a pixel (k,).
    """
    assert found.matches is not None
    matched = np.flatnonzero(found.matches[0] >= 0)
    directions = sight.catalogue.directions[found.matches[0, matched]] @ found.rotation[0].T
    return directions, sight.image.bearings[matched], sight.image.pixel[matched]


class RotationPoses:
    """Rotations that a search has found so far, best first.

    Attributes:
        sight: The problem.
        found: Rotations.
        iterations: Number of image points that were tried.
    """

    def __init__(self, sight: Sight) -> None:
        self.sight, self.found, self.iterations = sight, Hypotheses.empty(), 0

    def add(self, step: Step, found: Hypotheses) -> None:
        """Add the rotations that an image point proposed."""
        self.iterations += 1
        for k in range(len(found)):
            self.found = _merge(self.found, found[k : k + 1], self.sight)

    def may_be_decided(self) -> bool:
        """Return True: the verdict on a rotation is cheap."""
        return True

    def result(self, *, ended: bool = True) -> SearchResult:
        """Compute the verdict; a failed one is settled if a rotation of enough points would have been found."""
        settings, count = self.sight.settings, len(self.sight.image.bearings)
        result = _judge(self.found, self.sight, self.iterations)
        least = min(max(math.ceil(self.sight.least_share * count), FIXING_ROTATION + 1), count)
        hopeless = log10_missed(self.iterations, count, least, settings.power) <= DEFAULT.evidence.missed
        return replace(result, settled=result.verdict == "failed" and hopeless)


class RotationPlan:
    """Steps of a search for a rotation: the image points, one after the other.

    Args:
        poses: Rotations found so far.
        seed: Seed of the order; points with the largest scores come first.
    """

    def __init__(self, poses: RotationPoses, seed: int) -> None:
        bearings, scores = poses.sight.image.bearings, poses.sight.problem.scores2d
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
        none = np.empty(0, np.float32)
        return around, Rays(none, none, np.empty(0, np.int32), none, NO_LABELS), 0
    bins = 1 << int(np.clip(math.log2(2 * math.pi / float((slack / chord).max())), *INFINITY.bins))
    label, density = np.full(len(around), -1), np.full(len(around), sight.density)
    if len(sight.image.labels):
        label = sight.image.labels[around]
        density *= _shares_of_labels(sight.sky.labels, label)
    chance = np.minimum(density * 2 * slack * 2 * chord * 2 * math.pi / bins, SKY.crowded)
    azimuth = azimuths(bearings[i : i + 1], bearings[around][None])[0]
    low, high, nats = (x.astype(np.float32) for x in (chord - slack, chord + slack, np.log(SKY.matched / chance)))
    return around, Rays(low, high, azimuth, nats, label), bins


def _shares_of_labels(labels3d: Labels, label: Labels) -> Array:
    """Return the fraction (k,) of the directions that each label (k,) fits; at least one direction."""
    values, index = np.unique(label, return_inverse=True)
    count = np.array([len(labels3d) if each < 0 else ((labels3d == each) | (labels3d < 0)).sum() for each in values])
    return np.asarray(np.maximum(count, 1)[index] / len(labels3d))


def _possible(sight: Sight, i: int) -> Labels:
    """Return the indices of the directions that an image point may be, by its label and by the prior."""
    directions, problem = sight.catalogue.directions, sight.problem
    possible = np.ones(len(directions), np.bool_)
    if len(sight.image.labels) and sight.image.labels[i] >= 0:
        possible &= (sight.sky.labels == sight.image.labels[i]) | (sight.sky.labels < 0)
    if sight.is_near and problem.prior is not None:
        bearing = sight.image.bearings[i]
        if isinstance(problem.prior, PosePrior):
            angle, sigma = 0.0, problem.prior.rotation_sigma_deg
            axis = bearing @ np.asarray(problem.prior.rotation)
        else:
            camera, axis = problem.prior.directions()
            angle, sigma = float(np.arccos(np.clip(bearing @ camera, -1, 1))), problem.prior.sigma_deg
        off = np.abs(np.arccos(np.clip(directions @ axis, -1, 1)) - angle)
        possible &= off <= ENUMERATION.sigmas * math.radians(sigma) + INFINITY.anchor_off
    return np.flatnonzero(possible)


def _is_admitted(sight: Sight, rotation: Array) -> bool:
    """Return whether a proposed rotation (3, 3) is as near to the prior as the true one should be."""
    prior = sight.problem.prior
    if not sight.is_near or prior is None:
        return True
    if isinstance(prior, PosePrior):
        off, sigma = rotation_angle(rotation, np.asarray(prior.rotation, np.float64)), prior.rotation_sigma_deg
    else:
        camera, scene = prior.directions()
        off, sigma = math.acos(float(np.clip(camera @ rotation @ scene, -1, 1))), prior.sigma_deg
    return off <= ENUMERATION.sigmas * math.radians(sigma) + INFINITY.proposed_off


def _agreeing(sight: Sight, i: int, around: Labels, rays: Rays, bins: int) -> Iterator[tuple[Array, int]]:
    """Propose rotations that the neighbours of an image point support.

    Yields:
        Rotation (3, 3), most votes first, and the index of the farthest image point that supports it.
    """
    settings, neighbours = sight.settings, sight.catalogue.neighbours
    shift = (TURN // bins).bit_length() - 1
    places, bin_of, labels = _possible(sight, i), np.empty(0, np.int64), sight.sky.labels
    scores = None if sight.problem.scores3d is None else np.log(sight.problem.scores3d)
    for used, most in ((settings.first, settings.promising), (len(around), settings.refined)):
        value, bin_of = np.empty(len(places), np.float32), np.empty(len(places), np.int64)
        vote(
            neighbours,
            labels,
            places,
            Rays._make(values[:used] for values in rays),
            shift,
            np.empty(bins, np.float32),
            value,
            bin_of,
        )
        if scores is not None:
            value = value + scores[places]
        best = np.argpartition(-value, most)[:most] if len(places) > most else np.arange(len(places))
        best = best[np.argsort(-value[best], kind="stable")]
        places, bin_of = places[best], bin_of[best]
    low, high, azimuth = rays.low[:, None], rays.high[:, None], rays.azimuth[:, None]
    for a, c in zip(places.tolist(), bin_of.tolist(), strict=True):
        chord, turned = neighbours.chord[a], ((neighbours.azimuth[a] - azimuth) & (TURN - 1)) >> shift
        agrees = (chord >= low) & (chord <= high) & ((c - turned) & (bins - 1) < 2)
        if len(labels):
            label = labels[neighbours.place[a]]
            agrees &= (rays.label[:, None] == label) | (rays.label[:, None] < 0) | (label < 0)
        if agrees.any(1).sum() >= FIXING_ROTATION:
            k, e = np.nonzero(agrees)
            seen, directions = np.r_[i, around[k]], np.r_[a, neighbours.place[a, e]]
            left, _, right = np.linalg.svd(sight.image.bearings[seen].T @ sight.catalogue.directions[directions])
            rotation = left * [1, 1, np.linalg.det(left @ right)] @ right  # least squares
            if _is_admitted(sight, rotation):
                yield rotation, int(seen[-1])


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
    information = weight.sum() * np.eye(3) - (weight[:, None] * two).T @ two
    state, scratch = Fit(rotation, information, np.full(m, -1), np.full(m, np.inf)), np.empty((4, 3))
    fit(image, near, sight.sky, sight.reach, settings.rounds, state, scratch)
    nats = fit(image, some, sight.sky, sight.reach, settings.last_rounds, state, scratch)
    best = 0.0 if found.evidence is None else max(settings.contests * float(found.evidence[0]) * len(some) / m, 0.0)
    if nats <= best or _is_same(sight, found.rotation, state.rotation, some).any():
        return None
    nats = fit(image, np.arange(m), sight.sky, sight.reach, settings.last_rounds, state, scratch)
    if (state.match >= 0).sum() <= FIXING_ROTATION:
        return None
    left, _, right = np.linalg.svd(state.rotation)
    rotation, match = left @ right, state.match
    if sight.problem.odds2d is not None:
        match = np.where(sight.problem.may_match(np.arange(m), match), match, -1)
    squared = np.where(match >= 0, state.squared, np.inf)
    fraction = sight.problem.log10_prior_fraction(rotation, np.zeros(3))
    density = sight.densities(match) / sight.odds(match)
    alarms, nats_of_points = log10_false_alarms(squared, density, sight.background, fraction)
    return Hypotheses.from_poses(
        rotation[None],
        np.zeros((1, 3)),
        log_likelihood=nats_of_points.mean(keepdims=True),
        match_count=(match >= 0).sum(keepdims=True),
        log10_false_alarms=np.array([alarms]),
        evidence=np.array([nats]),
        matches=match[None],
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
    return every[(every.log10_false_alarms < 0) | (np.arange(len(every)) == 0)][: DEFAULT.kept]


def _shift_between_parts(found: Hypotheses, sight: Sight) -> float:
    """Return the largest shift, pixels, between the best rotation and one that explains another part of the image.

    With the right camera one rotation explains all stars, and the other image points fit none better than chance. With
    another camera, such as a fisheye of another focal length, different rotations fit different parts of the image.

    Args:
        found: Rotations, best first, with their matches and the evidence of the image points.
        sight: The problem.

    Returns:
        Shift of the points that only the other rotation matches; 0 if none is significant by the points that the best
            one does not match.
    """
    assert found.matches is not None
    assert found.point_evidence is not None
    largest, matched = 0.0, found.matches[0] >= 0
    for k in range(1, len(found)):
        rest = float(found.log10_false_alarms[k] + found.point_evidence[k, matched].sum() / math.log(10))
        if rest <= DEFAULT.evidence.false_alarms:
            alone = ~matched & (found.matches[k] >= 0)
            bearings = sight.image.bearings[alone]
            moved = bearings - bearings @ found.rotation[k] @ found.rotation[0].T
            largest = max(largest, float((np.linalg.norm(moved, axis=-1) / sight.image.pixel[alone]).max(initial=0)))
    return largest


def _judge(found: Hypotheses, sight: Sight, iterations: int) -> SearchResult:
    """Judge rotations, best first, by the rules of `bpnp.search.verdict.decide`."""
    verdict_settings = DEFAULT.evidence
    if found.matches is None or found.point_evidence is None:
        return no_pose("no rotation was found", iterations)
    alarms = float(found.log10_false_alarms[0])
    result = SearchResult(found, "confident", "", iterations, CONFIDENT)
    if fits_by_chance(alarms):
        return result.add_objection(objection("chance", what="no rotation fits"), "failed")
    if alarms > verdict_settings.false_alarms:
        return result.as_insignificant(verdict_settings.false_alarms)
    margin = float(found.log10_false_alarms[1]) - alarms if len(found) > 1 else math.inf
    if margin < verdict_settings.margin:
        return result.add_objection(objection("competing_rotation", margin))
    hit = np.flatnonzero(found.matches[0] >= 0)
    worth = found.point_evidence[0, hit] / math.log(10)
    most = float(worth.mean() + 2 * worth.std() / math.sqrt(len(hit)))  # largest for a competing rotation
    least = max(math.ceil((float(worth.sum()) - verdict_settings.margin) / most), FIXING_ROTATION + 1)
    count = len(sight.image.bearings)
    missed = log10_missed(iterations, count, min(least, count), sight.settings.power)
    if missed > verdict_settings.missed:
        return result.add_objection(objection("incomplete", what="rotation", probability=reasons.number(missed)))
    apart = _shift_between_parts(found, sight)
    if apart > sight.reach:
        return result.add_objection(objection("other_camera_by_pixels", pixels=apart))
    directions, bearings, pixel = _matches(sight, found)
    some = np.linspace(0, len(hit) - 1, min(len(hit), sight.settings.strained)).astype(np.int64)
    strain = strain_of(directions[some], bearings[some], pixel[some], sight.image.bearings)
    if strain > sight.reach:
        return result.add_objection(objection("other_camera_by_pixels", pixels=strain))
    bound = how_well_known(directions, bearings, pixel, information=prior_information(sight.problem)).bound
    if not math.isfinite(bound):
        return result.add_objection(objection("rotation_not_fixed", count=len(hit), what="it"))
    return replace(result, reason=reasons.confident(alarms, verdict_settings.margin, math.degrees(bound)))
