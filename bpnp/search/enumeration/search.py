"""The enumeration as a search: candidates with their likelihood, and an end when the verdict on them is certain."""

from dataclasses import replace

import numpy as np

from bpnp.loops.parallel import Deadline
from bpnp.search.candidates import Candidates
from bpnp.search.enumeration.points import predicted_pose
from bpnp.search.enumeration.poses import EnumeratedPoses, enumerate_poses, margin
from bpnp.search.enumeration.settings import DEFAULT, EnumerationSettings
from bpnp.search.evidence.partners import explained
from bpnp.search.point_sets import PointSets
from bpnp.search.settings import SearchSettings
from bpnp.search.verdict import is_certain, weighed


def is_enumerable(sets: PointSets, rule: EnumerationSettings = DEFAULT) -> bool:
    """Whether the points have so few hypotheses that they are enumerated."""
    products = len(sets.bearings) * len(sets.points3d)
    return products <= (rule.most_products if sets.pairs_that_fix == 3 else rule.most_products_known)


def exceeds_enumeration(sets: PointSets) -> bool:
    """Whether there are more points than are enumerated without a prior; with one the enumeration may miss a pose."""
    return not is_enumerable(replace(sets, prior=None))


def search_by_enumeration(
    sets: PointSets, deadline: Deadline, settings: SearchSettings, rule: EnumerationSettings = DEFAULT
) -> tuple[Candidates, bool]:
    """The poses of few points in the user's coordinates, best first; and whether every hypothesis was tried, or none
    needs to be, since the best pose is certain.

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
    return candidates, certain is not None or poses.ended == "exhausted"


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
    score = np.array([explained(sets, *each)[0] for each in zip(rotation, translation, scale, strict=True)])
    share = count / min(len(sets.bearings), len(sets.points3d))
    return replace(Candidates.unscored(rotation, translation), score=score, matched=share, scale=scale)
