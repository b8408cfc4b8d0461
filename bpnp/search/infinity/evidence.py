"""Significance and uncertainty of a rotation, and a test for a wrong camera model.

The number of false alarms is that of `bpnp.search.verdict.false_alarms` (`log10_nfa`) for three unknowns: an unrelated
image point f_i falls with the density l_i of the directions around it; a rotation that explains a fraction w of the
points with residuals of s predicts

    x_i = 1 - w + w exp(-r_i^2 / 2 s^2) / (2 pi s^2 l_i),

times that density, with r_i the distance to the nearest direction. The mean of x_i is at most 1 for unrelated points,
so that

    log10 NFA = log10 T - log10 mean_{s, w} prod_i x_i^(1 / c_i),    T = (m)_2 (n)_2 / 2,

bounds the expected number of rotations that fit unrelated points as well. T counts one rotation for each pair of image
points and pair of directions. Two matches fix a rotation, so the two largest x_i are no evidence. The c_i image points
within 2 s of point i are one observation. With h the RMS angular radius of the image points, 8 pi^2 h / s^3 rotations
are distinguishable at s; T is this number if it is smaller.

With labels, T counts only pairs with equal labels, and l_i is the density of the directions with the label. Class
probabilities and scores of the directions multiply the predicted density. A prior multiplies the NFA by the fraction of
all rotations that are at least as near to it.

Sources: A. Desolneux, L. Moisan, J.-M. Morel, Meaningful alignments, IJCV 2000; F. L. Markley, Attitude determination
using vector observations and the singular value decomposition, J. Astronautical Sciences 1988 (covariance).
"""

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import fdtrc

from bpnp.search.config import ALARMS, INFINITY, PRECISION
from bpnp.search.kernels.neighbours import sums_near
from bpnp.search.pose_model import PoseModel
from bpnp.search.problem import Problem
from bpnp.search.verdict.covariance import covariance_of, of_sure_matches, student_factor
from bpnp.search.verdict.false_alarms import SHARES, Terms, log10_nfa
from bpnp.search.verdict.uncertainty import STRAINS, exceeded_once

Array = NDArray[np.float64]
Labels = NDArray[np.int64]
ROTATION = PoseModel(np.zeros(3), moves=False)


class Background(NamedTuple):
    """Constants of the number of false alarms for one problem.

    Attributes:
        scales: (S,) scales s, pixels.
        log_tests: (S,) natural log of the number of tests at each scale.
        together: (m, S) c_i.
        pixel: (m,) angle of a pixel, radians.
        shares: (W,) or (m, 1, W) fractions w of image points with a match.
        fixing: Number of matches that fix the rotation and the lens; they are no evidence.
    """

    scales: Array
    log_tests: Array
    together: Array
    pixel: Array
    shares: Array
    fixing: int


def background_of(problem: Problem, pixel: Array, noise: float) -> Background:
    """Compute the constants of the number of false alarms.

    Args:
        problem: Image points (m) and directions; `focal` has the range of an unknown focal length and distortion.
        pixel: (m,) angle of a pixel, radians.
        noise: Largest scale s, pixels.
    """
    bearings, scales = problem.bearings, np.asarray(noise * 0.5 ** np.arange(INFINITY.scales), np.float64)
    spread = float(np.sqrt(((bearings - bearings.mean(0)) ** 2).sum(-1).mean()))
    radians = scales * np.median(pixel)
    model = PoseModel(np.zeros(3), problem.focal, moves=False)
    tests = math.log(10) * np.minimum(model.log10_cells(spread, radians), model.log10_choices(problem))
    axes = np.linalg.svd(bearings - bearings.mean(0), full_matrices=False)[2][:2].T
    together = sums_near(bearings, bearings, axes, 2 * scales[::-1] * np.median(pixel), np.zeros(INFINITY.scales))
    shares = SHARES if problem.clutter is None else np.array([1 - problem.clutter])
    if problem.candidate_scores is not None:
        shares = shares * problem.candidate_scores[:, None, None]
    if problem.clutter is not None or problem.candidate_scores is not None:
        shares = np.clip(shares, ALARMS.least_inliers, ALARMS.most_inliers)
    return Background(scales, tests, together[:, ::-1], pixel, shares, model.fixing)


def log10_false_alarms(
    squared: Array, density: Array, background: Background, log10_fraction: float = 0.0
) -> tuple[float, Array]:
    """Compute the logarithm of the number of false alarms of a rotation.

    Args:
        squared: (m,) squared distances to the nearest directions, in squared pixels; infinite beyond reach.
        density: (m,) density around these directions, per steradian.
        background: Constants from `background_of`.
        log10_fraction: `Problem.log10_prior_fraction` of the rotation; default 0, without a prior.

    Returns:
        log10 NFA, and the log x_i / c_i (m,) of each image point at the scale and fraction with the largest sum.
    """
    width = background.scales * background.pixel[:, None]
    ratio = np.exp(-0.5 * squared[:, None] / background.scales**2) / (2 * math.pi * width**2 * density[:, None])
    logs = np.log(1 - background.shares + background.shares * ratio[:, :, None]) / background.together[:, :, None]
    every, tests = np.ones(len(background.scales), np.bool_), background.log_tests
    if log10_fraction:  # a prior leaves at least one test
        tests = np.maximum(tests + math.log(10) * log10_fraction, 0.0)
    most = float(tests.max())
    terms = Terms(logs, background.together, every, ~every, len(every) * background.shares.shape[-1], tests - most)
    return log10_nfa([terms], most / math.log(10), [[background.fixing]])[0], terms.of_points()


