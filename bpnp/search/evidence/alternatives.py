"""What speaks against a pose: every alternative that was met, and by how many decades the pose is likelier; and the
probability that a better one was not met (`log10_missed`).

Met are another pose; the same pose at residuals far larger than those of its matches; another focal length or other
proportions of the scene. The poses that repeated structures confuse with it are made by
`bpnp.search.evidence.repetitions` and are then other poses like those that were met.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from bpnp.poses import turned_by
from bpnp.search.evidence import reasons
from bpnp.search.evidence.false_alarms import directions_of, own_evidence
from bpnp.search.evidence.settings import Evidence
from bpnp.search.evidence.uncertainty import Linearised, Misfit, systematic_misfit
from bpnp.search.hypotheses import Hypotheses
from bpnp.search.problem import Problem, label_groups

SAME_ZOOM = 0.005  # change of the focal length that is not worth a word
Array = NDArray[np.float64]
Seen = Sequence[tuple[Hypotheses, Problem]]


class Alternative(NamedTuple):
    """A competing explanation.

    Attributes:
        decades: by which the best pose is likelier (log10).
        what: the explanation in words, a clause.
    """

    decades: float
    what: str


def other_pose(candidates: Hypotheses, problem: Problem, rule: Evidence) -> Alternative | None:
    """The different pose with the fewest false alarms; None if there is none.

    Different: farther apart than `Evidence.same`.
    """
    same = problem.same_pose(candidates.rotation, candidates.translation, rule.same)
    others = np.flatnonzero(~same)
    if not len(others):
        return None
    k = int(others[np.argmin(candidates.log10_false_alarms[others])])
    decades = float(candidates.log10_false_alarms[k] - candidates.log10_false_alarms[0])
    return fits_as_well(candidates.rotation[0], candidates.rotation[k], decades)


def fits_as_well(rotation: Array, other: Array, decades: float) -> Alternative:
    """A different pose, whose false alarms are so many decades above those of the first one."""
    off = math.degrees(turned_by(rotation, other))
    return Alternative(decades, reasons.competing(off, decades))


def rougher(candidates: Hypotheses) -> Alternative | None:
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
    one is significantly better and moves the middle of the scene by more than `rule.same.shift`, the pose is in doubt.
    """
    return of_misfit(systematic_misfit(linear, count, rule), rule)


def of_misfit(off: Misfit, rule: Evidence) -> Alternative | None:
    """The alternative that is so far off; None where it is the same pose."""
    limits = (rule.zoomed.bend_deg, rule.zoomed.bend_shift) if off.radial else (rule.same.degrees, rule.same.shift)
    if math.degrees(off.turn) <= limits[0] and off.shift <= limits[1]:
        return None
    other = f"{off.zoom:.2f} times the focal length" if off.zoom != 1 else "other proportions of the scene"
    if off.radial:
        zoomed = f" and {off.zoom:.2f} times the focal length" if abs(off.zoom - 1) > SAME_ZOOM else ""
        other = f"a radial distortion of {off.radial:.2g}{zoomed}"
    away = f"{math.degrees(off.turn):.0f} deg and {100 * off.shift:.0f} % of the distance away"
    return Alternative(-math.inf, f"with {other} the points fit significantly better, by a pose {away}")


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
    seen = [(candidates, problem) for candidates, problem in seen if len(problem.image.chosen) >= least]
    if not seen:
        return None
    candidates, problem = seen[0]
    poses, chosen = (candidates.rotation, candidates.translation), sum(len(each.image.chosen) for _, each in seen)
    others = np.flatnonzero(~problem.same_pose(*poses, rule.same.times(limits.far)))
    # A lead that would be no chance if all gaps were as large as they can be needs no second look.
    decisive = limits.most * math.sqrt(least * chosen) / math.log(10)
    others = others[candidates.log10_false_alarms[others] - candidates.log10_false_alarms[0] < decisive]
    if not len(others):
        return None
    scales = np.maximum(candidates.scale, problem.image.scales[0])
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
            degrees = math.degrees(turned_by(candidates.rotation[0], candidates.rotation[k]))
            what = f"a pose {degrees:.0f} deg away explains other points, as many as two unrelated poses do by chance"
            return Alternative(decades, what)
    return None


class _Partners(NamedTuple):
    """Of k image points: the scene point (k,) that a pose sees nearest, where it is in the camera's frame (k, 3), and
    whether it is near enough to be the partner."""

    points: NDArray[np.int64]
    places: Array
    near: NDArray[np.bool_]


