"""What speaks against a pose: every alternative that was met, and by how many decades the pose is likelier.

Another pose; the same pose at residuals far larger than those of its matches; another focal length or other proportions
of the scene. The poses that repeated structures confuse with it are made by `bpnp.search.evidence.repetitions` and are
then other poses like those that were met.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from bpnp.geometry import turned_by
from bpnp.search.candidates import Candidates
from bpnp.search.evidence.false_alarms import directions_of, own_evidence
from bpnp.search.evidence.image_statistics import label_groups
from bpnp.search.evidence.settings import Evidence
from bpnp.search.evidence.uncertainty import Linearised, Misfit, systematic_misfit
from bpnp.search.point_sets import PointSets

Array = NDArray[np.float64]


Seen = Sequence[tuple[Candidates, PointSets]]


class Alternative(NamedTuple):
    """decades: by which the best pose is likelier. what: the alternative in words, as the end of "..., but"."""

    decades: float
    what: str


def other_pose(candidates: Candidates, sets: PointSets, rule: Evidence) -> Alternative | None:
    """The different pose with the fewest false alarms; None if there is none.

    Different: turned by more than `other_deg`, or the middle of the scene moved by more than `other_shift` of its
    distance.
    """
    same = sets.same_pose(candidates.rotation, candidates.translation, rule.other_deg, rule.other_shift)
    others = np.flatnonzero(~same)
    if not len(others):
        return None
    k = int(others[np.argmin(candidates.log10_false_alarms[others])])
    decades = float(candidates.log10_false_alarms[k] - candidates.log10_false_alarms[0])
    return fits_as_well(candidates.rotation[0], candidates.rotation[k], decades)


def fits_as_well(rotation: Array, other: Array, decades: float) -> Alternative:
    """A different pose, whose false alarms are so many decades above those of the first one."""
    off = math.degrees(turned_by(rotation, other))
    return Alternative(decades, f"a pose {off:.0f} deg away fits about as well ({number(decades)} times the number)")


def rougher(candidates: Candidates) -> Alternative | None:
    """The best pose at scales far beyond that of its residuals, where the points agree with it better there: what its
    matches say of it beyond a rough alignment is then no more than chance. None otherwise."""
    decades = float(candidates.log10_rough[0] - candidates.log10_false_alarms[0])
    if decades >= 0:
        return None
    return Alternative(decades, "the points agree with it better at residuals far larger than those of its matches")


def misfit(linear: Linearised | None, count: float, rule: Evidence) -> Alternative | None:
    """Another focal length or other proportions of the scene, where these explain the residuals significantly better
    and with them the pose would be a different one; None otherwise.

    count: of the matches. Where the focal length cannot be told, the camera is believed as it was given; where another
    one is significantly better and moves the middle of the scene by more than `rule.other_shift`, the pose is in doubt.
    """
    return of_misfit(systematic_misfit(linear, count, rule), rule)


def of_misfit(off: Misfit, rule: Evidence) -> Alternative | None:
    """The alternative that is so far off; None where it is the same pose."""
    if math.degrees(off.turn) <= rule.other_deg and off.shift <= rule.other_shift:
        return None
    other = f"{off.zoom:.2f} times the focal length" if off.zoom != 1 else "other proportions of the scene"
    away = f"{math.degrees(off.turn):.0f} deg and {100 * off.shift:.0f} % of the distance away"
    return Alternative(-math.inf, f"with {other} they fit significantly better, {away}")


def contesting(seen: Seen, rule: Evidence) -> Alternative | None:
    """The far candidate over which the first one leads least, if points that depend on each other are counted once.

    The number of false alarms takes image points as independent. Points on lines or curves are not: a pose that lays
    one line onto another explains all of its points, and that it explains more of them than another pose does is then
    chance. With d_i the evidence of image point i for the one pose less that for the other, and either sign of each
    d_i as likely (Hoeffding 1963)

        P(sum_i d_i >= z sqrt(sum_i d_i^2)) <= exp(-z^2 / 2).

    Where even equal signs of all d_i would be no less likely than the lead asks for, there are too few points to tell.

    A pose that sees half of its partners where the first one sees its own is compared by its false alarms alone: it is
    that pose, its mirror image, or repeats it in a repeated structure. Not so if it also explains points that the first
    one does not, half as many as it leaves unexplained: both then slide along a curve.

    seen: the candidates and the points of a camera, of each camera of a rig; those with too few points are left out.

    Source: W. Hoeffding, Probability inequalities for sums of bounded random variables, JASA 1963.
    """
    limits, least = rule.contested, 2 * math.log(10) * rule.lead
    seen = [(candidates, sets) for candidates, sets in seen if len(sets.image.chosen) >= least]
    if not seen:
        return None
    candidates, sets = seen[0]
    poses, chosen = (candidates.rotation, candidates.translation), sum(len(each.image.chosen) for _, each in seen)
    others = np.flatnonzero(~sets.same_pose(*poses, limits.far * rule.other_deg, limits.far * rule.other_shift))
    # A lead that would be no chance if all gaps were as large as they can be needs no second look.
    decisive = limits.most * math.sqrt(least * chosen) / math.log(10)
    others = others[candidates.log10_false_alarms[others] - candidates.log10_false_alarms[0] < decisive]
    if not len(others):
        return None
    scales = np.maximum(candidates.scale, sets.image.scales[0])
    best, first = _explained(seen, 0, scales[0], limits.near)
    for k in others.tolist():
        evidence, other = _explained(seen, k, scales[k], limits.near)
        gap = best - evidence
        squared = float((gap**2).sum())
        if float(np.abs(gap).sum()) ** 2 < least * squared:
            continue
        reach = limits.near * max(scales[0], scales[k]) * np.linalg.norm(first.places, axis=-1)
        same = (first.points == other.points) | (np.linalg.norm(first.places - other.places, axis=-1) < reach)
        alone, others_alone = int((first.near & ~other.near).sum()), int((other.near & ~first.near).sum())
        apart = others_alone >= limits.alone * alone and alone + others_alone >= least
        decades = max(float(gap.sum()), 0.0) ** 2 / max(squared, 1e-300) / (2 * math.log(10))
        if decades < rule.lead and (apart or (same & first.near & other.near).sum() < limits.same * other.near.sum()):
            degrees = _degrees(candidates, k)
            what = f"a pose {degrees:.0f} deg away explains so many other points that both may be chance"
            return Alternative(decades, what)
    return None


def number(log10: float) -> str:
    """10^x in words that can be read at a glance."""
    return f"{10**log10:.2g}" if -3 < log10 < 5 else f"1e{log10:.0f}"


def _degrees(candidates: Candidates, k: int) -> float:
    return math.degrees(turned_by(candidates.rotation[0], candidates.rotation[k]))


class _Partners(NamedTuple):
    """Of k image points: the scene point (k,) that a pose sees nearest, where it is in the camera's frame (k, 3), and
    whether it is near enough to be the partner."""

    points: NDArray[np.int64]
    places: Array
    near: NDArray[np.bool_]


def _explained(seen: Seen, k: int, scale: float, near: float) -> tuple[Array, _Partners]:
    """The evidence of the image points of all cameras for candidate k, with residuals of a scale, and their partners
    within `near` scales."""
    poses = [(sets, candidates.rotation[k], candidates.translation[k], scale) for candidates, sets in seen]
    parts = zip(*(_partners(near, *pose) for pose in poses), strict=True)
    return np.concatenate([own_evidence(*pose) for pose in poses]), _Partners(*map(np.concatenate, parts))


def _partners(near: float, sets: PointSets, rotation: Array, translation: Array, scale: float) -> _Partners:
    seen, chosen = directions_of(sets, rotation, translation), sets.image.chosen
    chord, points = np.full(len(chosen), np.inf), np.full(len(chosen), -1)
    for rows, columns in label_groups(chosen, sets.labels2d, sets.labels3d, len(seen)):
        ahead = columns[np.isfinite(seen[columns, 0])]
        if len(ahead):
            bearings = sets.bearings[chosen[rows]]
            chord[rows], nearest = cKDTree(seen[ahead]).query(bearings, distance_upper_bound=near * scale)
            points[rows] = np.r_[ahead, -1][nearest]
    return _Partners(points, sets.points3d[points] @ rotation.T + translation, np.isfinite(chord))
