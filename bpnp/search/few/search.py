"""The enumeration as a search: candidates with their likelihood, and an end when the verdict on them is certain."""

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from bpnp.compilation import Deadline
from bpnp.search.candidates import Candidates
from bpnp.search.few.knowledge import pairs_that_fix, predicted_pose
from bpnp.search.few.poses import SETTINGS, FewPoses, enumerate_poses, margin
from bpnp.search.point_sets import PointSets, solid_angle
from bpnp.search.settings import SearchSettings
from bpnp.search.starts import GravityPrior, PosePrior
from bpnp.search.verdict import SearchResult, is_certain, judged, weighed

Array = NDArray[np.float64]
FEW_PAIRS = 4000  # pairs of an image point and a scene point up to which near triples are enumerated: 60 x 60
KNOWN_PAIRS = 250_000  # the same where a prior lets two pairs fix a pose
FLOORS = 30.0  # radius of a match in smallest believable scales: 3 pixels where that is a tenth of one
RADIUS = 3e-3  # radians, where no scale is known
MATCHED_SCALES = 3.0  # distance of a matched point, in scales of the residuals
NEAR_NATS = 25.0  # of evidence: a pose that has so much less than the best is no rival


def is_few(sets: PointSets) -> bool:
    """Whether the points have so few hypotheses that they are enumerated."""
    pairs = len(sets.bearings) * len(sets.points3d)
    return pairs <= (FEW_PAIRS if pairs_that_fix(sets.prior) == 3 else KNOWN_PAIRS)


def search_few(sets: PointSets, deadline: Deadline, settings: SearchSettings) -> tuple[Candidates, bool]:
    """Candidates in the user's coordinates, likeliest first, and whether every hypothesis was tried.

    Where the whole pose is known closely, as when a device is tracked, it is tried, and if it does not hold the search
    goes everywhere; where it is known roughly, the search goes everywhere if no pose near it exceeds chance.
    """

    certain = False

    def is_safe(found: FewPoses) -> bool:
        nonlocal certain
        candidates = weighed(_candidates(found, sets, settings), sets, settings.evidence)
        certain = is_certain(candidates, sets, settings.evidence, exhaustive=True)
        return certain

    radius = RADIUS if sets.floor is None else FLOORS * sets.floor
    tracked = predicted_pose(sets.prior) is not None
    near = tracked and pairs_that_fix(sets.prior) == 2
    chosen = SETTINGS._replace(stages=()) if near else SETTINGS
    found = enumerate_poses(sets, radius=radius, deadline=deadline.at, is_safe=is_safe, settings=chosen)
    candidates = _candidates(found, sets, settings)
    if certain or not tracked or not (near or margin(found) < 0):
        return candidates, found.exhausted
    free = enumerate_poses(replace(sets, prior=None), radius=radius, deadline=deadline.at, is_safe=is_safe)
    candidates = Candidates.concatenated([candidates, _candidates(free, sets, settings)])
    return candidates[np.argsort(-candidates.score, kind="stable")[: settings.kept]], free.exhausted


def judged_few(sets: PointSets, few: Candidates, settings: SearchSettings) -> SearchResult:
    """The verdict on enumerated poses; one that its matches leave loose is ambiguous: its neighbours fit as well."""
    result = judged(few, sets, batches=0, exhaustive=True, rule=settings.evidence)
    if result.verdict != "confident":
        return result
    # The scale itself is uncertain: of so few residuals it may be half of what it should be.
    count = float(result.candidates.matched[0]) * min(len(sets.bearings), len(sets.points3d))
    measured = max(2 * count - 2 * pairs_that_fix(sets.prior), 1.0)
    scale = result.residual * (1 + 1 / math.sqrt(measured))
    sigma = math.degrees(rotation_sigma(sets, *result.best, scale))
    if sigma <= settings.evidence.loose_deg:
        return result
    reason = f"the pose fits, but so few and near matches leave its rotation loose: {sigma:.1f} deg, one sigma"
    return replace(result, verdict="ambiguous", reason=reason)


