"""Covariance of parameters fitted to matches: a rotation, a pose, a focal length or a rig.

The matches may be certain or only probable. All functions are pure functions of arrays. The matches are
linearised about the estimate, in standard deviations of their residuals.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.special import stdtrit

from bpnp.arrays import Array, Floats, Labels

ONE_SIGMA = 0.8413447460685429  # of a normal variable below one standard deviation [probability; derived]
# Squared distance of a pose from its optimum, in its covariance, from which on they differ: the quantile of chi-squared
# with 6 degrees of freedom at 1 - `EXCEEDED`.
FAR_SQUARED = 22.5  # [1; derived]
SLIGHT_INFORMATION = 0.01  # information below which an image point hardly moves the estimate [fraction; numerics]
# Image points between two scene points: the information by which one reduces that of all, and the largest fraction of
# the matches that may be left out. Of points as dense as the residuals half reduce it, and their mean is right.
DOUBTFUL, MOST_DOUBTFUL = 0.05, 0.25  # [fraction; not tuned]
LEAST_EIGENVALUE = 1e-9  # least eigenvalue of normalised information that fixes the estimate [1; numerics]


class Linearisation(NamedTuple):
    """k possible matches, linearised in p fitted parameters."""

    residual: Array  # (k, d) of each match, in standard deviations
    jacobian: Array  # (k, d, p) derivative of the predicted image point, in the same unit
    probability: Array  # (k,) of the match
    point: Labels  # (k,) index of its image point
    weight: Array  # (g,) number of image points that each image point stands for
    known: Array  # (p, p) information from elsewhere, such as a prior


def join(parts: list[Linearisation]) -> Linearisation:
    """Concatenate the matches of independent cameras and add up their `known`."""
    first = np.cumsum([0, *(len(part.weight) for part in parts[:-1])])
    return Linearisation(
        np.concatenate([part.residual for part in parts]),
        np.concatenate([part.jacobian for part in parts]),
        np.concatenate([part.probability for part in parts]),
        np.concatenate([part.point + start for part, start in zip(parts, first, strict=True)]),
        np.concatenate([part.weight for part in parts]),
        np.sum([part.known for part in parts], 0),
    )


def of_sure_matches(residual: Array, jacobian: Array) -> Linearisation:
    """Return the linearisation of k certain matches, one per image point, in standard deviations."""
    count, size = len(residual), jacobian.shape[-1]
    return Linearisation(residual, jacobian, np.ones(count), np.arange(count), np.ones(count), np.zeros((size, size)))


def covariance_of(
    matches: Linearisation, *, fitted: int, blocks: Labels | None = None, considered: Array | None = None
) -> Array | None:
    """Compute the covariance of the fitted parameters.

    It is the larger of two matrices along each of their common axes. One is the inverse of the observed information H,
    which excludes the information lost to uncertain matches (Louis). The other is the jackknife

        sum_i d_i d_i^T,  d_i = (H - H_i)^-1 g_i,

    with g_i the gradient and H_i the information of image point i. d_i is the step to the optimum without it. See
    `bpnp.search.verdict.uncertainty.local_covariance`.

    The jackknife leaves a point, or one of the `blocks` (g,), out only if the `fitted` parameters stay overdetermined
    without it. `considered` (k, d, c) are derivatives by parameters that are not fitted, times their standard
    deviations: `_add_considered` adds what their errors move. None where the information is not positive definite.

    A few image points, each between two scene points, can reduce the information to nearly nothing. The estimate is as
    good without them, and its covariance is taken if it is smaller.

    >>> rng = np.random.default_rng(0)
    >>> jacobian = rng.normal(size=(400, 1, 2))
    >>> covariance = covariance_of(of_sure_matches(rng.normal(size=(400, 1)), jacobian), fitted=2)
    >>> bool(np.allclose(400 * covariance, np.eye(2), atol=0.3))
    True
    """
    covariance, complete, doubtful = _covariance(matches, fitted, blocks, considered)
    share = float((matches.probability * doubtful[matches.point]).sum())
    if not 0 < share <= MOST_DOUBTFUL * float(matches.probability.sum()):
        return covariance
    sure = matches._replace(probability=np.where(doubtful[matches.point], 0.0, matches.probability))
    without, *_ = _covariance(sure, fitted, blocks, considered)
    if covariance is None or without is None:
        return without if covariance is None else covariance
    return without if float(np.sum(without * complete)) < float(np.sum(covariance * complete)) else covariance


def _covariance(
    matches: Linearisation, fitted: int, blocks: Labels | None, considered: Array | None
) -> tuple[Array | None, Array, NDArray[np.bool_]]:
    """Return the covariance with all matches, their complete information, and the image points (g,) that reduce it."""
    score = np.einsum("kab,ka->kb", matches.jacobian, matches.residual)
    count, size = score.shape
    of_point = csr_array((matches.probability, (matches.point, np.arange(count))), (len(matches.weight), count))
    expected = of_point @ score
    each = matches.jacobian.transpose(0, 2, 1) @ matches.jacobian - score[:, :, None] * score[:, None]
    own = (of_point @ each.reshape(count, -1)).reshape(-1, size, size) + expected[:, :, None] * expected[:, None]
    counted = matches.probability * matches.weight[matches.point]
    complete = np.einsum("k,kab,kac->bc", counted, matches.jacobian, matches.jacobian) + matches.known
    # The complete information has a unit diagonal in these units, so that the rank can be determined.
    unit = 1 / np.sqrt(np.maximum(np.diag(complete), 1e-300))
    doubtful = np.linalg.eigvalsh(own * np.outer(unit, unit))[:, 0] < -DOUBTFUL
    weight = matches.weight
    observed = np.tensordot(weight, own, 1) + matches.known
    if blocks is not None:
        _, block = np.unique(blocks, return_inverse=True)
        of_block = csr_array((np.ones(len(block)), (block, np.arange(len(block)))))
        expected, own = of_block @ expected, (of_block @ own.reshape(-1, size * size)).reshape(-1, size, size)
        weight = np.bincount(block, weight) / np.bincount(block)
    values, vectors = np.linalg.eigh(observed * np.outer(unit, unit))
    if values[0] <= LEAST_EIGENVALUE:
        return None, complete, doubtful
    root = unit[:, None] * vectors / np.sqrt(values)
    steps = expected @ root
    matters = np.flatnonzero(own.reshape(-1, size * size) @ (root @ root.T).ravel() > SLIGHT_INFORMATION)
    if 2 * (round(float(counted.sum())) - 1) <= fitted:
        matters = matters[:0]  # without one of these matches, the others fix several estimates or none
    without = np.eye(size) - root.T @ own[matters] @ root
    fixed = np.linalg.eigvalsh(without)[:, 0] > LEAST_EIGENVALUE  # the estimate is fixed without the point too
    steps[matters[fixed]] = np.linalg.solve(without[fixed], steps[matters[fixed], :, None])[..., 0]
    covariance = _enlarged(root, (weight[:, None] * steps).T @ steps + root.T @ matches.known @ root)
    if considered is not None:
        covariance = _add_considered(covariance, matches, counted, considered)
    return covariance, complete, doubtful


def larger(one: Array, other: Array) -> Array:
    """Return the larger of two covariances along each of their common axes.

    >>> larger(np.diag([1.0, 4.0]), np.diag([2.0, 3.0])).tolist()
    [[2.0, 0.0], [0.0, 4.0]]
    """
    root = np.linalg.cholesky(one)
    white = np.linalg.solve(root, np.linalg.solve(root, other).T)
    return _enlarged(root, (white + white.T) / 2)


def _enlarged(root: Floats, white: Floats) -> Array:
    """Return the larger of L L^T and L W L^T along each of their common axes, for a root L (p, p) and W (p, p)."""
    ratio, axes = np.linalg.eigh(white)
    along = root @ axes
    return np.asarray(along * np.maximum(ratio, 1.0) @ along.T)


def _add_considered(covariance: Array, matches: Linearisation, counted: Array, considered: Array) -> Array:
    """Add the errors of an estimate that come from parameters which are not fitted.

    The residuals r tell something of these parameters q, whose prior has the mean 0 and the covariance 1. Let J and K
    be the derivatives by the fitted parameters and by q, and P = A^-1 J^T with A = J^T J + `known`. The posterior of q
    has the covariance V = (1 + K^T K - K^T J P K)^-1 and the mean m = V (K^T - K^T J P) r. An error of q moves the
    estimate by S = -P K times it, so that the mean square of the error that q causes is

        S (V + m m^T) S^T.

    Its mean over all residuals is S S^T, that of a parameter of which the residuals tell nothing (Schmidt 1966).
    Matches tell less than independent certain ones. J^T J, K^T K and J^T K are divided by the largest factor by which
    the covariance exceeds A^-1. `counted` (k,) are the weights of the matches, `considered` the derivatives by q in
    their standard deviations.

    Source: S. F. Schmidt, Application of state-space methods to navigation problems, 1966.
    """
    size = len(covariance)
    columns = np.concatenate([matches.jacobian, considered, matches.residual[..., None]], -1)
    products = np.einsum("k,kia,kib->ab", counted, columns, columns)
    root = np.linalg.cholesky(products[:size, :size] + matches.known)
    factor = max(float(np.linalg.eigvalsh(root.T @ covariance @ root)[-1]), 1.0)
    products = products / factor
    own = products[:size, :size] + matches.known
    moved = np.linalg.solve(own, products[:size, size:])
    posterior = products[size:, size:] - products[:size, size:].T @ moved
    spread = np.linalg.inv(np.eye(considered.shape[-1]) + posterior[:-1, :-1])
    mean = spread @ posterior[:-1, -1]
    shift = moved[:, :-1]
    return np.asarray(covariance + shift @ (spread + np.outer(mean, mean)) @ shift.T)


def student_factor(free: float | int) -> float:
    """Return the factor that widens a covariance whose scale was estimated from few residuals.

    It is the square of the one-sigma quantile of Student's t with `free` degrees of freedom.
    """
    return float(stdtrit(free, ONE_SIGMA)) ** 2
