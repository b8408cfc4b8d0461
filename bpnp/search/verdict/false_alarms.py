"""A-contrario number of false alarms (NFA) of a pose, for 4 points or 10,000.

docs/verdict.md derives it and defines its letters; lambda is the inlier fraction:

    log10 NFA = log10 T - log10 mean_{s, lambda} prod_i x_i^(1 / c_i)

What that page leaves out:

- The three largest x_i are left out for any c_i.
- At a scale s with fewer distinguishable poses, T is their number (`PoseModel.log10_cells`). If the focal length is
  fitted too, four matches fix the seven unknowns, and an eighth, a radial coefficient; T is also limited to that of a
  pose times the number of distinguishable lenses.
- A clump has more points within 2 s' than an even spread explains, and its location is one observation. There, the gain
  of log x_i from one scale to the next finer one s' counts with 1 / c_i(s'), over its expected value
  (`ImageStatistics.weights`).
- With a prior the NFA keeps its bound. For unrelated points the fraction F of poses that are as near to the prior
  exceeds a uniform variable, and does not depend on the x_i. With x their product, P(F / x <= a) <= E[a x] <= a.
- If the scale of the residuals of a pose is given, only the s within a factor of two of it count. The terms from four
  times it on measure how well a rougher alignment explains the image.
- The likelihood ratio replaces the binomial tail of the sources, which loses the evidence of dense points, whose
  neighbours lie as close as their residuals.

Sources: A. Desolneux, L. Moisan, J.-M. Morel, Meaningful alignments, IJCV 2000; L. Moisan, B. Stival, A probabilistic
criterion to detect rigid point matches, IJCV 2004.
"""

import math
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bpnp.arrays import Array, Labels
from bpnp.search.image_statistics import ImageStatistics
from bpnp.search.kernels.neighbours import sums_near
from bpnp.search.pose_model import PoseModel
from bpnp.search.problem import Problem, faces, label_groups

# Inlier fractions lambda over which the likelihood ratio is averaged. Finer steps give the same evidence in twice the
# time.
INLIER_FRACTIONS = (0.15, 0.4, 0.75)  # [fractions; measured, the problems are not recorded]
LEAST_INLIERS = 0.02  # smallest lambda if clutter or scores are given [fraction; convention]
MOST_INLIERS = 0.98  # largest lambda if clutter or scores are given [fraction; convention]
# The outline beyond it is no evidence.
OUTLINE_WIDTH = 0.5  # smoothing width of unrelated points [RMS angular radii; not tuned]
SMOOTHED_POINTS = 256  # largest number of projected points from which that density is estimated [points; cost]
FARTHEST_PAIR = math.sqrt(18.0)  # distance beyond which a pair adds nothing to a density: e^-9 [scales; numerics]
OWN_SCALES = 2.0  # largest factor of a scale to that of the residuals that is a pose's own [factor; convention]
ROUGH_SCALES = 4.0  # least factor between scales at which residuals are rougher [factor; convention]


SHARES = np.array(INLIER_FRACTIONS)  # lambda


class Terms(NamedTuple):
    """Evidence of the k image points of one camera for a pose, at S scales and W fractions."""

    logs: Array  # (k, S, W) log x_i / c_i, clumps weighted
    together: NDArray[Any]  # (k, S) c_i
    own: NDArray[np.bool_]  # (S,) True at the scales of the residuals of the pose
    rough: NDArray[np.bool_]  # (S,) True at far larger scales
    pairs: int  # number of pairs (s, lambda) over which the mean is taken, including those of omitted finer scales
    fewer: Array  # (S,) log of the number of tests at each scale, over the number of all

    def by_scale(self, left_out: int) -> Array:
        """Return log of sum_w prod_i x_i^(1 / c_i) / pairs at each scale (S,), without the `left_out` largest x_i."""
        evidence = self.logs.sum(0) - sum_of_largest(self.logs * self.together[:, :, None], left_out)
        return np.asarray(np.logaddexp.reduce(evidence, 1) - math.log(self.pairs) - self.fewer)

    def of_points(self) -> Array:
        """Return the logs (k,) at the own scale and the fraction with the largest sum."""
        own = self.logs[:, self.own].reshape(len(self.logs), -1)
        return np.asarray(own[:, own.sum(0).argmax()])

    def evidence(self, left_out: int) -> Array:
        """Return the log evidence (2,) at the own and at the rough scales, without the `left_out` largest x_i."""
        each = self.by_scale(left_out)
        return np.array([np.logaddexp.reduce(each[some], initial=-math.inf) for some in (self.own, self.rough)])


