"""Poses of known matches: labels that pair each image point with one scene point make a PnP problem.

P3P gives the poses of triples of matches. The best are refined on all matches (least squares), and on those that agree
with the pose (iterated weights of an inlier mixture), so that one wrong match does not spoil the others. The residual
may have any size: a search for matches within a radius would miss large ones.
"""

import math

import numpy as np

from bpnp.arrays import Array, Labels
from bpnp.poses import SAME, distinct, polar_coordinates
from bpnp.search.hypotheses import Hypotheses
from bpnp.search.pose_model import PoseModel
from bpnp.search.possible_matches import score_pose
from bpnp.search.problem import Problem
from bpnp.search.propose.minimal_solvers import p3p_poses
from bpnp.search.refine.gauss_newton import FIRST_DAMPING, match_equations, refine

FIXING = 3  # matches that fix a pose [matches; derived]
# With a fifth of the matches correct, all of them miss a correct triple 3 times in 10,000.
MOST_TRIPLES = 1000  # largest number of triples of given matches [triples; derived]
SCORED_MATCHES = 500  # number of given matches on which the poses of the triples are compared [matches; cost]
REFINED_TRIPLES = 6  # number of poses of triples that are refined [poses; not tuned]
REFINEMENT_STEPS = 10  # steps of a refinement to given matches [steps; numerics]
REWEIGHTINGS = 3  # number of reweightings of the given matches [rounds; not tuned]
WRONG_FRACTION = 0.1  # expected fraction of wrong given matches [fraction; not tuned]
SAME_OPTIMUM = 0.05  # difference within which refined poses are one optimum, in tolerances [fraction; not tuned]
SETTLED_CHANGE = 1e-6  # relative change of a sum of squares that ends the steps [ratio; numerics]
NEGLIGIBLE_SUM = 1e-24  # sum of squares that ends the steps [radians squared; numerics]


def known_matches(problem: Problem) -> tuple[Labels, Labels] | None:
    """Return the indices (k,) of the image and of the scene points that unique labels match, or None.

    None unless each point with a possible correspondence has exactly one, and there are more matches than fix a pose.

    >>> problem = Problem(np.eye(4, 3), np.eye(4, 3), labels2d=np.array([3, 2, 1, 0]), labels3d=np.arange(4))
    >>> known_matches(problem)
    (array([3, 2, 1, 0]), array([0, 1, 2, 3]))
    """
    if problem.labels2d is None or problem.labels3d is None or problem.odds2d is not None:
        return None
    if min(problem.labels2d.min(), problem.labels3d.min()) < 0:
        return None
    values, j, i = np.intersect1d(problem.labels3d, problem.labels2d, return_indices=True)
    counts = [np.isin(side, values).sum() for side in (problem.labels2d, problem.labels3d)]
    return (i, j) if FIXING < len(values) == counts[0] == counts[1] else None