def rotation_sigma(sets: PointSets, rotation: Array, translation: Array, scale: float) -> float:
    """Standard deviation of the rotation about its least certain axis, radians, from noise of `scale` radians.

    (J^T J)^-1 scale^2 of the directions of the matched points, J by the turn and the shift of the points' middle, with
    what the prior adds; infinite if the matches do not fix the pose.
    """
    turned = sets.points3d @ rotation.T
    camera = turned + translation
    depth = np.linalg.norm(camera, axis=-1)
    seen = camera / depth[:, None]
    if sets.normals3d is not None:
        seen[(seen * (sets.normals3d @ rotation.T)).sum(-1) >= 0] = np.inf
    near = np.linalg.norm(sets.bearings[:, None] - seen, axis=-1)
    partner = near.argmin(1)
    partner = np.unique(partner[near.min(1) < MATCHED_SCALES * scale])
    if not len(partner):
        return math.inf
    u, p = seen[partner], turned[partner] - turned[partner].mean(0)
    across = (np.eye(3) - u[:, :, None] * u[:, None, :]) / depth[partner, None, None]
    jacobian = np.concatenate([np.cross(p[:, None], across, axisb=2, axisc=2), across], -1).reshape(-1, 6)
    information = jacobian.T @ jacobian / scale**2
    prior = sets.prior
    if isinstance(prior, GravityPrior):
        up = np.asarray(prior.up_camera, np.float64) / np.linalg.norm(prior.up_camera)
        information[:3, :3] += (np.eye(3) - np.outer(up, up)) / math.radians(prior.sigma_deg) ** 2
    elif isinstance(prior, PosePrior):
        information[:3, :3] += np.eye(3) / math.radians(prior.rotation_sigma_deg) ** 2
    # The shift is eliminated; what is left of the rotation's information has the least certain axis' eigenvalue.
    shift = information[3:, 3:] + 1e-12 * np.trace(information[3:, 3:]) * np.eye(3)
    rest = information[:3, :3] - information[:3, 3:] @ np.linalg.solve(shift, information[3:, :3])
    least = float(np.linalg.eigvalsh(rest)[0])
    return 1 / math.sqrt(least) if least > 0 else math.inf


def _candidates(found: FewPoses, sets: PointSets, settings: SearchSettings) -> Candidates:
    """The poses that are not far less likely than the best one; scale and likelihood as the annealing defines them."""
    rivals = found.evidence >= (found.evidence.max() if len(found.evidence) else 0.0) - NEAR_NATS
    rivals &= np.arange(len(rivals)) < settings.kept
    rotation, translation, residual = (x[rivals] for x in (found.rotation, found.translation, found.residual))
    count = np.isfinite(residual).sum(-1)
    free = np.maximum(2 * count - 2 * found.used, 1)  # numbers that were measured, less those that were fitted
    scale = np.sqrt(np.where(np.isfinite(residual), residual, 0.0) ** 2 @ np.ones(len(sets.bearings)) / free)
    scale = np.maximum(scale, sets.floor or 1e-5)
    return Candidates(
        rotation=rotation,
        translation=translation,
        score=_log_likelihood(sets, rotation, translation, scale, settings.outliers),
        matched=count / min(len(sets.bearings), len(sets.points3d)),
        scale=scale,
        hits=np.zeros(len(rotation), np.int64),
        log10_false_alarms=np.full(len(rotation), math.nan),
    )


def _log_likelihood(sets: PointSets, rotation: Array, translation: Array, scale: Array, outliers: float) -> Array:
    """Mean log-likelihood of the bearings under the mixture of `search_poses`, for each pose (c,), nats."""
    camera = sets.points3d @ rotation.transpose(0, 2, 1) + translation[:, None]
    seen = camera / np.maximum(np.linalg.norm(camera, axis=-1, keepdims=True), 1e-300)
    variance = (scale**2)[:, None, None]
    exponent = (np.einsum("mk,cnk->cmn", sets.bearings, seen) - 1) / variance
    density = (np.exp(exponent) / (2 * math.pi * variance)).sum(-1) * (1 - outliers) / len(sets.points3d)
    return np.asarray(np.log(density + outliers / solid_angle(sets.bearings)).mean(-1))