def log10_nfa(
    cameras: Sequence[Terms | None], log10_tests: float, fixing: Sequence[Sequence[int]]
) -> tuple[float, float]:
    """Compute log10 NFA of a pose at the scales of the residuals, and at rougher ones.

        NFA = T / prod_cameras mean_{s, lambda} prod_i x_i^(1 / c_i)

    The formula holds for a rotation, a pose, a pose with a focal length and a rig. They differ in the number T of tests
    and in the number of matches that fix them, which are no evidence. `fixing` has the ways to choose these, each as
    their number in each camera; the way that leaves the least evidence counts. The logs of the cameras add up.
    """
    counts = {count for way in fixing for count in way}
    none = np.zeros(2)
    each = [{count: none if one is None else one.evidence(count) for count in counts} for one in cameras]
    ways = [sum((logs_of[count] for logs_of, count in zip(each, way, strict=True)), none) for way in fixing]
    own, rough = log10_tests - np.min(ways, 0) / math.log(10)
    return float(own), float(rough)


class Alarms(NamedTuple):
    """log10 NFA (c,) of poses at the scales of their own residuals, and at rougher ones."""

    own: Array
    rough: Array


def alarms_of(problem: Problem, rotations: Array, translations: Array, scales: Array | None = None) -> Alarms:
    """Compute log10 NFA of poses.

    A pose that sees at most as many points as fix it has no evidence: its NFA is the number of tests. Several sets of
    scene points multiply the number of tests (`Problem.log10_views`). Without `scales` (c,) of the residuals, radians,
    all scales count as a pose's own.

    >>> import numpy as np
    >>> points = np.random.default_rng(0).uniform(-1, 1, (12, 3))
    >>> in_camera = points + [0, 0, 6]
    >>> problem = Problem(in_camera / np.linalg.norm(in_camera, axis=1, keepdims=True), points)
    >>> alarms = alarms_of(problem, np.stack([np.eye(3)] * 2), np.array([[0.0, 0, 6], [0.3, 0, 5]])).own
    >>> bool(alarms[0] < -10), bool(alarms[1] > 0)
    (True, True)
    """
    model, image = PoseModel.of(problem), problem.image
    tests = model.log10_tests([problem])
    cells = np.minimum(model.log10_cells(image.spread, image.scales, image.solid_angle), tests)
    poses = zip(rotations, translations, strict=True)
    fraction = np.array([problem.log10_prior_fraction(*pose) for pose in poses])
    none = np.maximum(tests + fraction, 0.0)
    result = Alarms(none, none.copy())
    for k in range(len(none)):
        directions = directions_of(problem, rotations[k], translations[k])
        # Fewer tests at a scale add evidence by their ratio to all tests; a prior leaves at least one test.
        fewer = math.log(10) * (np.maximum(cells + fraction[k], 0.0) - none[k])
        scale = None if scales is None else float(scales[k])
        terms = camera_terms(problem, directions, scale, fewer=fewer)
        result.own[k], result.rough[k] = log10_nfa([terms], float(none[k]), model.fixing_ways())
    return Alarms(result.own + problem.log10_views, result.rough + problem.log10_views)


def directions_of(problem: Problem, rotation: Array, translation: Array) -> Array:
    """Return unit directions (n, 3) in the camera's frame; NaN for points at the camera centre or facing away."""
    camera = problem.points3d @ rotation.T + translation
    length = np.linalg.norm(camera, axis=-1, keepdims=True)
    directions = np.divide(camera, length, out=np.full_like(camera, np.nan), where=length > 0)
    if problem.normals3d is not None:
        directions[~faces(problem.normals3d, problem.cosines3d, camera, rotation)] = np.nan
    return directions


def camera_terms(
    problem: Problem, directions: Array, scale: float | None = None, *, fewer: Array | float = 0.0
) -> Terms | None:
    """Return the evidence of one camera.

    They begin at the finest own scale; all scales are own ones if that of the residuals, radians, is None. Directions
    (n, 3) are NaN for points that are not seen; None if no more points are seen than fix the pose. `fewer` (S,) is the
    log of the number of tests at each scale of the image, over the number of all.
    """
    if min(len(problem.bearings), int(np.isfinite(directions[:, 0]).sum())) <= PoseModel.of(problem).fixing:
        return None
    ratio = np.ones(len(problem.image.scales)) if scale is None else _ratio(problem.image, scale)
    own, rough = _is_own(ratio), ratio >= ROUGH_SCALES
    finest = int(own.argmax())
    logs, less = _terms(problem, directions, finest), np.broadcast_to(fewer, own.shape)[finest:]
    pairs = len(own) * logs.shape[2]
    return Terms(logs, problem.image.together[:, finest:], own[finest:], rough[finest:], pairs, less)


