"""Uncertainty of a pose: its covariance, and 99.9 % bounds of its rotation and focal length.

Also tests for systematic residuals, which another focal length or other proportions of the scene would explain.
"""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.special import fdtrc, fdtri

from bpnp.arrays import Array, Labels
from bpnp.search.pose_model import PoseModel, PoseState, Sight, crossed, lens_columns, lens_error_columns
from bpnp.search.problem import Problem
from bpnp.search.refine.gauss_newton import soft_matches
from bpnp.search.verdict.covariance import Linearisation, covariance_of, larger, student_factor

MANY = 1e9  # degrees of freedom of a number that does not vary [1; numerics]

# Basis of the strains that preserve the volume; the sixth is the unit of length, which no image shows.
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
POSE = 6  # parameters of a pose [parameters; derived]
EXCEEDED = 1e-3  # that an error exceeds its bound, and level of a test [probability; convention]
BLOCKS = 4  # number of blocks of image points along each axis of the image [blocks; not tuned]
# Errors of a map and of a lens are similar for neighbours: of photos with many matches 8 to 14 % were outside of the
# 99.9 % bounds without blocks, 2 to 4 % with them.
FEWEST_IN_BLOCKS = 48  # number of matches from which a block has three [matches; derived]
# With 0.001, cameras with a focal length off by a tenth are accepted 1.5 times as often.
FOCAL_CHANCE = 0.01  # significance level of a test for another focal length [probability; calibration]


def error_bounds(problem: Problem, linear: "Linearised | None", count: float) -> tuple[float, float]:
    """Return the 99.9 % bounds of the rotation error and of the relative error of the focal length.

    The rotation's is in radians (`exceeded_once`), the focal length's a fraction, 0 if given; infinite without a
    linearised pose. The scale of the residuals was estimated from `count` matches.

    >>> import numpy as np
    >>> rng = np.random.default_rng(0)
    >>> points = rng.uniform(-1, 1, (12, 3))
    >>> seen = points + [0, 0, 6]
    >>> problem = Problem(seen / np.linalg.norm(seen, axis=1, keepdims=True), points)
    >>> linear = linearised(problem, np.eye(3), np.array([0.0, 0, 6]), 1e-3)
    >>> bounds = [error_bounds(problem, linear, count) for count in (4.0, 12.0)]
    >>> [(round(math.degrees(rotation), 1), focal) for rotation, focal in bounds]
    [(7.8, 0.0), (0.7, 0.0)]
    """
    covariance = local_covariance(linear)
    if covariance is None or linear is None:
        return math.inf, math.inf
    free = freedom(linear, count)
    focal = 0.0 if problem.focal is None else share_bound(covariance[POSE:, POSE:], free)
    return exceeded_once(covariance[:3, :3], free), focal


def freedom(linear: "Linearised", count: float) -> float:
    """Return the degrees of freedom with which `count` matches determine the scale of the residuals."""
    free = 2 * count - linear.problem.fitted
    return min(free, BLOCKS**2 - 1.0) if linear.is_in_blocks else free


def is_redundant(problem: Problem, count: float) -> bool:
    """Return whether a pose stays overdetermined without one of its matches.

    Each match gives two equations for the unknowns, `problem.fitted`.

    >>> problem = Problem(np.eye(3), np.eye(3))
    >>> [is_redundant(problem, count) for count in (4.0, 4.9)]
    [False, True]
    """
    return 2 * (round(count) - 1) > problem.fitted


def share_bound(covariance: Array, free: float) -> float:
    """Return the 99.9 % bound of the relative error of a positive number.

    It is a fraction, from the variance (1, 1) of the logarithm of the number; infinite if the number is not determined.
    `free` are the degrees of freedom with which the scale of the residuals was estimated.
    """
    with np.errstate(over="ignore"):
        return float(np.expm1(exceeded_once(covariance, free)))


