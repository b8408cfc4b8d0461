"""How likely a pose fits by chance: the a-contrario number of false alarms, for 4 points or 10,000.

The question: were the image points unrelated to the scene, how many of all the poses that could have been tried would
fit as well as this one? Unrelated means: at scales finer than h, half the spread of the bearings, image point i falls
with the density l_i of the projected points around it, wherever those happen to lie. A pose that explains it predicts
the mixture

    x_i = 1 - w + w g_i / l_i,    g_i = sum_j N(f_i - u_j; s^2),    l_i = max(sum_j N(f_i - u_j; h^2), n / A)

u_j the direction in which the pose sees scene point j, N the normal density on the tangent plane, s the scale of the
residuals, w the share of the image points that have a partner, n the projected points in the view and A its solid
angle. For unrelated points x_i has the mean 1, so that the product of the x_i exceeds a bound b with a probability of
at most 1 / b (Markov). From this follow

    log10 NFA = log10 T - log10 mean_{s, w} prod_i x_i^(1 / c_i),

T = 2 (m)_3 (n)_3 / 6, the number of poses that fit three matches exactly, (m)_3 = m (m - 1) (m - 2); at a scale s at
which fewer poses can be told apart, the number of these (`log10_cells`). The three largest x_i are left out, whatever
their c_i: three matches fix the six degrees of freedom and are no evidence. c_i is the number of image points within
2 s of point i: keypoints that lie together are one observation. So is the place of a clump: of log x_i, what is gained
from one scale to the next finer one s' counts with 1 / c_i(s'), over its expected value, where more points lie within
2 s' than an even spread explains (`ImageStatistics.weights`). The mean over a fixed set of (s, w) counts what was
looked at. A prior reduces T to the share of the poses that it allows.

Where the focal length is fitted too, four matches fix the seven unknowns, and an eighth, a radial coefficient:
T = 2 (m)_4 (n)_4 / 4!, or that of a pose times the number of lenses that can be told apart, if that is smaller; and
the four largest x_i are left out.

A pose claims that its points agree with it at the scale of its residuals. Where that is known, only the s within a
factor of two of it count; the terms from four times it on say how well a rougher alignment explains the image.

Sources: A. Desolneux, L. Moisan, J.-M. Morel, Meaningful alignments, IJCV 2000; L. Moisan, B. Stival, A probabilistic
criterion to detect rigid point matches, IJCV 2004. That the likelihood ratio takes the place of a binomial tail keeps
the evidence of dense points, whose neighbours lie as close as their residuals.
"""

import math
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bpnp.search.image_statistics import ImageStatistics
from bpnp.search.kernels.neighbours import sums_near
from bpnp.search.problem import Problem, faces, label_groups

Array = NDArray[np.float64]
Labels = NDArray[np.int64]

FIXING = 3  # matches that fix a pose; one more fixes a focal length or the scale of a rig's scene too
FIXING_ROTATION = 2  # matches that fix a rotation
SHARES = np.array([0.15, 0.4, 0.75])  # w
LEAST_SHARE, MOST_SHARE = 0.02, 0.98  # of w where clutter or scores are given
OUTLINE = 0.5  # width of the smoothing of l, in spreads of the bearings: the outline is no evidence beyond it
MOST_SMOOTHED = 256  # projected points from which l is estimated
FARTHEST = math.sqrt(18.0)  # distance over s beyond which a pair adds nothing to g
OWN, ROUGH = 2.0, 4.0  # factors of the scale of a pose's residuals within which s is its own, and beyond which rougher