def _explained(seen: Seen, k: int, scale: float, near: float) -> tuple[Array, _Partners]:
    """The evidence of the image points of all cameras for candidate k, with residuals of a scale, and their partners
    within `near` scales."""
    poses = [(problem, candidates.rotation[k], candidates.translation[k], scale) for candidates, problem in seen]
    parts = zip(*(_partners(near, *pose) for pose in poses), strict=True)
    return np.concatenate([own_evidence(*pose) for pose in poses]), _Partners(*map(np.concatenate, parts))


def _partners(near: float, problem: Problem, rotation: Array, translation: Array, scale: float) -> _Partners:
    seen, chosen = directions_of(problem, rotation, translation), problem.image.chosen
    chord, points = np.full(len(chosen), np.inf), np.full(len(chosen), -1)
    if problem.labelled_pairs is not None:
        i, j = problem.labelled_pairs
        distance = np.linalg.norm(problem.bearings[chosen[i]] - seen[j], axis=-1)
        distance = np.where(distance < near * scale, distance, np.inf)  # also where a point is not seen
        order = np.lexsort((distance, i))
        rows, first = np.unique(i[order], return_index=True)
        chord[rows] = distance[order][first]
        points[rows] = np.where(np.isfinite(chord[rows]), j[order][first], -1)
        return _Partners(points, problem.points3d[points] @ rotation.T + translation, np.isfinite(chord))
    for rows, columns in label_groups(chosen, problem.labels2d, problem.labels3d, len(seen)):
        ahead = columns[np.isfinite(seen[columns, 0])]
        if len(ahead):
            bearings = problem.bearings[chosen[rows]]
            chord[rows], nearest = cKDTree(seen[ahead]).query(bearings, distance_upper_bound=near * scale)
            points[rows] = np.r_[ahead, -1][nearest]
    return _Partners(points, problem.points3d[points] @ rotation.T + translation, np.isfinite(chord))


def log10_missed(
    basin_count: int, decades_a_match: float, looks: float | int, rule: Evidence, *, symmetric: bool = False
) -> float:
    """log10 of the probability that a better optimum than the best pose exists and was not met.

    It lies near the best pose or far from it, and what the matches say counts against both:

        P = 10^(-3 e) (max(2^-h, q) F G^(l - 1) + q 2^-h)

    - Starts. Let a better optimum attract a start as often as the best pose does, or more often. Of h independent
      starts that ended at one of the two, all ended at the best pose with a probability of at most 2^-h.
    - Near. Starts that share a wide optimum end at whichever narrow one lies in their way: however many they are, a
      better one lies beside it with the probability q. A look, starts drawn on purpose around the best pose, fails to
      meet it with the probability F, and each one after that with G, since looks miss the same optima; without a look
      F G^(l - 1) is 1.
    - Far. A pose that exceeds chance and is far from a better one is a rare repetition or symmetry: q.
    - Matches. A pose with a better one elsewhere explains a part of the points by coincidence: it aligns a part of the
      scene, or slides along a surface, and each of its matches is worth little. With e decades of evidence a match, a
      match is a coincidence with a probability of 10^-e. Matches depend on each other; but three fix a pose, and at
      least as many others have to be independent coincidences: 10^-3e.

    The first is what remains of the posterior of unseen optima of Boender and Rinnooy Kan where only two optima matter.
    Source: C. G. E. Boender, A. H. G. Rinnooy Kan, Bayesian stopping rules for multistart global optimization methods,
    Math. Programming 1987.

    basin_count: independent starts that ended at the best pose, or at a neighbour that is no different pose.
    decades_a_match: of its evidence, 0 where its matches are no evidence of each other, as in repeated structures.
    looks: how often its surroundings were searched in vain.

    >>> rule = Evidence()
    >>> [round(log10_missed(*seen, rule), 2) for seen in ((0, 0.0, 0), (7, 0.0, 0), (7, 0.0, 1), (1, 1.0, 0))]
    [0.0, -2.0, -3.24, -3.3]
    """
    unseen = near_missed(basin_count, looks, rule) + far_missed(basin_count, rule, symmetric=symmetric)
    return min(math.log10(unseen) - rule.independent * max(decades_a_match, 0.0), 0.0)


def near_missed(basin_count: int, looks: float | int, rule: Evidence) -> float:
    """Probability that a better optimum beside the best pose was not met."""
    overlooked = rule.look_fails * rule.again_fails ** (looks - 1) if looks else 1.0
    return max(0.5**basin_count, rule.another) * overlooked


def far_missed(basin_count: int, rule: Evidence, *, symmetric: bool = False) -> float:
    """Return the probability that a better optimum far from the best pose was not met: without the prior probability
    that there is one where the scene is symmetric."""
    return (rule.uncompared if symmetric else rule.another) * 0.5**basin_count