def exceeded_once(covariance: Array, free: float) -> float:
    """Return the length that a vector of this covariance exceeds once in a thousand.

    The square of its length has the cumulants tr C, 2 tr C^2 and 8 tr C^3. The variable a + (b / d) x has the same: x
    is chi-squared with d = (tr C^2)^3 / (tr C^3)^2 degrees of freedom, b^2 = d tr C^2 and a = tr C - b (Buckley and
    Eagleson 1988). A single loose axis gives d = 1, equal ones d = 3. As the scale of the residuals was estimated with
    `free` degrees of freedom, the bound of the square is a and b times the quantiles of F with them. It is infinite
    without a degree of freedom.

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
    """Return whether an error lies in the 99.9 % region of a covariance.

    The covariance (d, d) is that of `pose_covariance`, widened for few residuals. The widening is undone: F allows for
    it.

    >>> is_within(np.array([3.0]), np.eye(1), MANY), is_within(np.array([3.4]), np.eye(1), MANY)
    (True, False)
    """
    if not np.isfinite(covariance).all():
        return False
    free, size = max(float(free), 1.0), len(error)
    squared = float(error @ np.linalg.pinv(covariance, hermitian=True) @ error) * student_factor(free)
    return bool(squared < size * fdtri(size, free, 1 - EXCEEDED))


def pose_covariance(problem: Problem, linear: "Linearised | None", count: float) -> Array | None:
    """Return the covariance of a pose in the user's coordinates.

    It is the covariance of (w, v). The true pose is R' = exp([w]x) R, t' = t + v, with w in radians in the camera's
    axes and v in the user's unit. It is `local_covariance`, widened by `student_factor` because the scale is estimated.
    It is (6, 6), or (7, 7) with the logarithm of a fitted focal length; None if the points do not fix the pose. The
    scale was estimated from `count` matches.
    """
    covariance = local_covariance(linear)
    if covariance is None or linear is None:
        return None
    free = max(freedom(linear, count), 1.0)
    moved = np.eye(len(covariance))  # from the shift s of the centroid to that of the origin: v = s + (R m) x w
    moved[3:POSE, 3:POSE] *= problem.size
    moved[3:POSE, :3] = crossed(linear.state.rotation @ problem.centre3d_of_user)
    return np.asarray(student_factor(free) * moved @ covariance @ moved.T)


def centre_covariance(covariance: Array, translation: Array, scale: float | None = None) -> Array:
    """Return the covariance (3, 3) of the camera centre in the camera's axes: of v + t x w for a pose's (w, v).

    t is the translation (3,) of the point about which the pose rotates, the scene's origin. If the centre is -R^T t /
    scale, the seventh parameter of the covariance is the error of the scale.
    """
    moved = np.concatenate([crossed(translation), np.eye(3)], 1)
    if scale is not None:
        moved = np.column_stack([moved, -translation / scale]) / scale
    known = covariance[: moved.shape[1], : moved.shape[1]]
    return np.asarray(moved @ known @ moved.T)


def local_covariance(linear: "Linearised | None") -> Array | None:
    """Return the covariance (6, 6) of the rotation w and the shift of the scene centroid, for noise of `linear.scale`.

    With a fitted focal length it is (7, 7) with its logarithm; None if the points do not fix the pose.

    docs/verdict.md (Precision of the pose) defines the observed information H and the jackknife covariance sum_i d_i
    d_i^T, d_i the step to the optimum without image point i. H leaves out the information that is lost to uncertain
    correspondences, where scene points lie as close as the residuals. The jackknife allows for residuals that deviate
    from the model, and for false correspondences. Let H^-1 = L L^T. The larger of both matrices is taken along each of
    the common axes, the eigenvectors of L^-1 (sum_i d_i d_i^T) L^-T. A prior of the pose counts as a further
    measurement.

    H is not positive definite if image points between two correspondences outweigh the others. Half the variance s^2 is
    then used, at which fewer points have two, and the result is doubled.

    Errors of the lens model and of the map are similar for neighbours. With many matches, the jackknife also leaves out
    blocks of neighbouring image points; with an unknown focal length, only these. The radial coefficient is
    eliminated. Its expected standard deviation counts as a prior unless it was fitted. The principal point, tangential
    distortion and the second radial coefficient are not fitted. What their errors move is added, as far as the
    residuals leave them open (`bpnp.search.verdict.covariance`).

    Sources: T. A. Louis, Finding the observed information matrix when using the EM algorithm, J. R. Stat. Soc. B 1982;
    J. G. MacKinnon, H. White, Some heteroskedasticity-consistent covariance matrix estimators with improved finite
    sample properties, J. Econometrics 1985; B. Efron, C. Stein, The jackknife estimate of variance, Annals of
    Statistics 1981.
    """
    return None if linear is None else linear.covariance


def matches_of(linear: "Linearised") -> Linearisation:
    """Convert the matches of a pose to the input of `covariance_of`. Equal image points are one measurement."""
    chosen = linear.problem.image.chosen
    _, which, copies = np.unique(linear.problem.bearings[chosen], axis=0, return_inverse=True, return_counts=True)
    weight = len(linear.problem.bearings) / len(chosen) / copies[which.ravel()]
    known = linear.model.information(linear.state)
    return Linearisation(linear.residual, linear.jacobian, linear.probability, linear.image, weight, known)


def _of_louis(linear: "Linearised") -> Array | None:
    """Compute `local_covariance` at one scale; None if the information is not positive definite."""
    problem, matches = linear.problem, linear.matches
    matched = np.asarray(np.bincount(linear.image, linear.probability, len(problem.image.chosen)), np.float64)
    if problem.focal is None:
        alone = covariance_of(matches, fitted=problem.fitted)
        if alone is None or not linear.is_in_blocks:
            return alone
        together = covariance_of(matches, fitted=problem.fitted, blocks=_blocks(problem, matched))
        return alone if together is None else larger(alone, together)
    blocks = _blocks(problem, matched)
    lens, seen = problem.focal, linear.sight.directions
    sigmas = np.repeat([lens.centre_sigma, lens.tangential_sigma, lens.quartic_sigma], [2, 2, 1])
    considered = sigmas / linear.scale * lens_error_columns(seen, lens.radial)
    covariance = covariance_of(matches, fitted=problem.fitted, blocks=blocks, considered=considered)
    return None if covariance is None else covariance[: POSE + 1, : POSE + 1]


def _blocks(problem: Problem, matched: Array) -> Labels:
    """Return the block (k,) of each chosen image point; the blocks have equal expected matches.

    There are at most `BLOCKS`^2.
    """
    x, y = ((problem.bearings[problem.image.chosen] - problem.image.centre) @ problem.image.axes).T
    column, row = _quantile(x, matched), np.zeros(len(x), np.int64)
    for k in range(BLOCKS):
        row[column == k] = _quantile(y[column == k], matched[column == k])
    return column * BLOCKS + row


def _quantile(values: Array, weights: Array) -> Labels:
    """Return the index of each value among `BLOCKS` intervals of equal weight."""
    order = np.argsort(values, kind="stable")
    below = np.empty(len(values))
    below[order] = np.cumsum(weights[order]) - weights[order] / 2
    block = below * BLOCKS / max(float(weights.sum()), 1e-300)
    return np.minimum(block, BLOCKS - 1).astype(np.int64)


@dataclass(frozen=True, eq=False)
class Linearised:
    """A pose and its k possible matches in one camera, linearised in the unknowns."""

    problem: Problem
    model: PoseModel
    state: PoseState
    image: Labels  # (k,) indices into the chosen image points
    probability: Array  # (k,) of each match
    sight: Sight  # the k scene points as the camera sees them
    residual: Array  # (k, 3) of the image points, in units of `scale`
    jacobian: Array  # (k, 3, p) derivatives of the directions by the unknowns, in units of `scale`
    scale: float  # standard deviation of the residuals, radians

    @cached_property
    def matches(self) -> Linearisation:
        """The matches as `covariance_of` takes them."""
        return matches_of(self)

    @cached_property
    def is_in_blocks(self) -> bool:
        """True if the jackknife of a known camera leaves out blocks too; equal image points are one match."""
        matches = self.matches
        count = float((matches.probability * matches.weight[matches.point]).sum())
        return self.problem.focal is None and count >= FEWEST_IN_BLOCKS

    @cached_property
    def covariance(self) -> Array | None:
        """Covariance that `local_covariance` describes."""
        covariance = _of_louis(self)
        if covariance is not None:
            return covariance
        sharper = linearise(self.model, self.problem, self.state, self.scale / math.sqrt(2))
        covariance = None if sharper is None else _of_louis(sharper)
        return None if covariance is None else 2 * covariance


def linearised(problem: Problem, rotation: Array, translation: Array, scale: float) -> Linearised | None:
    """Linearise a pose of one camera and its possible matches.

    The points of a match are within a few standard deviations `scale`, radians; None without a match.
    """
    model = PoseModel.of(problem)
    return linearise(model, problem, model.state(rotation, translation), scale)


def linearise(model: PoseModel, problem: Problem, state: PoseState, scale: float, camera: int = 0) -> Linearised | None:
    """Linearise the possible matches of one camera in the unknowns of a model.

    The residuals have the standard deviation `scale`, radians; None without a match.
    """
    found = soft_matches(model, problem, state, scale, camera=camera)
    if found is None:
        return None
    sight = found.sight.choose(found.point)
    residual = (problem.bearings[problem.image.chosen[found.image]] - sight.directions) / scale
    jacobian = model.jacobian(state, sight, camera) / scale
    return Linearised(problem, model, state, found.image, found.probability, sight, residual, jacobian, scale)


class Misfit(NamedTuple):
    """Change of a pose when parameters of the camera or the scene are fitted with it."""

    turn: float  # rotation of the pose, radians
    shift: float  # shift of the scene centroid, in distances from the camera
    zoom: float = 1.0  # fitted focal length over the given one; 1 if the given one fits
    radial: float = 0.0  # radial coefficient; 0 without radial distortion


def systematic_misfit(linear: Linearised | None, count: float) -> Misfit:
    """Return the largest change of a pose that its residuals support significantly.

    - Five strains of the scene are fitted to the residuals together with the pose. Correspondences are weighted with
      their probabilities. The pose is eliminated, and the principal directions of the strains with a significant F
      statistic count (level 0.001).
    - The log of the focal length is fitted and tested likewise (level `FOCAL_CHANCE`, 0.01). The
      correspondences of the pose bias it towards the given one; `bpnp.search.verdict.rivals.lens` fits a
      significant one with new ones.

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
    zoomed = lens_columns(linear.sight.directions, 0.0)[..., :1] / linear.scale
    strained = linear.jacobian[:, :, 3:POSE] @ (linear.sight.turned @ STRAINS).transpose(1, 2, 0)
    distance = max(float(np.linalg.norm(linear.state.centroid)), 1e-300)  # unit of the shift, like a radian of rotation
    posed = linear.jacobian[:, :, :POSE] * np.repeat([1.0, distance], 3)
    columns = np.concatenate([posed, zoomed, strained, linear.residual[..., None]], -1)
    weighted = (np.sqrt(linear.probability)[:, None, None] * columns).reshape(-1, columns.shape[-1])
    products = weighted.T @ weighted
    pose = np.linalg.pinv(products[:POSE, :POSE], hermitian=True)
    found = []
    strains = slice(POSE + 1, POSE + 1 + len(STRAINS))
    for fitted, chance in ((slice(POSE, POSE + 1), FOCAL_CHANCE), (strains, EXCEEDED)):
        moved, step = _moved(products, pose, fitted, free, chance)
        zoom = math.exp(float(step[0])) if len(step) == 1 else 1.0
        found.append(Misfit(float(np.linalg.norm(moved[:3])), float(np.linalg.norm(moved[3:])), zoom))
    return Misfit(
        max(each.turn for each in found),
        max(each.shift for each in found),
        max((each.zoom for each in found), key=lambda zoom: abs(math.log(zoom))),
    )