class Terms(NamedTuple):
    """Evidence of the k image points of one camera for a pose, at S scales and W fractions.

    Attributes:
        logs: (k, S, W) log x_i / c_i, clumps weighted.
        together: (k, S) c_i.
        own: (S,) True at the scales of the residuals of the pose.
        rough: (S,) True at scales far beyond them.
        pairs: Number of pairs (s, w) over which the mean is taken, those of finer scales that are left out among them.
        fewer: (S,) log of the number of tests at each scale, over the number of all.
    """

    logs: Array
    together: NDArray[Any]
    own: NDArray[np.bool_]
    rough: NDArray[np.bool_]
    pairs: int
    fewer: Array

    def by_scale(self, left_out: int) -> Array:
        """Return log of sum_w prod_i x_i^(1 / c_i) / pairs at each scale (S,), without the largest x_i."""
        evidence = self.logs.sum(0) - sum_of_largest(self.logs * self.together[:, :, None], left_out)
        return np.asarray(np.logaddexp.reduce(evidence, 1) - math.log(self.pairs) - self.fewer)

    def of_points(self) -> Array:
        """Return the logs (k,) at the own scale and the fraction with the largest sum."""
        own = self.logs[:, self.own].reshape(len(self.logs), -1)
        return np.asarray(own[:, own.sum(0).argmax()])

    def evidence(self, left_out: int) -> Array:
        """Return the log of the evidence at the own scales and at the rough ones (2,), without the largest x_i."""
        each = self.by_scale(left_out)
        return np.array([np.logaddexp.reduce(each[some], initial=-math.inf) for some in (self.own, self.rough)])


def log10_nfa(
    cameras: Sequence[Terms | None], log10_tests: float, fixing: Sequence[Sequence[int]]
) -> tuple[float, float]:
    """Compute the logarithm of the number of false alarms of a pose.

        NFA = T / prod_cameras mean_{s, w} prod_i x_i^(1 / c_i)

    It is the same for a rotation, a pose, a pose with a focal length and a rig; these differ in the number T of tests
    and in how many matches fix them, which are no evidence.

    Args:
        cameras: Evidence of each camera, which are independent; None for a camera without any.
        log10_tests: Logarithm of the number of tests.
        fixing: Ways to choose the matches that fix the pose, each as their number in each camera. The way that leaves
            least evidence counts.

    Returns:
        Logarithms at the scales of the residuals, and at rougher ones.
    """
    counts = {count for way in fixing for count in way}
    none = np.zeros(2)
    each = [{count: none if one is None else one.evidence(count) for count in counts} for one in cameras]
    ways = [sum((known[count] for known, count in zip(each, way, strict=True)), none) for way in fixing]
    own, rough = log10_tests - np.min(ways, 0) / math.log(10)
    return float(own), float(rough)


class Alarms(NamedTuple):
    """log10 of the number of false alarms (c,) of poses: at the scales of their own residuals, and at rougher ones."""

    own: Array
    rough: Array


def alarms_of(problem: Problem, rotations: Array, translations: Array, scales: Array | None = None) -> Alarms:
    """Of poses (c, 3, 3), (c, 3) with residuals of `scales` (c,), radians; all s are a pose's own if that is None.

    A pose under which three points or fewer are seen has as many as there are tests: no evidence at all. With each of
    several sets of scene points (`Problem.log10_views`) there are as many tests again.

    >>> import numpy as np
    >>> points = np.random.default_rng(0).uniform(-1, 1, (12, 3))
    >>> seen = points + [0, 0, 6]
    >>> problem = Problem(seen / np.linalg.norm(seen, axis=1, keepdims=True), points)
    >>> alarms = alarms_of(problem, np.stack([np.eye(3)] * 2), np.array([[0.0, 0, 6], [0.3, 0, 5]])).own
    >>> bool(alarms[0] < -10), bool(alarms[1] > 0)
    (True, True)
    """
    tests = log10_tests(problem)
    cells = np.minimum(log10_cells(problem.image) + log10_lenses(problem), tests)
    share = [problem.log10_share(r, t) for r, t in zip(rotations, translations, strict=True)]
    none = np.array([max(tests + one, 0.0) for one in share])
    result = Alarms(none, none.copy())
    for k in range(len(none)):
        seen = directions_of(problem, rotations[k], translations[k])
        # Fewer tests at a scale are as much more evidence, but a pose has no less chance than all of them.
        fewer = math.log(10) * (np.maximum(cells + share[k], 0.0) - none[k])
        scale = None if scales is None else float(scales[k])
        terms = camera_terms(problem, seen, scale, fewer=fewer)
        result.own[k], result.rough[k] = log10_nfa([terms], float(none[k]), [[_fixing(problem)]])
    return Alarms(result.own + problem.log10_views, result.rough + problem.log10_views)


