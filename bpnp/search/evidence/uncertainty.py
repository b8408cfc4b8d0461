"""How well points fix a pose: the standard deviation of its rotation, a bound that allows for few residuals, and the
residuals that no pose explains, but another focal length or other proportions of the scene would."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.special import fdtrc, stdtrit

from bpnp.search.point_sets import PointSets, faces
from bpnp.search.starts import GravityPrior, PosePrior

Array = NDArray[np.float64]
FARTHEST = 4.0  # scales from an image point within which scene points may be its partner
FEW_NEIGHBOURS, NEIGHBOURS = 8, 64  # of an image point that are looked up: of most, and where more are near
DENSE = 4096  # pairs of points up to which all distances are computed
OUTLIERS = 0.3  # share of the image points without a partner that the assignment expects
EXCEEDED = 1e-3  # probability that the rotation is farther off than its bound, to either side

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


def rotation_bound(sets: PointSets, pairs: "Pairs | None", count: float) -> float:
    """Angle, radians, that the error about the least certain axis exceeds once in a thousand.

    pairs: `linearised` with the standard deviation of the residuals, estimated from `count` matches. The bound is sigma
    times the quantile of Student's t with the degrees of freedom that the estimate had: 2 count, less those that were
    fitted.

    >>> import numpy as np
    >>> rng = np.random.default_rng(0)
    >>> points = rng.uniform(-1, 1, (12, 3))
    >>> seen = points + [0, 0, 6]
    >>> sets = PointSets(seen / np.linalg.norm(seen, axis=1, keepdims=True), points)
    >>> pairs = linearised(sets, np.eye(3), np.array([0.0, 0, 6]), 1e-3)
    >>> bounds = [rotation_bound(sets, pairs, count) for count in (4.0, 12.0)]
    >>> [round(math.degrees(bound), 1) for bound in bounds]
    [5.1, 0.6]
    """
    free = 2 * count - 2 * sets.pairs_that_fix
    if free <= 0:
        return math.inf
    return rotation_sigma(sets, pairs) * float(stdtrit(free, 1 - EXCEEDED / 2))


def rotation_sigma(sets: PointSets, pairs: "Pairs | None") -> float:
    """Standard deviation of the rotation about its least certain axis, radians, from noise of `pairs.scale`.

    Image point i has scene point j as its partner with the probability p_ij. With J_ij the derivative of the direction
    u_j by the turn and the shift, and the scores g_ij = J_ij^T (f_i - u_j) / s^2, g_i = sum_j p_ij g_ij, the observed
    information is (Louis 1982)

        H = sum_ij p_ij (J_ij^T J_ij / s^2 - g_ij g_ij^T) + sum_i g_i g_i^T + that of the prior:

    where scene points lie as close as the residuals, what their partners leave open is subtracted. The larger of H^-1
    and the sandwich H^-1 (sum_i g_i g_i^T) H^-1 (White 1982) counts, which allows for residuals that are not as the
    model says. Infinite if the points do not fix the pose.

    Sources: T. A. Louis, Finding the observed information matrix when using the EM algorithm, J. R. Stat. Soc. B 1982;
    H. White, Maximum likelihood estimation of misspecified models, Econometrica 1982.
    """
    if pairs is None:
        return math.inf
    chosen, probability = sets.image.chosen, pairs.probability
    score = np.einsum("kab,ka->kb", pairs.jacobian, pairs.residual)
    rows = (np.sqrt(probability)[:, None, None] * pairs.jacobian).reshape(-1, 6)
    complete = rows.T @ rows
    expected = np.zeros((len(chosen), 6))
    np.add.at(expected, pairs.image, probability[:, None] * score)
    between = expected.T @ expected
    share = len(sets.bearings) / len(chosen)
    known = _known(sets)
    observed = share * (complete - (probability[:, None] * score).T @ score + between) + known
    # In units in which the complete information is one, so that its rank can be told.
    unit = 1 / np.sqrt(np.maximum(np.diag(share * complete + known), 1e-300))
    values, vectors = np.linalg.eigh(observed * np.outer(unit, unit))
    if values[0] <= 1e-9:
        return math.inf
    inverse = unit[:, None] * ((vectors / values) @ vectors.T) * unit
    sandwich = inverse @ (share * between + known) @ inverse
    return math.sqrt(max(float(np.linalg.eigvalsh(v[:3, :3])[-1]) for v in (inverse, sandwich)))


class Pairs(NamedTuple):
    """k pairs of image and scene points that may be partners, and how they depend on a pose.

    image: (k,) places among the chosen image points. probability: (k,) of the pair. seen: (k, 3) direction in which the
    pose sees the scene point. points: (k, 3) of the latter in the camera's axes, from the middle of the scene.
    residual: (k, 3) of the image point, jacobian: (k, 3, 6) of `seen` by turn and shift about that middle; in scales.
    scale: standard deviation of the residuals, radians. distance: of the middle of the scene from the camera.
    """

    image: NDArray[np.int64]
    probability: Array
    seen: Array
    points: Array
    residual: Array
    jacobian: Array
    scale: float
    distance: float


def linearised(sets: PointSets, rotation: Array, translation: Array, scale: float) -> Pairs | None:
    """The pairs that are within a few scales, radians, of each other; None if there is none."""
    turned = sets.points3d @ rotation.T
    camera = turned + translation
    depth = np.linalg.norm(camera, axis=-1)
    used = depth > 0
    if sets.normals3d is not None:
        used &= faces(sets.normals3d, sets.cosines3d, camera, rotation)
    places = np.flatnonzero(used)
    if not len(places):
        return None
    turned, depth, seen = turned[places], depth[places], camera[places] / depth[places, None]
    i, j, probability = _partners(sets, seen, scale)
    if not len(i):
        return None
    middle = rotation @ sets.middle
    p, u = turned[j] - middle, seen[j]
    across = (np.eye(3) - u[:, :, None] * u[:, None, :]) / depth[j, None, None]
    jacobian = np.concatenate([np.cross(p[:, None], across, axisb=2, axisc=2), across], -1) / scale
    residual = (sets.bearings[sets.image.chosen[i]] - u) / scale
    distance = max(float(np.linalg.norm(middle + translation)), 1e-300)
    return Pairs(i, probability, u, p, residual, jacobian, scale, distance)


def _partners(sets: PointSets, seen: Array, scale: float) -> tuple[NDArray[np.int64], NDArray[np.int64], Array]:
    """Pairs (k,) of a chosen image point and a seen scene point (n, 3) near it, and the probability of each."""
    bearings, reach = sets.bearings[sets.image.chosen], FARTHEST * scale
    if len(bearings) * len(seen) <= DENSE:
        squared = ((bearings[:, None] - seen) ** 2).sum(-1)
        i, j = np.nonzero(squared < reach**2)
        squared = squared[i, j]
    else:
        tree, counts = cKDTree(seen), range(1, min(NEIGHBOURS, len(seen)) + 1)
        for count in (counts[:FEW_NEIGHBOURS][-1], counts[-1]):  # few are enough unless all of them are near
            distance, nearest = tree.query(bearings, counts[:count], distance_upper_bound=reach)
            if not np.isfinite(distance[:, -1]).any():
                break
        i, nth = np.nonzero(np.isfinite(distance))
        j, squared = nearest[i, nth], distance[i, nth] ** 2
    density = np.exp(squared * (-0.5 / scale**2)) * (1 - OUTLIERS) / (len(seen) * 2 * math.pi * scale**2)
    every = np.bincount(i, density, len(bearings)) + OUTLIERS / sets.image.solid_angle
    return i, j.astype(np.int64), density / every[i]


def _known(sets: PointSets) -> Array:
    """The information (6, 6) that a prior has about turn and shift; what it knows of the translation is left out."""
    information, prior = np.zeros((6, 6)), sets.prior
    if isinstance(prior, GravityPrior):
        up = np.asarray(prior.up_camera, np.float64) / np.linalg.norm(prior.up_camera)
        information[:3, :3] = (np.eye(3) - np.outer(up, up)) / math.radians(prior.sigma_deg) ** 2
    elif isinstance(prior, PosePrior):
        information[:3, :3] = np.eye(3) / math.radians(prior.rotation_sigma_deg) ** 2
    return information


class Misfit(NamedTuple):
    """How far the pose would be if the camera and the scene were free: radians, and share of the distance."""

    turn: float
    shift: float


def systematic_misfit(pairs: Pairs | None, count: float) -> Misfit:
    """What is significant in the residuals of a pose, `linearised`, with `count` matches.

    Beside the pose, the log of the focal length, or five strains of the scene, are fitted to the residuals, weighed
    with the probabilities of the partners. Of their principal directions, the pose eliminated, those count whose F
    statistic chance exceeds once in a thousand. Zero if there is none, else the larger step of the two.

    >>> import numpy as np
    >>> rng = np.random.default_rng(0)
    >>> points = rng.uniform(-1, 1, (40, 3))
    >>> seen = points + [0, 0, 5] + 1e-3 * rng.standard_normal((40, 3))
    >>> sets = PointSets(seen / np.linalg.norm(seen, axis=1, keepdims=True), points)
    >>> systematic_misfit(linearised(sets, np.eye(3), np.array([0, 0, 5.0]), 2e-4), 40.0)
    Misfit(turn=0.0, shift=0.0)
    """
    if pairs is None:
        return Misfit(0.0, 0.0)
    free = 2 * min(count, float(pairs.probability.sum())) - POSE
    zoomed = pairs.seen * (1, 1, 0) / pairs.scale
    zoomed -= (zoomed * pairs.seen).sum(1, keepdims=True) * pairs.seen
    strained = pairs.jacobian[:, :, 3:] @ (pairs.points @ STRAINS).transpose(1, 2, 0)
    columns = np.concatenate([pairs.jacobian, zoomed[..., None], strained, pairs.residual[..., None]], -1)
    weighed = (np.sqrt(pairs.probability)[:, None, None] * columns).reshape(-1, columns.shape[-1])
    products = weighed.T @ weighed
    pose = np.linalg.pinv(products[:6, :6], hermitian=True)
    parts = slice(6, 7), slice(7, 7 + len(STRAINS))
    moved = np.stack([_moved(products, pose, part, free) for part in parts])
    turn, shift = (float(np.linalg.norm(part, axis=-1).max()) for part in (moved[:, :3], moved[:, 3:]))
    return Misfit(turn, shift / pairs.distance)


def _moved(products: Array, pose: Array, fitted: slice, free: float) -> Array:
    """The step (6,) of the pose if the `fitted` columns are fitted to the residuals beside it.

    products: of the columns with each other; the first six are the pose's, the last one holds the residuals. pose:
    (6, 6), the inverse of those of the pose. free: numbers that were measured, less those of the pose.
    """
    across = pose @ products[:6, fitted]
    values, directions = np.linalg.eigh(products[fitted, fitted] - products[fitted, :6] @ across)
    known = values > 1e-9 * float(np.diag(products)[fitted].max())
    if not 0 < known.sum() < free:
        return np.zeros(6)
    values, directions = values[known], directions[:, known]
    free -= len(values)
    step = (products[fitted, -1] - across.T @ products[:6, -1]) @ directions / values
    gain = step**2 * values
    rest = products[-1, -1] - float(products[-1, :6] @ pose @ products[:6, -1]) - float(gain.sum())
    significant = fdtrc(1, free, gain * free / max(rest, 1e-300)) < EXCEEDED / len(values)
    return np.asarray(across @ directions @ np.where(significant, step, 0.0))