def bends_significantly(linear: Linearised | None, count: float) -> bool:
    """Return whether radial distortion explains the residuals of a pose significantly better than a focal length.

    An F test of the radial coefficient at the level `FOCAL_CHANCE`, with pose and focal length eliminated.
    """
    if linear is None or not (linear.problem.bearings[:, 2] > 0).all():
        return False
    free = 2 * min(count, float(linear.probability.sum())) - POSE - 2
    lens = lens_columns(linear.sight.directions, 0.0) / linear.scale
    columns = [linear.jacobian[:, :, :POSE], lens, linear.residual[..., None]]
    rows = (np.sqrt(linear.probability)[:, None, None] * np.concatenate(columns, -1)).reshape(-1, POSE + 3)
    # The last column of R ends with the gain of the radial coefficient and the remaining residual.
    triangle = np.asarray(np.linalg.qr(rows, mode="r"))
    gain, rest = float(triangle[-2, -1] ** 2), float(triangle[-1, -1] ** 2)
    return bool(free > 0 and fdtrc(1, free, gain * free / max(rest, free, 1.0)) < FOCAL_CHANCE)


def _moved(products: Array, pose: Array, fitted: slice, free: float, chance: float) -> tuple[Array, Array]:
    """Fit parameters to the residuals together with the pose, and keep the significant directions.

    The first six columns of the inner products are the pose's, the last one holds the residuals. `pose` (6, 6) is the
    inverse of the products of the pose, `free` the number of measurements less the six of the pose. Return the step
    (6,) of the pose and that of the fitted parameters.
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
    # A value above `free` comes from points with several possible correspondences, not from the scale of the residuals.
    significant = fdtrc(1, free, gain * free / np.clip(rest, 1e-300, free)) < chance / len(values)
    step = directions @ np.where(significant, step, 0.0)
    return np.asarray(across @ step), step