def own_evidence(problem: Problem, rotation: Array, translation: Array, scale: float) -> Array:
    """Return log x_i / c_i (k,) of each chosen image point under a pose, clumps weighted; natural logs.

    It is taken at the inlier fraction lambda and the scale s, radians, with the largest sum, s within a factor of two
    of the given one. It is 0 if too few points are seen.
    """
    terms = camera_terms(problem, directions_of(problem, rotation, translation), scale)
    return np.zeros(len(problem.image.chosen)) if terms is None else terms.of_points()


def likeliest_scale(problem: Problem, rotation: Array, translation: Array) -> float:
    """Return the scale of the residuals, radians, with the most evidence; the largest scale if there is none."""
    terms = camera_terms(problem, directions_of(problem, rotation, translation))
    return float(problem.image.scales[-1 if terms is None else terms.by_scale(PoseModel.of(problem).fixing).argmax()])


def _ratio(image: ImageStatistics, scale: float) -> Array:
    """Return the ratios (S,) of the scales of an image to the scale of residuals."""
    return np.asarray(image.scales / np.clip(scale, image.scales[0], image.scales[-1]))


def _is_own(ratio: Array) -> NDArray[np.bool_]:
    return (ratio >= 1 / OWN_SCALES) & (ratio <= OWN_SCALES)


def match_shares(problem: Problem) -> Array:
    """Return the inlier fractions lambda (W,) that are tried.

    With scores they are (k, 1, W), in proportion to the score of each chosen point and of the scene points that its
    label admits.
    """
    shares = SHARES if problem.clutter is None else np.array([1 - problem.clutter])
    if problem.scores2d is not None:
        shares = shares * (problem.scores2d[problem.image.chosen] / problem.scores2d.mean())[:, None, None]
    if problem.candidate_scores is not None:
        shares = shares * problem.candidate_scores[problem.image.chosen][:, None, None]
    elif problem.clutter is None and problem.scores2d is None:
        return shares
    return np.asarray(np.clip(shares, LEAST_INLIERS, MOST_INLIERS))


def _terms(problem: Problem, directions: Array, finest: int) -> Array:
    """Return log x_i / c_i (k, S', W), clumps weighted, at the scales from index `finest` on."""
    image = problem.image
    return np.asarray(
        image.weights[:, finest:, finest:]
        @ point_evidence(problem, directions, image.scales[finest:], match_shares(problem))
    )


def sum_of_largest(values: Array, count: int) -> Array:
    """Return the sum of the `count` largest values (k, ...), negative ones as 0.

    Equal values make a partition slow; a few maxima are faster.
    """
    rest, total = values.copy(), np.zeros(values.shape[1:])
    for _ in range(count):
        largest = rest.argmax(0)[None]
        total += np.maximum(np.take_along_axis(rest, largest, 0)[0], 0)
        np.put_along_axis(rest, largest, -math.inf, 0)
    return total


def point_evidence(problem: Problem, directions: Array, scales: Array, shares: Array, *, even: bool = False) -> Array:
    """Return log x_i (k, S, W) of each chosen image point, at scales s (S,) and fractions lambda (W,) or (k, 1, W).

    Scales are in radians. Directions (n, 3) of scene points that are not seen are NaN. With `even`, unrelated image
    points are assumed to fall evenly over the view instead of with the density of `directions`.
    """
    image = problem.image
    predicted, smooth, inside, every = _sums(problem, directions, scales, even)
    # A point without possible correspondences has no density; it counts as one with no scene point near.
    density = (np.where(every > 0, every, 1) if even else np.maximum(inside, 1)) / image.solid_angle
    ratio = predicted / (2 * math.pi * scales**2 * np.maximum(density, smooth)[:, None])
    return np.asarray(np.log1p(shares * (ratio - 1)[:, :, None]))