def log10_tests(problem: Problem) -> float:
    """log10 of 2 (m)_3 (n)_3 / 3!: choices of three matches with about two poses each; of labels that agree, if given.

    The number of poses that were tried, where the problem has it.
    """
    if problem.log10_tried is not None:
        return problem.log10_tried
    tests = _log10_choices(problem, FIXING)
    if problem.focal is None:
        return tests
    return min(_log10_choices(problem, FIXING + 1), tests + float(log10_lenses(problem)[0]))


def _log10_choices(problem: Problem, pairs: int) -> float:
    m, n = len(problem.bearings), len(problem.points3d)
    choices = math.prod((m - i) * (n - i) / (i + 1) for i in range(pairs))
    if problem.labels2d is not None and problem.labels3d is not None:
        groups = label_groups(np.arange(m), problem.labels2d, problem.labels3d, n)
        agreeing = sum(len(rows) * len(columns) for rows, columns in groups)
        choices = min(choices, math.prod((agreeing - i) / (i + 1) for i in range(pairs)))
    return math.log10(2 * max(choices, 1.0))


def _fixing(problem: Problem) -> int:
    return FIXING + (problem.focal is not None)


def log10_lenses(problem: Problem) -> Array:
    """Return log10 (S,) of the number of lenses that differ at each scale s of the image, 0 for a known lens.

    A focal length moves points at the spread h by h d log f, a radial coefficient by h^3 dk.
    """
    if problem.focal is None:
        return np.zeros(len(problem.image.scales))
    h, scales = problem.image.spread, problem.image.scales
    moved = problem.focal.log_range * h, problem.focal.radial_range * h**3
    return np.asarray(sum(np.log10(np.maximum(each / scales, 1.0)) for each in moved))


def log10_cells(image: ImageStatistics) -> Array:
    """log10 (S,) of the number of poses that differ at each scale s of an image: of cells of this width.

    8 pi^2 (h / s)^3 of rotations about the middle of the scene, which move points h off it by s; A / s^2 places of the
    middle in the view; and log(30) h / s distances of it, up to a factor of 30; h the spread of the bearings.
    """
    across = image.spread / image.scales
    cells = 8 * math.pi**2 * across**4 * (image.solid_angle / image.scales**2) * math.log(30)
    return np.asarray(np.log10(np.maximum(cells, 1.0)))


def log10_rotations(spread: float, scales: Array) -> Array:
    """Return log10 (S,) of the number of rotations that differ at each scale s of an image: 8 pi^2 h / s^3.

    4 pi / s^2 directions of the axis, and 2 pi h / s rotations about it, which move points h off it by s.
    """
    return np.asarray(np.log10(np.maximum(8 * math.pi**2 * spread / scales**3, 1.0)))


def directions_of(problem: Problem, rotation: Array, translation: Array) -> Array:
    """Unit directions (n, 3) in the camera's frame; NaN for a point in the camera or facing away."""
    camera = problem.points3d @ rotation.T + translation
    length = np.linalg.norm(camera, axis=-1, keepdims=True)
    seen = np.divide(camera, length, out=np.full_like(camera, np.nan), where=length > 0)
    if problem.normals3d is not None:
        seen[~faces(problem.normals3d, problem.cosines3d, camera, rotation)] = np.nan
    return seen


def camera_terms(
    problem: Problem, seen: Array, scale: float | None = None, *, fewer: Array | float = 0.0
) -> Terms | None:
    """Return the evidence of one camera for points seen in directions.

    Args:
        problem: Points of the problem.
        seen: (n, 3) unit directions, NaN for points that are not seen.
        scale: Scale of the residuals, radians; None counts all scales as their own.
        fewer: (S,) log of the number of tests at each scale of the image, over the number of all.

    Returns:
        The terms from the finest own scale on; None where no more points are seen than fix the pose.
    """
    if min(len(problem.bearings), int(np.isfinite(seen[:, 0]).sum())) <= _fixing(problem):
        return None
    ratio = np.ones(len(problem.image.scales)) if scale is None else _ratio(problem.image, scale)
    own, rough = _is_own(ratio), ratio >= ROUGH
    finest = int(own.argmax())
    logs, less = _terms(problem, seen, finest), np.broadcast_to(fewer, own.shape)[finest:]
    pairs = len(own) * logs.shape[2]
    return Terms(logs, problem.image.together[:, finest:], own[finest:], rough[finest:], pairs, less)


