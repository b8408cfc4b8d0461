"""How well points fix a pose: its covariance, bounds of its rotation and focal length that allow for few residuals, and
residuals that no pose explains, but another focal length or other proportions of the scene would."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import fdtrc, fdtri

from bpnp.poses import turned_by
from bpnp.search.evidence.covariance import Linearisation, covariance_of, student_factor
from bpnp.search.evidence.partners import across, facing, partners
from bpnp.search.evidence.settings import Evidence
from bpnp.search.problem import Problem
from bpnp.search.propose.lens import LensFit, centre_columns, fit_lens, lens_columns
from bpnp.search.settings import DEFAULT
from bpnp.search.starts import GravityPrior, PosePrior

Array = NDArray[np.float64]
Labels = NDArray[np.int64]
MANY = 1e9  # degrees of freedom, of a number that does not vary
EXCEEDED = 1e-3  # probability that a pose is farther off than its bound, and of a test

# Strains that leave the volume as it is, a basis; the sixth is the unit of length, which no image shows.
STRAINS = np.array(
    [
        [[1, 0, 0], [0, -1, 0], [0, 0, 0]],
        [[1, 0, 0], [0, 1, 0], [0, 0, -2]],
        [[0, 1, 0], [1, 0, 0], [0, 0, 0]],
        [[0, 0, 1], [0, 0, 0], [1, 0, 0]],
        [[0, 0, 0], [0, 0, 1], [0, 1, 0]],
    ],
    np.float64,
)
POSE = 6  # numbers that are fitted with every pose
BLOCKS = 4  # of image points, along each axis of the image


def rotation_bound(problem: Problem, linear: "Linearised | None", count: float) -> float:
    """Angle, radians, that the error of the rotation exceeds once in a thousand; see `exceeded_once`.

    linear: `linearised` with the standard deviation of the residuals, estimated from `count` matches.

    >>> import numpy as np
    >>> rng = np.random.default_rng(0)
    >>> points = rng.uniform(-1, 1, (12, 3))
    >>> seen = points + [0, 0, 6]
    >>> problem = Problem(seen / np.linalg.norm(seen, axis=1, keepdims=True), points)
    >>> linear = linearised(problem, np.eye(3), np.array([0.0, 0, 6]), 1e-3)
    >>> bounds = [rotation_bound(problem, linear, count) for count in (4.0, 12.0)]
    >>> [round(math.degrees(bound), 1) for bound in bounds]
    [7.8, 0.7]
    """
    covariance = local_covariance(linear)
    return math.inf if covariance is None else exceeded_once(covariance[:3, :3], 2 * count - problem.fitted)


def is_redundant(problem: Problem, count: float) -> bool:
    """Return whether a pose stays overdetermined without one of its matches.

    Args:
        problem: Points of the problem; `problem.fitted` is the number of unknowns.
        count: Expected number of matches. Each one gives two equations.

    >>> problem = Problem(np.eye(3), np.eye(3))
    >>> [is_redundant(problem, count) for count in (4.0, 4.9)]
    [False, True]
    """
    return 2 * (round(count) - 1) > problem.fitted


def focal_bound(problem: Problem, linear: "Linearised | None", count: float) -> float:
    """Share by which the focal length may be wrong, exceeded once in a thousand; see `exceeded_once`."""
    covariance = local_covariance(linear)
    return math.inf if covariance is None else share_bound(covariance[POSE:, POSE:], 2 * count - problem.fitted)


def share_bound(covariance: Array, free: float) -> float:
    """Share by which a number may be wrong of whose logarithm this is the variance (1, 1), exceeded once in a
    thousand; infinite where it may be anything."""
    with np.errstate(over="ignore"):
        return float(np.expm1(exceeded_once(covariance, free)))


def exceeded_once(covariance: Array, free: float) -> float:
    """Length that a vector of this covariance (3, 3) exceeds once in a thousand.

    The square of its length has the cumulants tr C, 2 tr C^2 and 8 tr C^3, as a + (b / d) x has, x chi-squared with d =
    (tr C^2)^3 / (tr C^3)^2 degrees of freedom, one for a single loose axis and three for equal ones, b^2 = d tr C^2 and
    a = tr C - b (Buckley and Eagleson 1988). The scale of the residuals was estimated with `free` degrees of freedom:
    the square is at most a and b times the quantiles of F with them.

    Source: M. J. Buckley, G. K. Eagleson, An approximation to the distribution of quadratic forms in normal random
    variables, Australian J. Statistics 1988.
    """
    if free <= 0:
        return math.inf
    total = float(np.trace(covariance))
    squared, cubed = (float(np.trace(np.linalg.matrix_power(covariance / total, k))) for k in (2, 3))
    d = squared * (squared / cubed) ** 2
    b = math.sqrt(d * squared)
    quantiles = fdtri(np.array([MANY, d]), free, 1 - EXCEEDED)
    return math.sqrt(total * float(max(1 - b, 0.0) * quantiles[0] + b * quantiles[1]))


def is_within(error: Array, covariance: Array, free: float | int) -> bool:
    """Return whether an error is in the region that a covariance claims to hold it with a probability of 99.9 %.

    Args:
        error: (d,) of some of what is fitted.
        covariance: (d, d) as `pose_covariance` gives it, widened for few residuals. With F's quantile it is not.
        free: Degrees of freedom with which the scale of the residuals was estimated.

    >>> is_within(np.array([3.0]), np.eye(1), MANY), is_within(np.array([3.4]), np.eye(1), MANY)
    (True, False)
    """
    if not np.isfinite(covariance).all():
        return False
    free, size = max(float(free), 1.0), len(error)
    squared = float(error @ np.linalg.pinv(covariance, hermitian=True) @ error) * student_factor(free)
    return bool(squared < size * fdtri(size, free, 1 - EXCEEDED))


def pose_covariance(problem: Problem, linear: "Linearised | None", count: float) -> Array | None:
    """Covariance (6, 6) of a pose, None where the points do not fix it; (7, 7) with the logarithm of a focal length
    that is fitted.

    Of (w, v): the true pose is R' = exp([w]x) R, t' = t + v, w in radians in the camera's axes, v in the user's unit,
    and t the translation in the user's coordinates. `local_covariance`, times the square of the quantile of
    Student's t that has one sigma of a normal distribution, as the scale is estimated from `count` matches.
    """
    covariance = local_covariance(linear)
    if covariance is None or linear is None:
        return None
    free = max(2 * count - problem.fitted, 1.0)
    moved = np.eye(len(covariance))  # the shift of the middle, as that of the origin: v = s + (R m) x w
    moved[3:POSE, 3:POSE] *= problem.size
    moved[3:POSE, :3] = crossed(linear.rotation @ problem.middle_of_user)
    return np.asarray(student_factor(free) * moved @ covariance @ moved.T)


def centre_covariance(covariance: Array, translation: Array, scale: float | None = None) -> Array:
    """Covariance (3, 3), in the camera's axes, of the centre of the camera, -R' (v + t x w) for a pose's (w, v); what
    else is in `covariance` is left aside.

    translation: of the point about which the pose turns: t for the scene's origin. scale: where the centre is -R^T t /
    scale, of which `covariance` has the error too.
    """
    moved = np.concatenate([crossed(translation), np.eye(3)], 1)
    if scale is not None:
        moved = np.column_stack([moved, -translation / scale]) / scale
    known = covariance[: moved.shape[1], : moved.shape[1]]
    return np.asarray(moved @ known @ moved.T)


def local_covariance(linear: "Linearised | None") -> Array | None:
    """Covariance (6, 6) of the turn w and the shift of the middle of the scene, from noise of `linear.scale`; None if
    the points do not fix the pose. (7, 7) with the logarithm of a focal length that is fitted.

    Image point i has scene point j as its partner with the probability p_ij. With J_ij the derivative of the direction
    u_j by the turn and the shift, and the scores g_ij = J_ij^T (f_i - u_j) / s^2, g_i = sum_j p_ij g_ij, the observed
    information is (Louis 1982)

        H = sum_ij p_ij (J_ij^T J_ij / s^2 - g_ij g_ij^T) + sum_i g_i g_i^T + that of the prior:

    where scene points lie as close as the residuals, what their partners leave open is subtracted. What a prior knows
    of the pose counts as a measurement beside the points. The jackknife

        sum_i d_i d_i^T,  d_i = (H - H_i)^-1 g_i,  H_i the share of image point i in H,

    allows for residuals that are not as the model says, and for an image point with a false partner: d_i is the way to
    the optimum without it. With H^-1 = L L^T, the larger of both counts along each of the common axes, the eigenvectors
    of L^-1 (sum_i d_i d_i^T) L^-T. Where H is not positive definite, since points that lie between two partners
    outweigh the others, that of half the variance s^2 counts, at which fewer have two, times two.

    Sources: T. A. Louis, Finding the observed information matrix when using the EM algorithm, J. R. Stat. Soc. B 1982;
    J. G. MacKinnon, H. White, Some heteroskedasticity-consistent covariance matrix estimators with improved finite
    sample properties, J. Econometrics 1985; B. Efron, C. Stein, The jackknife estimate of variance, Annals of
    Statistics 1981; S. F. Schmidt, Application of state-space methods to navigation problems, 1966.

    With an unknown lens, the jackknife leaves out blocks of neighbouring image points: what a lens of this model leaves
    unexplained, and errors of a map, are alike for neighbours, and a focal length adds them up. The radial coefficient
    is eliminated, with the standard deviation that is expected of it unless it was fitted. The principal point is a
    considered parameter: with c its standard deviation and J_c the derivatives by it, C becomes C + c^2 S S^T,
    S = H^-1 sum_ij p_ij J_ij^T J_c / s^2.
    """
    if linear is None:
        return None
    covariance = _of_louis(linear)
    if covariance is not None:
        return covariance
    sharper = linearised(linear.problem, linear.rotation, linear.translation, linear.scale / math.sqrt(2))
    covariance = None if sharper is None else _of_louis(sharper)
    return None if covariance is None else 2 * covariance


def matches_of(linear: "Linearised") -> Linearisation:
    """Return the matches of a pose as `covariance_of` takes them."""
    chosen = linear.problem.image.chosen
    weight = np.full(len(chosen), len(linear.problem.bearings) / len(chosen))
    return Linearisation(linear.residual, linear.jacobian, linear.probability, linear.image, weight, _known(linear))


def _of_louis(linear: "Linearised") -> Array | None:
    """See `local_covariance`; None where the information is not positive definite."""
    problem, matches = linear.problem, matches_of(linear)
    if problem.focal is None:
        return covariance_of(matches, fitted=problem.fitted)
    matched = np.asarray(np.bincount(linear.image, linear.probability, len(problem.image.chosen)), np.float64)
    blocks = _blocks(problem, matched)
    centre = problem.focal.centre_sigma / linear.scale * centre_columns(linear.seen)
    covariance = covariance_of(matches, fitted=problem.fitted, blocks=blocks, considered=centre)
    return None if covariance is None else covariance[: POSE + 1, : POSE + 1]


def _blocks(problem: Problem, matched: Array) -> Labels:
    """Return the block (k,) of each chosen image point, of at most `BLOCKS`^2 with as many matched points each.

    Args:
        problem: Points.
        matched: (k,) probability that an image point has a match.
    """
    x, y = ((problem.bearings[problem.image.chosen] - problem.image.centre) @ problem.image.axes).T
    column, row = _quantile(x, matched), np.zeros(len(x), np.int64)
    for k in range(BLOCKS):
        row[column == k] = _quantile(y[column == k], matched[column == k])
    return column * BLOCKS + row


def _quantile(values: Array, weights: Array) -> Labels:
    """Return which of `BLOCKS` intervals of equal weight each value is in."""
    order = np.argsort(values, kind="stable")
    below = np.empty(len(values))
    below[order] = np.cumsum(weights[order]) - weights[order] / 2
    return np.minimum(below * BLOCKS / max(float(weights.sum()), 1e-300), BLOCKS - 1).astype(np.int64)


class Linearised(NamedTuple):
    """A pose, and the k possible matches that are near each other under it, as they depend on it.

    image: (k,) places among the chosen image points. probability: (k,) of the match. seen: (k, 3) direction in which
    the pose sees the scene point. points: (k, 3) of the latter in the camera's axes, from the middle of the scene.
    residual: (k, 3) of the image point, jacobian: (k, 3, 6) of `seen` by turn and shift about that middle, (k, 3, 7) by
    the logarithm of a focal length that is fitted too, (k, 3, 8) by a radial coefficient; in scales.
    scale: standard deviation of the residuals, radians.
    """

    problem: Problem
    rotation: Array
    translation: Array
    image: Labels
    probability: Array
    seen: Array
    points: Array
    residual: Array
    jacobian: Array
    scale: float

    @property
    def middle(self) -> Array:
        """(3,) of the scene, seen from the camera, in its axes."""
        return np.asarray(self.rotation @ self.problem.middle + self.translation)


def linearised(problem: Problem, rotation: Array, translation: Array, scale: float) -> Linearised | None:
    """A pose with the matches that are within a few scales, radians, of each other; None if there is none."""
    camera = problem.points3d @ rotation.T + translation
    places = facing(problem, camera, rotation)
    if not len(places):
        return None
    camera = camera[places]
    depth = np.linalg.norm(camera, axis=-1, keepdims=True)
    seen = camera / depth
    i, j, density, every = partners(problem, seen, places, problem.image.chosen, scale)
    if not len(i):
        return None
    p, u = camera[j] - rotation @ problem.middle - translation, seen[j]
    by_shift = across(u) / depth[j, None]
    columns = [np.cross(p[:, None], by_shift, axisb=2, axisc=2), by_shift]
    if problem.focal is not None:
        columns.append(lens_columns(u, problem.focal.radial)[..., : 1 + (problem.focal.radial_sigma > 0)])
    jacobian = np.concatenate(columns, -1) / scale
    residual = (problem.bearings[problem.image.chosen[i]] - u) / scale
    return Linearised(problem, rotation, translation, i, density / every[i], u, p, residual, jacobian, scale)


def _known(linear: Linearised) -> Array:
    """Return the information (p, p) of the priors about rotation, shift and the fitted parameters of the lens."""
    focal, prior = linear.problem.focal, linear.problem.prior
    size = linear.jacobian.shape[-1]
    information = np.zeros((size, size))
    if focal is not None:
        sigmas = np.array([focal.sigma, focal.radial_sigma][: size - POSE])
        information[POSE:, POSE:] = np.diag(1 / sigmas**2)
    if isinstance(prior, GravityPrior):
        up = np.asarray(prior.up_camera, np.float64) / np.linalg.norm(prior.up_camera)
        information[:3, :3] = (np.eye(3) - np.outer(up, up)) / math.radians(prior.sigma_deg) ** 2
    elif isinstance(prior, PosePrior):
        information[:3, :3] = np.eye(3) / math.radians(prior.rotation_sigma_deg) ** 2
        if prior.translation is not None:
            moved = np.concatenate([crossed(linear.rotation @ linear.problem.middle), np.eye(3)], 1)
            information[:POSE, :POSE] += moved.T @ moved / prior.translation_sigma**2
    return information


def crossed(vector: Array) -> Array:
    """The matrix (3, 3) that gives the cross product of `vector` with another."""
    x, y, z = vector
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])


class Misfit(NamedTuple):
    """How far the pose would be if the camera and the scene were free.

    turn: radians. shift: of the middle of the scene, in distances from the camera. zoom: the focal length over the
    given one, 1 if not that is wrong. radial: radial coefficient, 0 if not that is wrong.
    """

    turn: float
    shift: float
    zoom: float = 1.0
    radial: float = 0.0


def systematic_misfit(linear: Linearised | None, count: float, rule: Evidence = DEFAULT.evidence) -> Misfit:
    """What is significant in the residuals of a pose, `linearised`, with `count` matches: the largest step of two.

    - Beside the pose, five strains of the scene are fitted to the residuals, weighed with the probabilities of the
      partners. Of their principal directions, the pose eliminated, those count whose F statistic chance exceeds once in
      a thousand.
    - The same with the log of the focal length, once in a hundred (`rule.focal_chance`); with other partners too
      (`fit_lens`), since those of a linear fit hold it back.

    >>> import numpy as np
    >>> rng = np.random.default_rng(0)
    >>> points = rng.uniform(-1, 1, (40, 3))
    >>> seen = points + [0, 0, 5] + 1e-3 * rng.standard_normal((40, 3))
    >>> problem = Problem(seen / np.linalg.norm(seen, axis=1, keepdims=True), points)
    >>> systematic_misfit(linearised(problem, np.eye(3), np.array([0, 0, 5.0]), 2e-4), 40.0)
    Misfit(turn=0.0, shift=0.0, zoom=1.0, radial=0.0)
    """
    if linear is None:
        return Misfit(0.0, 0.0)
    free = 2 * min(count, float(linear.probability.sum())) - POSE
    zoomed = lens_columns(linear.seen, 0.0)[..., :1] / linear.scale
    strained = linear.jacobian[:, :, 3:POSE] @ (linear.points @ STRAINS).transpose(1, 2, 0)
    distance = max(float(np.linalg.norm(linear.middle)), 1e-300)  # the unit of the shift, as a radian is of the turn
    posed = linear.jacobian[:, :, :POSE] * np.repeat([1.0, distance], 3)
    columns = np.concatenate([posed, zoomed, strained, linear.residual[..., None]], -1)
    weighed = (np.sqrt(linear.probability)[:, None, None] * columns).reshape(-1, columns.shape[-1])
    products = weighed.T @ weighed
    pose = np.linalg.pinv(products[:POSE, :POSE], hermitian=True)
    found = []
    strains = slice(POSE + 1, POSE + 1 + len(STRAINS))
    for fitted, chance in ((slice(POSE, POSE + 1), rule.focal_chance), (strains, EXCEEDED)):
        moved, step = _moved(products, pose, fitted, free, chance)
        zoom = math.exp(float(step[0])) if len(step) == 1 else 1.0
        found.append(Misfit(float(np.linalg.norm(moved[:3])), float(np.linalg.norm(moved[3:])), zoom))
    pose_of = linear.problem, linear.rotation, linear.middle, linear.scale
    other = fit_lens(*pose_of) if found[0].zoom != 1 else None
    if other is not None:
        found.append(misfit_of(linear.rotation, linear.middle, other))
    return Misfit(
        max(each.turn for each in found),
        max(each.shift for each in found),
        max((each.zoom for each in found), key=lambda zoom: abs(math.log(zoom))),
    )


def misfit_of(rotation: Array, middle: Array, other: LensFit) -> Misfit:
    """How far a pose with another focal length is from a pose that sees the middle of the scene at (3,)."""
    shift = float(np.linalg.norm(other.middle - middle)) / max(float(np.linalg.norm(middle)), 1e-300)
    return Misfit(turned_by(rotation, other.rotation), shift, other.zoom, other.radial or 0.0)


def bends_significantly(linear: Linearised | None, count: float, rule: Evidence = DEFAULT.evidence) -> bool:
    """Return whether radial distortion explains the residuals of a pose significantly better, beside a focal length.

    The F test of the radial coefficient, with pose and focal length eliminated, at `focal_chance`.

    Args:
        linear: The pose and its possible matches.
        count: Number of matches.
        rule: Settings.
    """
    if linear is None or not (linear.problem.bearings[:, 2] > 0).all():
        return False
    free = 2 * min(count, float(linear.probability.sum())) - POSE - 2
    lens = lens_columns(linear.seen, 0.0) / linear.scale
    columns = [linear.jacobian[:, :, :POSE], lens, linear.residual[..., None]]
    rows = (np.sqrt(linear.probability)[:, None, None] * np.concatenate(columns, -1)).reshape(-1, POSE + 3)
    # The last two values of R are the radial column and the residuals, without what the columns before explain.
    triangle = np.asarray(np.linalg.qr(rows, mode="r"))
    gain, rest = float(triangle[-2, -1] ** 2), float(triangle[-1, -1] ** 2)
    return bool(free > 0 and fdtrc(1, free, gain * free / max(rest, free, 1.0)) < rule.focal_chance)


def _moved(products: Array, pose: Array, fitted: slice, free: float, chance: float) -> tuple[Array, Array]:
    """The step (6,) of the pose if the `fitted` columns are fitted to the residuals beside it, and that of these.

    products: of the columns with each other; the first six are the pose's, the last one holds the residuals. pose:
    (6, 6), the inverse of those of the pose. free: numbers that were measured, less those of the pose. chance: with
    which less may be significant.
    """
    across = pose @ products[:POSE, fitted]
    values, directions = np.linalg.eigh(products[fitted, fitted] - products[fitted, :POSE] @ across)
    known = values > 1e-9 * float(np.diag(products)[fitted].max())
    if not 0 < known.sum() < free:
        return np.zeros(POSE), np.zeros(len(values))
    values, directions = values[known], directions[:, known]
    free -= len(values)
    step = (products[fitted, -1] - across.T @ products[:POSE, -1]) @ directions / values
    gain = step**2 * values
    rest = products[-1, -1] - float(products[-1, :POSE] @ pose @ products[:POSE, -1]) - float(gain.sum())
    # Beyond `free` is what several possible partners of a point add, not the scale of the residuals.
    significant = fdtrc(1, free, gain * free / np.clip(rest, 1e-300, free)) < chance / len(values)
    step = directions @ np.where(significant, step, 0.0)
    return np.asarray(across @ step), step
