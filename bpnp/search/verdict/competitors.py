"""Competing explanations of the points, with their margins.

A competing explanation is another pose, the same pose at far larger residuals, another focal length, or other
proportions of the scene. Competing poses of a repeated structure are proposed by `bpnp.search.propose.repetitions`
and are judged like any other pose.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from bpnp.arrays import Array, PoseArrays
from bpnp.poses import SAME, rotation_angle
from bpnp.search.hypotheses import Hypotheses
from bpnp.search.possible_matches import MATCH_REACH
from bpnp.search.problem import Problem, label_groups
from bpnp.search.verdict.false_alarms import directions_of, own_evidence
from bpnp.search.verdict.limits import LEAST_MARGIN
from bpnp.search.verdict.reasons import Objection, objection
from bpnp.search.verdict.uncertainty import Misfit

SHOWN_DEGREES = 0.5  # rotation below which the shift of a pose is shown instead [degrees; convention]
SHOWN_ZOOM = 0.005  # relative change of the focal length that is omitted [fraction; convention]
# Smallest distance of a far pose, in multiples of `SAME`; nearer poses slide along the same lines and surfaces.
FAR_TOLERANCES = 5.0  # [multiples of `SAME`; calibration]
# That of a match among 100 scene points at the finest scale.
MOST_POINT_NATS = 13.0  # largest evidence of an image point [nats; derived]
# A pose is no repetition of the best one from this ratio on: points that only it explains, over points that only the
# best one explains.
ALONE_RATIO = 0.5  # [ratio; calibration]
AGREEING_MATCHES = 0.5  # fraction of a pose's matches in common with the best one's: they agree [fraction; calibration]
BEND_DEG = 1.0  # rotation, degrees, from which poses with radial distortion are different [degrees; convention]
BEND_SHIFT = 0.02  # shift from which poses with radial distortion differ, in scene distances [fraction; convention]

WIDER_RADIUS = 8 / 3  # radius that is tried, and suggested, where residuals are rough [match radii; calibration]

CandidatesOfCameras = Sequence[tuple[Hypotheses, Problem]]


def other_pose(candidates: Hypotheses, problem: Problem) -> Objection | None:
    """Return the competing pose with the fewest false alarms, or None."""
    same = problem.same_as(candidates.pose(), candidates.rotation, candidates.translation, SAME)
    others = np.flatnonzero(~same)
    if not len(others):
        return None
    k = int(others[np.argmin(candidates.log10_false_alarms[others])])
    decades = float(candidates.log10_false_alarms[k] - candidates.log10_false_alarms[0])
    return competing_pose(problem, candidates.pose(), candidates.pose(k), decades)


def competing_pose(problem: Problem, best: PoseArrays, other: PoseArrays, decades: float) -> Objection:
    """Return a different pose as an objection.

    `decades` is log10 of the ratio of their false alarms.
    """
    return objection("competing_pose", decades, away=distance_between(problem, best, other))


def distance_between(problem: Problem, first: PoseArrays, second: PoseArrays) -> str:
    """Return the angle between two poses in words, or for equal rotations the shift of the scene centroid.

    Such as "12 deg" or "15 % of the distance", that of the scene centroid from the camera of the first pose.
    """
    degrees = math.degrees(rotation_angle(first[0], second[0]))
    if degrees >= SHOWN_DEGREES:
        return f"{degrees:.0f} deg"
    centre, moved = (rotation @ problem.centre3d + translation for rotation, translation in (first, second))
    shift = float(np.linalg.norm(moved - centre) / max(float(np.linalg.norm(centre)), 1e-300))
    return f"{100 * shift:.0f} % of the distance"


def rough_residuals(candidates: Hypotheses, problem: Problem) -> Objection | None:
    """Return the best pose at far larger residuals, or None if the points agree better at its own scale.

    If the rough alignment has fewer false alarms, the matches add nothing significant to it.
    """
    decades = float(candidates.log10_rough[0] - candidates.log10_false_alarms[0])
    if decades >= 0:
        return None
    threshold = WIDER_RADIUS * problem.match_radius * problem.measured.per_radian
    return objection("rough_residuals", decades, threshold=threshold)


def other_camera(off: Misfit) -> Objection | None:
    """Return another camera or other proportions of the scene as an objection, or None if their pose is the same."""
    limits = (BEND_DEG, BEND_SHIFT) if off.radial else (SAME.degrees, SAME.shift)
    if math.degrees(off.turn) <= limits[0] and off.shift <= limits[1]:
        return None
    other = f"{off.zoom:.2f} times the focal length" if off.zoom != 1 else "other proportions of the scene"
    if off.radial:
        also_zoom = f" and {off.zoom:.2f} times the focal length" if abs(off.zoom - 1) > SHOWN_ZOOM else ""
        other = f"a radial distortion of {off.radial:.2g}{also_zoom}"
    return objection("other_camera", camera=other, degrees=math.degrees(off.turn), percent=100 * off.shift)


def unrelated_competitor(cameras: CandidatesOfCameras) -> Objection | None:
    """Return a far candidate whose likelihood is not significantly below that of the first one, or None."""
    margins = sign_margins(cameras)
    weaker = np.flatnonzero(margins < LEAST_MARGIN)
    if not len(weaker):
        return None
    k, (candidates, problem) = int(weaker[0]), cameras[0]
    away = distance_between(problem, candidates.pose(), candidates.pose(k))
    return objection("other_points", max(float(margins[k]), 0.0), away=away)


def sign_margins(cameras: CandidatesOfCameras) -> Array:
    """Compute the margins of the first candidate over far ones by a sign test of the evidence of the image points.

    The number of false alarms assumes independent image points. Points on lines or curves are dependent: a pose that
    aligns one line with another explains all its points. A pose may then explain more points than another one by
    chance. Let d_i be the evidence of image point i for the one pose less that for the other. If either sign of each
    d_i is equally likely (Hoeffding 1963),

        P(sum_i d_i >= z sqrt(sum_i d_i^2)) <= exp(-z^2 / 2).

    If even equal signs of all differences would not reach the required margin, the points are too few for this test.

    A pose is compared by its false alarms alone if half of its correspondences coincide with those of the first pose.
    It is then that pose, its mirror image, or a repetition of it. Of a mirror image from afar, they coincide up to the
    order of their depths. The exception is a pose that explains other points as well, at least half as many as it
    leaves unexplained: both poses then slide along a curve, or see two places, and the scene lacks other points of
    each. The margins (c,) are in decades, negative if the other candidate explains more; infinite where there is no
    such test. Cameras with too few points are left out.

    Source: W. Hoeffding, Probability inequalities for sums of bounded random variables, JASA 1963.
    """
    least = 2 * math.log(10) * LEAST_MARGIN
    margins = np.full(len(cameras[0][0]), math.inf)
    cameras = [(candidates, problem) for candidates, problem in cameras if len(problem.image.chosen) >= least]
    if not cameras:
        return margins
    candidates, problem = cameras[0]
    poses, chosen = (candidates.rotation, candidates.translation), sum(len(each.image.chosen) for _, each in cameras)
    others = np.flatnonzero(~problem.same_as(candidates.pose(), *poses, SAME.times(FAR_TOLERANCES)))
    # A margin that is significant even with the largest possible gaps needs no test.
    decisive = MOST_POINT_NATS * math.sqrt(least * chosen) / math.log(10)
    others = others[candidates.log10_false_alarms[others] - candidates.log10_false_alarms[0] < decisive]
    if not len(others):
        return margins
    scales = np.maximum(candidates.scale, problem.image.scales[0])
    best, first = _explained(cameras, 0, scales[0], MATCH_REACH)
    for k in others.tolist():
        evidence, other = _explained(cameras, k, scales[k], MATCH_REACH)
        gap = best - evidence
        squared = float((gap**2).sum())
        if float(np.abs(gap).sum()) ** 2 < least * squared:
            continue
        reach = MATCH_REACH * max(scales[0], scales[k]) * np.linalg.norm(first.places, axis=-1)
        same = (first.points == other.points) | (np.linalg.norm(first.places - other.places, axis=-1) < reach)
        same |= _with_reversed_depths(first, other, reach)
        alone, others_alone = int((first.near & ~other.near).sum()), int((other.near & ~first.near).sum())
        apart = others_alone >= ALONE_RATIO * alone and alone + others_alone >= least
        if apart or (same & first.near & other.near).sum() < AGREEING_MATCHES * other.near.sum():
            total = float(gap.sum())
            margins[k] = total * abs(total) / max(squared, 1e-300) / (2 * math.log(10))
    return margins


class Partners(NamedTuple):
    """Nearest scene points of k image points under a pose."""

    points: NDArray[np.int64]  # (k,) indices of the scene points, -1 if none is near
    places: Array  # (k, 3) these points in the camera's frame
    near: NDArray[np.bool_]  # (k,) True if the point is near enough to be the correspondence


def _explained(cameras: CandidatesOfCameras, k: int, scale: float, near: float) -> tuple[Array, Partners]:
    """Return the evidence of the image points of all cameras for candidate k, and their correspondences.

    A correspondence is within `near` scales, radians, of its image point.
    """
    poses = [(problem, *candidates.pose(k), scale) for candidates, problem in cameras]
    parts = zip(*(partners(near, *pose) for pose in poses), strict=True)
    return np.concatenate([own_evidence(*pose) for pose in poses]), Partners(*map(np.concatenate, parts))


def _with_reversed_depths(first: Partners, other: Partners, reach: Array) -> NDArray[np.bool_]:
    """Return which image points (k,) have correspondences that only the order of their depths distinguishes.

    The one is then the mirror image of the other in a plane across the line of sight, and differs from it by more than
    `reach` (k,). Depths are relative to their mean over the image points that both poses explain.
    """
    both = first.near & other.near
    if not both.any():
        return both
    centre = first.places[both].mean(0)
    sight = centre / max(float(np.linalg.norm(centre)), 1e-300)
    one, two = (places @ sight - float((places[both] @ sight).mean()) for places in (first.places, other.places))
    return np.asarray((np.abs(one + two) < reach) & (np.abs(one - two) >= reach))


def partners(near: float, problem: Problem, rotation: Array, translation: Array, scale: float) -> Partners:
    """Return the nearest scene points of the used image points under a pose, at most `near` scales away."""
    directions, chosen = directions_of(problem, rotation, translation), problem.image.chosen
    chord, points = np.full(len(chosen), np.inf), np.full(len(chosen), -1)
    if problem.labelled_pairs is not None:
        i, j = problem.labelled_pairs
        distance = np.linalg.norm(problem.bearings[chosen[i]] - directions[j], axis=-1)
        distance = np.where(distance < near * scale, distance, np.inf)  # infinite for unseen points too
        order = np.lexsort((distance, i))
        rows, first = np.unique(i[order], return_index=True)
        chord[rows] = distance[order][first]
        points[rows] = np.where(np.isfinite(chord[rows]), j[order][first], -1)
        return Partners(points, problem.points3d[points] @ rotation.T + translation, np.isfinite(chord))
    for rows, columns in label_groups(chosen, problem.labels2d, problem.labels3d, len(directions)):
        ahead = columns[np.isfinite(directions[columns, 0])]
        if len(ahead):
            bearings = problem.bearings[chosen[rows]]
            chord[rows], nearest = cKDTree(directions[ahead]).query(bearings, distance_upper_bound=near * scale)
            points[rows] = np.r_[ahead, -1][nearest]
    return Partners(points, problem.points3d[points] @ rotation.T + translation, np.isfinite(chord))