def _sums(problem: Problem, directions: Array, scales: Array, even: bool) -> tuple[Array, Array, Array, Array]:
    """Sum kernels and counts over the possible correspondences of each chosen image point.

    Return kernels (k, S) of the standard deviations `scales` (S,), radians; the density (k,) of the outline, 0 if
    `even`; and the numbers (k,) in view and of all. Directions (n, 3) are NaN for points that are not seen.
    """
    image, count = problem.image, len(problem.image.chosen)
    weight = np.ones(len(directions)) if problem.scores3d is None else problem.scores3d / problem.scores3d.mean()
    in_view, ahead = np.zeros(len(directions), np.bool_), np.flatnonzero(np.isfinite(directions[:, 0]))
    across = (np.abs((directions[ahead] - image.centre) @ image.axes) <= image.half_widths).all(-1)
    in_view[ahead] = across & (directions[ahead] @ image.centre > 0)
    if problem.labelled_pairs is not None:
        return _sums_of_pairs(problem, *problem.labelled_pairs, directions, weight, in_view, scales, even)
    predicted, smooth, inside, every = np.zeros((count, len(scales))), np.zeros(count), np.zeros(count), np.zeros(count)
    for rows, columns, odds, share in _partners(problem, weight):
        ahead = np.isfinite(directions[columns, 0])
        every[rows] += odds * share.sum()
        inside[rows] += odds * share[in_view[columns]].sum()
        used, share, bearings = directions[columns][ahead], share[ahead], problem.bearings[image.chosen[rows]]
        near = sums_near(bearings, used, image.axes, FARTHEST_PAIR * scales, 0.5 / scales**2, share)
        predicted[rows] += odds[:, None] * near
        if not even:
            smooth[rows] += odds * _smoothed(image, bearings, used, share)
    return predicted, smooth, inside, every


def _sums_of_pairs(
    problem: Problem,
    i: Labels,
    j: Labels,
    directions: Array,
    weight: Array,
    in_view: NDArray[np.bool_],
    scales: Array,
    even: bool,
) -> tuple[Array, Array, Array, Array]:
    """Compute `_sums` over given pairs (p,) of a chosen image point and a scene point."""
    count = len(problem.image.chosen)
    every, inside = (np.asarray(np.bincount(i, of[j], count), np.float64) for of in (weight, weight * in_view))
    ahead = np.isfinite(directions[j, 0])
    i, j = i[ahead], j[ahead]
    squared = ((problem.bearings[problem.image.chosen[i]] - directions[j]) ** 2).sum(-1)
    near = (np.where(squared < (FARTHEST_PAIR * s) ** 2, np.exp(-0.5 * squared / s**2), 0.0) for s in scales.tolist())
    predicted = np.stack([np.bincount(i, weight[j] * kernel, count) for kernel in near], -1)
    width2 = (OUTLINE_WIDTH * problem.image.spread) ** 2
    outline = weight[j] * np.exp(-0.5 * squared / width2) / (2 * math.pi * width2)
    smooth = np.zeros(count) if even else np.asarray(np.bincount(i, outline, count), np.float64)
    return np.asarray(predicted, np.float64), smooth, inside, every


def _partners(problem: Problem, weight: Array) -> Iterator[tuple[Labels, Labels, Array, Array]]:
    """Iterate over groups of possible correspondences: one per label, or all points once per class.

    Yield indices (k,) of chosen image points and (n,) of scene points, and probabilities of the class for the image
    points (k,), and for the scene points times their weight (n,); they are 1 without classes.
    """
    chosen, n = problem.image.chosen, len(weight)
    if problem.odds2d is None or problem.classes3d is None:
        for rows, columns in label_groups(chosen, problem.labels2d, problem.labels3d, n):
            yield rows, columns, np.ones(len(rows)), weight[columns]
        return
    for odds, share in zip(problem.odds2d[chosen].T, problem.classes3d.T, strict=True):
        yield np.arange(len(chosen)), np.arange(n), odds, weight * share


def _smoothed(image: ImageStatistics, bearings: Array, directions: Array, share: Array) -> Array:
    """Return the weighted directions per steradian around each bearing, smoothed by `OUTLINE_WIDTH` radii."""
    step = -(-len(directions) // SMOOTHED_POINTS) or 1
    some, share = directions[::step], share[::step]
    if not len(some):
        return np.zeros(len(bearings))
    width2 = (OUTLINE_WIDTH * image.spread) ** 2
    # Relative to the centre of the view, float32 is precise enough for a narrow one.
    one, other = ((points - image.centre) / math.sqrt(2 * width2) for points in (bearings, some))
    one = np.column_stack([2 * one, -(one * one).sum(1), np.ones(len(one))]).astype(np.float32)
    other = np.column_stack([other, np.ones(len(other)), -(other * other).sum(1)]).astype(np.float32)
    exponent = one @ other.T
    kernel = (np.exp(exponent, out=exponent) @ share.astype(np.float32)).astype(np.float64)
    return np.asarray(kernel / (2 * math.pi * width2) * (len(directions) / len(some)))