def own_evidence(problem: Problem, rotation: Array, translation: Array, scale: float) -> Array:
    """Return log x_i / c_i (k,) of each chosen image point under a pose, clumps weighted, at the fraction and the s
    within a factor of two of the scale of its residuals, radians, at which their sum is largest."""
    terms = camera_terms(problem, directions_of(problem, rotation, translation), scale)
    return np.zeros(len(problem.image.chosen)) if terms is None else terms.of_points()


def likeliest_scale(problem: Problem, rotation: Array, translation: Array) -> float:
    """Return the scale of the residuals, radians, with the most evidence; the largest if a pose sees nothing."""
    terms = camera_terms(problem, directions_of(problem, rotation, translation))
    return float(problem.image.scales[-1 if terms is None else terms.by_scale(_fixing(problem)).argmax()])


def _ratio(image: ImageStatistics, scale: float) -> Array:
    """(S,) of the scales of an image to that of residuals."""
    return np.asarray(image.scales / np.clip(scale, image.scales[0], image.scales[-1]))


def _is_own(ratio: Array) -> NDArray[np.bool_]:
    return (ratio >= 1 / OWN) & (ratio <= OWN)


def _shares(problem: Problem) -> Array:
    """Return the fractions w of image points with a partner that are tried: (W,), or (k, 1, W) of each chosen point in
    proportion to its score."""
    shares = SHARES if problem.clutter is None else np.array([1 - problem.clutter])
    if problem.scores2d is not None:
        shares = shares * (problem.scores2d[problem.image.chosen] / problem.scores2d.mean())[:, None, None]
    elif problem.clutter is None:
        return shares
    return np.asarray(np.clip(shares, LEAST_SHARE, MOST_SHARE))


def _terms(problem: Problem, seen: Array, finest: int) -> Array:
    """log x_i / c_i (k, S', W), clumps weighted, at the scales from the finest one on, of points seen in directions
    (n, 3)."""
    image = problem.image
    return np.asarray(
        image.weights[:, finest:, finest:] @ point_evidence(problem, seen, image.scales[finest:], _shares(problem))
    )


def sum_of_largest(values: Array, count: int) -> Array:
    """Of the `count` largest of values (k, ...), as far as positive; a partition stumbles over so many equal ones."""
    rest, total = values.copy(), np.zeros(values.shape[1:])
    for _ in range(count):
        largest = rest.argmax(0)[None]
        total += np.maximum(np.take_along_axis(rest, largest, 0)[0], 0)
        np.put_along_axis(rest, largest, -math.inf, 0)
    return total


def point_evidence(problem: Problem, seen: Array, scales: Array, shares: Array, *, even: bool = False) -> Array:
    """log x_i (k, S, W) of each chosen image point, at `scales` (S,) and `shares` (W,), of points seen in directions
    (n, 3).

    even: against scene points that are spread evenly over the view instead of as they are seen.
    """
    image = problem.image
    predicted, smooth, inside, every = _sums(problem, seen, scales, even)
    # A point without a possible partner has no density to be compared with: it counts as one that has none near.
    density = (np.where(every > 0, every, 1) if even else np.maximum(inside, 1)) / image.solid_angle
    ratio = predicted / (2 * math.pi * scales**2 * np.maximum(density, smooth)[:, None])
    return np.asarray(np.log1p(shares * (ratio - 1)[:, :, None]))


