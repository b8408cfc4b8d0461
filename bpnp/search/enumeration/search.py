"""The enumeration as a search: candidates with their likelihood, and an end when the verdict on them is certain."""

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bpnp.loops.parallel import Deadline
from bpnp.search.candidates import Candidates
from bpnp.search.enumeration.points import predicted_pose
from bpnp.search.enumeration.poses import EnumeratedPoses, enumerate_poses, margin
from bpnp.search.enumeration.settings import DEFAULT, EnumerationSettings
from bpnp.search.point_sets import PointSets
from bpnp.search.settings import SearchSettings
from bpnp.search.verdict import is_certain, weighed

Array = NDArray[np.float64]


def is_enumerable(sets: PointSets, rule: EnumerationSettings = DEFAULT) -> bool:
    """Whether the points have so few hypotheses that they are enumerated."""
    products = len(sets.bearings) * len(sets.points3d)
    return products <= (rule.most_products if sets.pairs_that_fix == 3 else rule.most_products_known)


def exceeds_enumeration(sets: PointSets) -> bool:
    """Whether there are more points than are enumerated without a prior; with one the enumeration may miss a pose."""
    return not is_enumerable(replace(sets, prior=None))


class Enumerated(NamedTuple):
    """What an enumeration found, and how it ended.

    candidates: in the user's coordinates, best first. exhausted: whether every hypothesis of these points was tried.
    safe: whether it ended before that, since the best pose was certain.
    """

    candidates: Candidates
    exhausted: bool
    safe: bool


def search_by_enumeration(
    sets: PointSets, deadline: Deadline, settings: SearchSettings, rule: EnumerationSettings = DEFAULT
) -> Enumerated:
    """Enumerate the poses of few points.

    Where the whole pose is known closely, as when a device is tracked, it is tried, and if it does not hold the search
    goes everywhere; where it is known roughly, the search goes everywhere if no pose near it exceeds chance.
    """
    certain: Candidates | None = None
    annotated = sets
    if sets.cosines3d is not None:
        sets = replace(sets, normals3d=None, cosines3d=None)

    def is_safe(poses: EnumeratedPoses) -> bool:
        nonlocal certain
        candidates = weighed(_candidates(poses, annotated, settings, rule), sets, settings.evidence)
        certain = candidates if is_certain(candidates, sets, settings.evidence) else None
        return certain is not None

    def enumerated(sets: PointSets, rule: EnumerationSettings) -> tuple[EnumeratedPoses, Candidates]:
        radius = rule.radius_at(sets.floor)
        poses = enumerate_poses(sets, radius=radius, deadline=deadline.at, is_safe=is_safe, settings=rule)
        return poses, _candidates(poses, annotated, settings, rule) if certain is None else certain

    tracked = predicted_pose(sets.prior) is not None
    near = tracked and sets.pairs_that_fix == 2
    poses, candidates = enumerated(sets, replace(rule, stages=()) if near else rule)
    if certain is None and tracked and (near or margin(poses, rule) < 0):
        poses, others = enumerated(replace(sets, prior=None), rule)
        candidates = Candidates.concatenated([candidates, others])
        candidates = candidates[np.argsort(-candidates.score, kind="stable")[: settings.kept]]
    return Enumerated(candidates, certain is None and poses.ended == "exhausted", certain is not None)


def _candidates(
    poses: EnumeratedPoses, sets: PointSets, settings: SearchSettings, rule: EnumerationSettings
) -> Candidates:
    """The poses that are not far less likely than the best one; scale and likelihood as the annealing defines them."""
    rivals = poses.evidence >= (poses.evidence.max() if len(poses.evidence) else 0.0) - rule.near_nats
    rivals &= np.arange(len(rivals)) < settings.kept
    rotation, translation, residual = (x[rivals] for x in (poses.rotation, poses.translation, poses.residual))
    matched = np.isfinite(residual)
    count = matched.sum(-1)
    free = np.maximum(2 * count - 2 * poses.fixing, 1)  # numbers that were measured, less those that were fitted
    scale = np.sqrt((np.where(matched, residual, 0.0) ** 2).sum(-1) / free)
    scale = np.maximum(scale, sets.floor or 1e-5)
    score = _log_likelihood(sets, rotation, translation, scale, settings)
    share = count / min(len(sets.bearings), len(sets.points3d))
    return replace(Candidates.unscored(rotation, translation), score=score, matched=share, scale=scale)


def _log_likelihood(
    sets: PointSets, rotation: Array, translation: Array, scale: Array, settings: SearchSettings
) -> Array:
    """Mean log-likelihood of the bearings under the mixture of `search_poses` for each pose (c,), nats, as the
    annealing has it: in units in which a kernel is 1 / s^2 where it is largest, with scores, labels and visibility.
    """
    camera = sets.points3d @ rotation.transpose(0, 2, 1) + translation[:, None]
    seen = camera / np.maximum(np.linalg.norm(camera, axis=-1, keepdims=True), 1e-300)
    m, n = len(sets.bearings), len(sets.points3d)
    weight2d = np.ones(m) if sets.scores2d is None else sets.scores2d
    weight3d = np.ones(n) if sets.scores3d is None else sets.scores3d
    fits = np.ones((m, n), np.bool_)
    if sets.labels2d is not None and sets.labels3d is not None:
        fits = (sets.labels2d[:, None] == sets.labels3d) | (sets.labels2d[:, None] < 0) | (sets.labels3d < 0)
    weight2d, weight3d = weight2d * fits.any(1), weight3d * fits.any(0)
    odds = fits @ weight3d / max(float(weight3d.sum()), 1e-12)
    if (cones := sets.cones3d) is not None:
        facing = -(cones[:, :3] @ rotation.transpose(0, 2, 1) * seen).sum(-1) - cones[:, 3]
        weight3d = weight3d * np.clip(0.5 + facing / (2 * settings.facing.softness), settings.facing.unseen, 1)
    variance = (scale**2)[:, None, None]
    cosine = np.minimum(sets.bearings @ seen.transpose(0, 2, 1), 1)  # beyond 1 where bearings are units in float32 only
    kernel = fits * np.exp((cosine - 1) / variance) / variance
    explained = (kernel @ (weight3d / weight3d.sum(-1, keepdims=True))[..., None])[..., 0]
    outliers = 2 * math.pi * settings.outliers / sets.image.solid_angle * np.maximum(odds, 1e-6)
    return np.asarray(np.log((1 - settings.outliers) * explained + outliers) @ weight2d / weight2d.sum())