class Known(NamedTuple):
    """Uncertainty of a rotation.

    Attributes:
        covariance: (3, 3) of w, R' = exp([w]x) R, radians squared; (3 + q, 3 + q) with q other fitted parameters.
        bound: 99.9 % bound of the rotation error, radians.
    """

    covariance: Array
    bound: float


def noise_of(directions: Array, bearings: Array, pixel: Array) -> float:
    """Return the standard deviation of matches, pixels; NaN if the matches are too few.

    Args:
        directions: (k, 3) directions in the camera's frame.
        bearings: (k, 3) of the image points.
        pixel: (k,) angle of a pixel, radians.
    """
    free = 2 * len(directions) - 3
    return float(np.linalg.norm((bearings - directions) / pixel[:, None])) / math.sqrt(free) if free > 0 else math.nan


def prior_information(problem: Problem) -> Array:
    """Return the information (3, 3) of the prior on the rotation, per squared radian; 0 without a prior."""
    model = replace(ROTATION, prior=problem.prior)
    return model.information(model.state(np.eye(3)))


def how_well_known(directions: Array, bearings: Array, pixel: Array, information: Array | None = None) -> Known:
    """Compute the uncertainty of a rotation that was fitted to matches.

    Args:
        directions: (k, 3) directions in the camera.
        bearings: (k, 3) of the image points.
        pixel: (k,) angle of a pixel, radians.
        information: (3, 3) of a prior of the rotation; None without.

    Returns:
        Covariance (3, 3), NaN if the matches do not fix the rotation, and its bound.
    """
    unit = pixel[:, None]
    return uncertainty_of((bearings - directions) / unit, _by_rotation(directions) / unit[:, None], information)


def uncertainty_of(residual: Array, jacobian: Array, information: Array | None = None) -> Known:
    """Compute the uncertainty of a rotation and of other parameters that were fitted to k matches.

    Args:
        residual: (k, d), pixels.
        jacobian: (k, d, 3 + q) derivatives of the predictions by rotation and other parameters, pixels.
        information: (3 + q, 3 + q) of a prior; None without.

    Returns:
        Covariance (3 + q, 3 + q), NaN if the matches do not fix the parameters, and the bound of the rotation.
    """
    size = jacobian.shape[-1]
    free, covariance = 2 * len(residual) - size, None
    if free > 0:
        noise = max(float(np.linalg.norm(residual)) / math.sqrt(free), INFINITY.smallest_noise)
        matches = of_sure_matches(residual / noise, jacobian / noise)
        matches = matches if information is None else matches._replace(known=information)
        covariance = covariance_of(matches, fitted=size)
    if covariance is None:
        return Known(np.full((size, size), math.nan), math.inf)
    return Known(student_factor(free) * covariance, exceeded_once(covariance[:3, :3], float(free)))


def _by_rotation(directions: Array) -> Array:
    """Return the derivatives (k, 3, 3) of directions (k, 3) by a rotation."""
    state = ROTATION.state(np.eye(3))
    return ROTATION.jacobian(state, ROTATION.sight(state, directions))


def strain_of(directions: Array, bearings: Array, pixel: Array, all_bearings: Array) -> float:
    """Return the largest shift of an image point by the strain that the residuals of matches show, pixels.

    A strain, f ~ (I + S) f, is another focal length or another error of the camera model.

    Args:
        directions: (k, 3) directions of the matches in the camera's frame.
        bearings: (k, 3) of their image points.
        pixel: (k,) angle of a pixel, radians.
        all_bearings: (m, 3) of all image points.

    Returns:
        Shift in pixels; 0 if no strain is significant.
    """
    weight = np.repeat(1 / pixel, 3)[:, None]
    cross = _by_rotation(directions).reshape(-1, 3)
    residual = (bearings - directions).ravel() * weight[:, 0]

    def moved(points: Array) -> Array:
        """Return the derivatives (k, 3, 5) of points by each strain."""
        stretched = np.einsum("sab,kb->kas", STRAINS, points)
        return stretched - points[:, :, None] * np.einsum("ka,kas->ks", points, stretched)[:, None]

    design = np.concatenate([cross, moved(directions).reshape(-1, len(STRAINS))], 1) * weight
    size = np.linalg.norm(design, axis=0)
    solution, _, rank, _ = np.linalg.lstsq(design / size, residual, 1e-6)
    before, after = float(residual @ residual), float(((residual - design / size @ solution) ** 2).sum())
    added, free = int(rank) - 3, 2 * len(directions) - int(rank)
    if not (added > 0 and free > 0 and after > 0):
        return 0.0
    if fdtrc(added, free, (before - after) / added / (after / free)) >= PRECISION.exceeded:
        return 0.0
    change = moved(all_bearings) @ (solution[3:] / size[3:]) + np.cross(solution[:3] / size[:3], all_bearings)
    return float(np.linalg.norm(change, axis=-1).max() / np.median(pixel))