def _sums(problem: Problem, seen: Array, scales: Array, even: bool) -> tuple[Array, Array, Array, Array]:
    """Sum kernels and counts over the possible partners of each chosen image point.

    Args:
        problem: Points of the problem, with k chosen image points.
        seen: (n, 3) directions in which the scene points are seen; NaN for those that are not.
        scales: (S,) standard deviations of the kernels, radians.
        even: Leave the outline out.

    Returns:
        Kernels (k, S); density of the outline (k,), 0 if `even`; number of partners in view (k,) and of all (k,).
    """
    image, count = problem.image, len(problem.image.chosen)
    weight = np.ones(len(seen)) if problem.scores3d is None else problem.scores3d / problem.scores3d.mean()
    in_view, ahead = np.zeros(len(seen), np.bool_), np.flatnonzero(np.isfinite(seen[:, 0]))
    across = (np.abs((seen[ahead] - image.centre) @ image.axes) <= image.half_widths).all(-1)
    in_view[ahead] = across & (seen[ahead] @ image.centre > 0)
    if problem.labelled_pairs is not None:
        return _sums_of_pairs(problem, *problem.labelled_pairs, seen, weight, in_view, scales, even)
    predicted, smooth, inside, every = np.zeros((count, len(scales))), np.zeros(count), np.zeros(count), np.zeros(count)
    for rows, columns, odds, share in _partners(problem, weight):
        ahead = np.isfinite(seen[columns, 0])
        every[rows] += odds * share.sum()
        inside[rows] += odds * share[in_view[columns]].sum()
        used, share, bearings = seen[columns][ahead], share[ahead], problem.bearings[image.chosen[rows]]
        near = sums_near(bearings, used, image.axes, FARTHEST * scales, 0.5 / scales**2, share)
        predicted[rows] += odds[:, None] * near
        if not even:
            smooth[rows] += odds * _smoothed(image, bearings, used, share)
    return predicted, smooth, inside, every


def _sums_of_pairs(
    problem: Problem,
    i: Labels,
    j: Labels,
    seen: Array,
    weight: Array,
    in_view: NDArray[np.bool_],
    scales: Array,
    even: bool,
) -> tuple[Array, Array, Array, Array]:
    """Compute `_sums` over given pairs (p,) of a chosen image point and a scene point."""
    count = len(problem.image.chosen)
    every, inside = (np.asarray(np.bincount(i, of[j], count), np.float64) for of in (weight, weight * in_view))
    ahead = np.isfinite(seen[j, 0])
    i, j = i[ahead], j[ahead]
    squared = ((problem.bearings[problem.image.chosen[i]] - seen[j]) ** 2).sum(-1)
    near = (np.where(squared < (FARTHEST * s) ** 2, np.exp(-0.5 * squared / s**2), 0.0) for s in scales.tolist())
    predicted = np.stack([np.bincount(i, weight[j] * kernel, count) for kernel in near], -1)
    width2 = (OUTLINE * problem.image.spread) ** 2
    outline = weight[j] * np.exp(-0.5 * squared / width2) / (2 * math.pi * width2)
    smooth = np.zeros(count) if even else np.asarray(np.bincount(i, outline, count), np.float64)
    return np.asarray(predicted, np.float64), smooth, inside, every


def _partners(problem: Problem, weight: Array) -> Iterator[tuple[Labels, Labels, Array, Array]]:
    """Places in the chosen image points (k,) and in the scene of possible partners, the odds (k,) of the former and the
    share (n,) of the latter, times its weight: those of a label, or all with their probability of a class, one class
    after the other."""
    chosen, n = problem.image.chosen, len(weight)
    if problem.odds2d is None or problem.classes3d is None:
        for rows, columns in label_groups(chosen, problem.labels2d, problem.labels3d, n):
            yield rows, columns, np.ones(len(rows)), weight[columns]
        return
    for odds, share in zip(problem.odds2d[chosen].T, problem.classes3d.T, strict=True):
        yield np.arange(len(chosen)), np.arange(n), odds, weight * share


def _smoothed(image: ImageStatistics, bearings: Array, directions: Array, share: Array) -> Array:
    """Directions per steradian around each bearing, weighed with their share, smoothed by OUTLINE spreads."""
    step = -(-len(directions) // MOST_SMOOTHED) or 1
    some, share = directions[::step], share[::step]
    if not len(some):
        return np.zeros(len(bearings))
    width2 = (OUTLINE * image.spread) ** 2
    # From the centre of the view float32 has the digits of a narrow one.
    one, other = ((points - image.centre) / math.sqrt(2 * width2) for points in (bearings, some))
    one = np.column_stack([2 * one, -(one * one).sum(1), np.ones(len(one))]).astype(np.float32)
    other = np.column_stack([other, np.ones(len(other)), -(other * other).sum(1)]).astype(np.float32)
    exponent = one @ other.T
    kernel = (np.exp(exponent, out=exponent) @ share.astype(np.float32)).astype(np.float64)
    return np.asarray(kernel / (2 * math.pi * width2) * (len(directions) / len(some)))
