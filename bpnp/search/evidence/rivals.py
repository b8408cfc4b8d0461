"""Whether another pose explains other image points about as well: then both may be coincidences of dependent points."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from bpnp.search.candidates import Candidates
from bpnp.search.evidence.false_alarms import directions_of, own_evidence
from bpnp.search.evidence.thresholds import Evidence
from bpnp.search.point_sets import PointSets

Array = NDArray[np.float64]
NEAR = 3.0  # scales of the residuals within which an image point has a partner, and two partners are in one place
FAR = 5.0  # times as far as a different pose: nearer ones slide along the same lines and surfaces
MOST = 13.0  # nats of evidence of an image point: what 100 scene points leave to one that is met to the finest scale
OWN = 0.5  # of the points that the first pose alone explains: a pose that explains so many alone is no repetition of it
SAME = 0.5  # share of a pose's partners in the places of those of another from which both say the same of the scene


def contested_by(candidates: Candidates, sets: PointSets, rule: Evidence) -> int:
    """The place of a far candidate over which the first one leads by no more than chance; -1 if there is none.

    The number of false alarms takes image points as independent. Points on lines or curves are not: a pose that lays
    one line onto another explains all of its points, and that it explains more of them than another pose does is then
    chance. With d_i the evidence of image point i for the one pose less that for the other, and either sign of each
    d_i as likely (Hoeffding 1963)

        P(sum_i d_i >= z sqrt(sum_i d_i^2)) <= exp(-z^2 / 2).

    The pose is contested unless this is at most 10^-lead, as for 14 points or more that the one explains and the other
    does not. Where even equal signs of all d_i would be no less likely, there are too few points to tell.

    A pose that sees half of its partners where the first one sees its own is compared by its false alarms alone: it is
    that pose, its mirror image, or repeats it in a repeated structure. Not so if it also explains points that the first
    one does not, half as many as it leaves unexplained: both then slide along a curve.

    Source: W. Hoeffding, Probability inequalities for sums of bounded random variables, JASA 1963.
    """
    poses = candidates.rotation, candidates.translation
    others = np.flatnonzero(~sets.same_pose(*poses, FAR * rule.other_deg, FAR * rule.other_shift))
    least = 2 * math.log(10) * rule.lead
    if not len(others) or len(sets.image.chosen) < least:
        return -1
    scales = np.maximum(candidates.scale, sets.image.scales[0])
    # A lead that would be no chance if all gaps were as large as they can be needs no second look.
    decisive = MOST * math.sqrt(least * len(sets.image.chosen)) / math.log(10)
    others = others[candidates.log10_false_alarms[others] - candidates.log10_false_alarms[0] < decisive]
    if not len(others):
        return -1
    best = own_evidence(sets, *(x[0] for x in (*poses, scales)))
    first = _partners(sets, *(x[0] for x in (*poses, scales)))
    for k in others.tolist():
        gap = best - own_evidence(sets, *(x[k] for x in (*poses, scales)))
        squared = float((gap**2).sum())
        if max(float(gap.sum()), 0.0) ** 2 >= least * squared or float(np.abs(gap).sum()) ** 2 < least * squared:
            continue
        other = _partners(sets, *(x[k] for x in (*poses, scales)))
        reach = NEAR * max(scales[0], scales[k]) * np.linalg.norm(first.places, axis=-1)
        same = (first.points == other.points) | (np.linalg.norm(first.places - other.places, axis=-1) < reach)
        own, others_own = int((first.near & ~other.near).sum()), int((other.near & ~first.near).sum())
        apart = others_own >= OWN * own and own + others_own >= least
        if apart or (same & first.near & other.near).sum() < SAME * other.near.sum():
            return k
    return -1


class _Partners(NamedTuple):
    """Of k image points: the scene point (k,) that a pose sees nearest, where it is in the camera's frame (k, 3), and
    whether it is near enough to be the partner."""

    points: NDArray[np.int64]
    places: Array
    near: NDArray[np.bool_]


def _partners(sets: PointSets, rotation: Array, translation: Array, scale: float) -> _Partners:
    seen = directions_of(sets, rotation, translation)
    ahead = np.flatnonzero(np.isfinite(seen[:, 0]))
    chord, nearest = cKDTree(seen[ahead]).query(sets.bearings[sets.image.chosen], distance_upper_bound=NEAR * scale)
    points = np.r_[ahead, -1][nearest]
    return _Partners(points, sets.points3d[points] @ rotation.T + translation, np.isfinite(chord))