def poses_of_matches(problem: Problem, i: Labels, j: Labels, seed: int = 0) -> Hypotheses:
    """Return distinct poses that more than three matches of image points i (k,) and scene points j (k,) fit best.

    These are the least-squares poses of all matches, then those of the matches that agree, each with the fewest
    residuals first; none if no triple has a pose. The seed is that of the triples, drawn where there are more than
    `MOST_TRIPLES`.
    """
    rays, points = problem.bearings[i], problem.points3d[j]
    centroid = points.mean(0)
    points = points - centroid  # rotation and translation are nearly independent about the centroid
    rng = np.random.default_rng(seed)
    triples = _triples(len(i), rng)
    poses = p3p_poses(rays[triples], points[triples]).reshape(-1, 4, 3)
    poses = poses[np.isfinite(poses).all((1, 2))]
    if not len(poses):
        return Hypotheses.empty()
    some = np.arange(len(i)) if len(i) <= SCORED_MATCHES else rng.choice(len(i), SCORED_MATCHES, replace=False)
    squared = _squared(rays[some], points[some], poses)
    scales = _scales(problem)
    density = 1 / problem.image.solid_angle
    agreeing, scale_of = _agreement(squared, scales, density)
    cost = np.sort(np.minimum(squared, 1.0), 1)[:, : -(len(some) // 4) or None].sum(1)
    every = poses[np.argsort(cost)[:REFINED_TRIPLES]]
    every = _refined(rays, points, every, np.ones((len(every), len(i))))
    best = np.argsort(-agreeing, kind="stable")[:REFINED_TRIPLES]
    fitted, scale = poses[best], scales[scale_of[best]]
    for _ in range(REWEIGHTINGS):
        squared = _squared(rays, points, fitted)
        weight = _inlier_probability(squared, scale[:, None], density)
        count = weight.sum(1)
        free = 2 * count - 2 * FIXING
        scale = np.clip(np.sqrt((weight * squared).sum(1) / np.maximum(free, 1e-3)), scales[0], scales[-1])
        enough = count > FIXING + 0.5
        fitted, scale, weight = fitted[enough], scale[enough], weight[enough]
        fitted = _refined(rays, points, fitted, weight, REFINEMENT_STEPS // 2)
    ends = []
    for group in (every, fitted):
        if len(group):
            left = _squared(rays, points, group)
            ends.append(group[np.argsort(np.median(left, 1) if group is fitted else left.sum(1), kind="stable")])
    poses = np.concatenate(ends) if ends else poses[:0]
    rotation = poses[:, :3]
    translation = poses[:, 3] - rotation @ centroid
    return _scored(problem, i, j, rotation, translation, scales)


def _triples(count: int, rng: np.random.Generator) -> Labels:
    """Return all triples (t, 3) of `count` matches, or `MOST_TRIPLES` of them."""
    if math.comb(count, 3) <= MOST_TRIPLES:
        a, b, c = np.meshgrid(*[np.arange(count)] * 3, indexing="ij")
        return np.argwhere((a < b) & (b < c))
    if count < 64:
        return np.argsort(rng.random((MOST_TRIPLES, count)), 1)[:, :3]
    return rng.integers(count, size=(MOST_TRIPLES, 3))


def _scales(problem: Problem) -> Array:
    """Return scales (S,) of residuals, radians: from the smallest of the image up to its RMS angular radius."""
    smallest = float(problem.image.scales[0])
    return np.geomspace(smallest, max(2 * smallest, problem.image.spread), 12)


def _squared(rays: Array, points: Array, poses: Array) -> Array:
    """Return squared distances (h, k) of unit rays (k, 3) from directions of points (k, 3) under poses (h, 4, 3)."""
    camera = points @ poses[:, :3].transpose(0, 2, 1) + poses[:, 3:]
    length = np.maximum(np.linalg.norm(camera, axis=-1, keepdims=True), 1e-300)
    return np.asarray(((camera / length - rays) ** 2).sum(-1))


def _inlier_probability(squared: Array, scale: Array, density: float) -> Array:
    """Return the probability that a residual belongs to an inlier, not to a point anywhere in view."""
    inlier = (1 - WRONG_FRACTION) * np.exp(-0.5 * squared / scale**2) / (2 * math.pi * scale**2)
    return np.asarray(inlier / (inlier + WRONG_FRACTION * density))


def _agreement(squared: Array, scales: Array, density: float) -> tuple[Array, Labels]:
    """Return the evidence (h,) of residuals (h, k), nats, at the scale where it is largest, and its index (h,).

    The three largest terms are left out: a triple fits its own pose exactly.
    """
    evidence = np.empty((len(squared), len(scales)))
    for s, scale in enumerate(scales.tolist()):
        kernel = np.exp(-0.5 * squared / scale**2) / (2 * math.pi * scale**2)
        terms = np.log(WRONG_FRACTION + (1 - WRONG_FRACTION) * kernel / density)
        evidence[:, s] = np.sort(terms, 1)[:, :-FIXING].sum(1)
    return evidence.max(1), evidence.argmax(1)


def _refined(rays: Array, points: Array, poses: Array, weights: Array, most: int = REFINEMENT_STEPS) -> Array:
    """Return poses (h, 4, 3) after Levenberg-Marquardt steps on weighted residuals of unit rays (k, 3)."""
    if not len(poses):
        return poses
    model = PoseModel(np.zeros(3))
    end = refine(
        model,
        model.state(poses[:, :3], poses[:, 3]),
        match_equations(model, rays, points, weights),
        [1.0] * most,
        settled=lambda last: bool((np.abs(last.gain) <= SETTLED_CHANGE * last.before.cost + NEGLIGIBLE_SUM).all()),
        damping=FIRST_DAMPING,
        adaptive=True,
    )
    return np.concatenate([end.state.rotation, end.state.centroid[:, None]], 1)


def _scored(problem: Problem, i: Labels, j: Labels, rotation: Array, translation: Array, scales: Array) -> Hypotheses:
    """Return the distinct poses with the scale of their residuals, and likelihood and match count at this scale."""
    poses = np.concatenate([rotation, translation[:, None]], 1)
    squared, density = _squared(problem.bearings[i], problem.points3d[j], poses), 1 / problem.image.solid_angle
    own = scales[_agreement(squared, scales, density)[1]]
    weight = _inlier_probability(squared, own[:, None], density)
    free = np.maximum(2 * weight.sum(1) - 2 * FIXING, 1.0)
    scale = np.clip(np.sqrt((weight * squared).sum(1) / free), scales[0], scales[-1])
    found = [score_pose(problem, *each) for each in zip(rotation, translation, scale, strict=True)]
    score, count = (np.array([one[k] for one in found]) for k in (0, 1))
    hypotheses = Hypotheses.from_poses(rotation, translation, log_likelihood=score, match_count=count, scale=scale)
    seen, order = polar_coordinates(rotation @ problem.centre3d + translation), -np.arange(float(len(score)))
    return hypotheses[distinct(rotation, seen, order, len(score), *SAME.times(SAME_OPTIMUM))]
