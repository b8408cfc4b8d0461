"""The enumeration as a search: candidates with their likelihood, and an end when the verdict on them is certain."""

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from bpnp.loops.parallel import Deadline
from bpnp.search.candidates import Candidates
from bpnp.search.few.poses import SETTINGS, FewPoses, enumerate_poses, margin
from bpnp.search.few.priors import predicted_pose
from bpnp.search.point_sets import PointSets
from bpnp.search.settings import SearchSettings
from bpnp.search.verdict import is_certain, weighed

Array = NDArray[np.float64]
FEW_PAIRS = 4000  # pairs of an image point and a scene point up to which near triples are enumerated: 60 x 60
KNOWN_PAIRS = 250_000  # the same where a prior lets two pairs fix a pose
FLOORS = 30.0  # radius of a match in smallest believable scales: 3 pixels where that is a tenth of one
RADIUS = 3e-3  # radians, where no scale is known
NEAR_NATS = 25.0  # of evidence: a pose that has so much less than the best is no rival


def is_few(sets: PointSets) -> bool:
    """Whether the points have so few hypotheses that they are enumerated."""
    pairs = len(sets.bearings) * len(sets.points3d)
    return pairs <= (FEW_PAIRS if sets.pairs_that_fix == 3 else KNOWN_PAIRS)


def is_crowd(sets: PointSets) -> bool:
    """Whether there are more points than are enumerated without a prior; with one the enumeration may miss a pose."""
    return not is_few(replace(sets, prior=None))


def search_few(sets: PointSets, deadline: Deadline, settings: SearchSettings) -> tuple[Candidates, bool]:
    """Candidates in the user's coordinates, best first, and whether every hypothesis was tried.

    Where the whole pose is known closely, as when a device is tracked, it is tried, and if it does not hold the search
    goes everywhere; where it is known roughly, the search goes everywhere if no pose near it exceeds chance.
    """

    certain: Candidates | None = None
    if sets.cosines3d is not None:
        sets = replace(sets, normals3d=None, cosines3d=None)

    def is_safe(found: FewPoses) -> bool:
        nonlocal certain
        candidates = weighed(_candidates(found, sets, settings), sets, settings.evidence)
        certain = candidates if is_certain(candidates, sets, settings.evidence, exhaustive=True) else None
        return certain is not None

    radius = RADIUS if sets.floor is None else FLOORS * sets.floor
    tracked = predicted_pose(sets.prior) is not None
    near = tracked and sets.pairs_that_fix == 2
    chosen = SETTINGS._replace(stages=()) if near else SETTINGS
    found = enumerate_poses(sets, radius=radius, deadline=deadline.at, is_safe=is_safe, settings=chosen)
    candidates = _candidates(found, sets, settings) if certain is None else certain
    if certain is not None or not tracked or not (near or margin(found) < 0):
        return candidates, found.exhausted
    free = enumerate_poses(replace(sets, prior=None), radius=radius, deadline=deadline.at, is_safe=is_safe)
    candidates = Candidates.concatenated([candidates, _candidates(free, sets, settings)])
    return candidates[np.argsort(-candidates.score, kind="stable")[: settings.kept]], free.exhausted


def _candidates(found: FewPoses, sets: PointSets, settings: SearchSettings) -> Candidates:
    """The poses that are not far less likely than the best one; scale and likelihood as the annealing defines them."""
    rivals = found.evidence >= (found.evidence.max() if len(found.evidence) else 0.0) - NEAR_NATS
    rivals &= np.arange(len(rivals)) < settings.kept
    rotation, translation, residual = (x[rivals] for x in (found.rotation, found.translation, found.residual))
    count = np.isfinite(residual).sum(-1)
    free = np.maximum(2 * count - 2 * found.used, 1)  # numbers that were measured, less those that were fitted
    scale = np.sqrt(np.where(np.isfinite(residual), residual, 0.0) ** 2 @ np.ones(len(sets.bearings)) / free)
    scale = np.maximum(scale, sets.floor or 1e-5)
    score = _log_likelihood(sets, rotation, translation, scale, settings.outliers)
    matched = count / min(len(sets.bearings), len(sets.points3d))
    return replace(Candidates.unscored(rotation, translation), score=score, matched=matched, scale=scale)


def _log_likelihood(sets: PointSets, rotation: Array, translation: Array, scale: Array, outliers: float) -> Array:
    """Mean log-likelihood of the bearings under the mixture of `search_poses`, for each pose (c,), nats."""
    camera = sets.points3d @ rotation.transpose(0, 2, 1) + translation[:, None]
    seen = camera / np.maximum(np.linalg.norm(camera, axis=-1, keepdims=True), 1e-300)
    variance = (scale**2)[:, None, None]
    exponent = (sets.bearings @ seen.transpose(0, 2, 1) - 1) / variance
    density = (np.exp(exponent) / (2 * math.pi * variance)).sum(-1) * (1 - outliers) / len(sets.points3d)
    return np.asarray(np.log(density + outliers / sets.image.solid_angle).mean(-1))
