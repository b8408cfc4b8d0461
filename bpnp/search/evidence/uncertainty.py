"""How well points fix a pose: its covariance, bounds of its rotation and of the camera's centre that allow for few
residuals, and residuals that no pose explains, but another focal length or other proportions of the scene would."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.special import fdtrc, fdtri, stdtrit

from bpnp.search.point_sets import PointSets, faces
from bpnp.search.starts import GravityPrior, PosePrior

Array = NDArray[np.float64]
Labels = NDArray[np.int64]
FARTHEST = 4.0  # scales from an image point within which scene points may be its partner
FEW_NEIGHBOURS, NEIGHBOURS = 8, 64  # of an image point that are looked up: of most, and where more are near
DENSE = 4096  # possible matches up to which all distances are computed
OUTLIERS = 0.3  # share of the image points without a partner that the assignment expects
EXCEEDED = 1e-3  # probability that a pose is farther off than its bound, and of a test
ONE_SIGMA = 0.8413447460685429  # probability of a normal variable below one standard deviation

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


def rotation_bound(sets: PointSets, linear: "Linearised | None", count: float) -> float:
    """Angle, radians, that the error of the rotation exceeds once in a thousand; see `_bound`.

    linear: `linearised` with the standard deviation of the residuals, estimated from `count` matches.

    >>> import numpy as np
    >>> rng = np.random.default_rng(0)
    >>> points = rng.uniform(-1, 1, (12, 3))
    >>> seen = points + [0, 0, 6]
    >>> sets = PointSets(seen / np.linalg.norm(seen, axis=1, keepdims=True), points)
    >>> linear = linearised(sets, np.eye(3), np.array([0.0, 0, 6]), 1e-3)
    >>> bounds = [rotation_bound(sets, linear, count) for count in (4.0, 12.0)]
    >>> [round(math.degrees(bound), 1) for bound in bounds]
    [5.3, 0.7]
    """
    covariance = local_covariance(linear)
    return math.inf if covariance is None else _bound(covariance[:3, :3], 2 * count - 2 * sets.pairs_that_fix)


def centre_bound(sets: PointSets, linear: "Linearised | None", count: float) -> float:
    """Distance, scene units, that the error of the camera's centre exceeds once in a thousand; see `_bound`."""
    covariance = local_covariance(linear)
    if covariance is None or linear is None:
        return math.inf
    return _bound(centre_covariance(covariance, linear.middle), 2 * count - 2 * sets.pairs_that_fix)


def _bound(covariance: Array, free: float) -> float:
    """Length that a vector of this covariance (3, 3) exceeds once in a thousand.

    The square of its length is about that of d independent axes of equal variance (Satterthwaite 1946), d =
    (tr C)^2 / tr C^2, one for a single loose axis and three for equal ones: tr C times the quantile of F with d and
    `free` degrees of freedom, those that the estimate of the residuals' scale had.
    """
    if free <= 0:
        return math.inf
    total, squared = float(np.trace(covariance)), float((covariance**2).sum())
    return math.sqrt(total * float(fdtri(total**2 / squared, free, 1 - EXCEEDED)))


def pose_covariance(sets: PointSets, linear: "Linearised | None", count: float, origin: Array) -> Array | None:
    """Covariance (6, 6) of a pose, None where the points do not fix it.

    Of (w, v): the true pose is R' = exp([w]x) R, t' = t + v, w in radians in the camera's axes, v in scene units; of a
    scene whose points are `sets.points3d` plus `origin`. `local_covariance`, times the square of the quantile of
    Student's t that has one sigma of a normal distribution, as the scale is estimated from `count` matches.
    """
    covariance = local_covariance(linear)
    if covariance is None or linear is None:
        return None
    free = max(2 * count - 2 * sets.pairs_that_fix, 1.0)
    moved = np.eye(6)  # the shift of the middle, as that of the origin: v = s + (R m) x w
    moved[3:, :3] = _crossed(linear.rotation @ (sets.middle + origin))
    return np.asarray(float(stdtrit(free, ONE_SIGMA)) ** 2 * moved @ covariance @ moved.T)


def centre_covariance(covariance: Array, translation: Array) -> Array:
    """Covariance (3, 3), in the camera's axes, of the centre of the camera, -R' (v + t x w) for a pose's (w, v).

    translation: of the point about which the pose turns: t for the scene's origin.
    """
    moved = np.concatenate([_crossed(translation), np.eye(3)], 1)
    return np.asarray(moved @ covariance @ moved.T)


def local_covariance(linear: "Linearised | None") -> Array | None:
    """Covariance (6, 6) of the turn w and the shift of the middle of the scene, from noise of `linear.scale`; None if
    the points do not fix the pose.

    Image point i has scene point j as its partner with the probability p_ij. With J_ij the derivative of the direction
    u_j by the turn and the shift, and the scores g_ij = J_ij^T (f_i - u_j) / s^2, g_i = sum_j p_ij g_ij, the observed
    information is (Louis 1982)

        H = sum_ij p_ij (J_ij^T J_ij / s^2 - g_ij g_ij^T) + sum_i g_i g_i^T + that of the prior:

    where scene points lie as close as the residuals, what their partners leave open is subtracted. What a prior knows
    of the pose counts as a measurement beside the points. The sandwich H^-1 (sum_i g_i g_i^T) H^-1 (White 1982) allows
    for residuals that are not as the model says. With H^-1 = L L^T, the larger of both counts along each of the common
    axes, the eigenvectors of L^T (sum_i g_i g_i^T) L.

    Sources: T. A. Louis, Finding the observed information matrix when using the EM algorithm, J. R. Stat. Soc. B 1982;
    H. White, Maximum likelihood estimation of misspecified models, Econometrica 1982.
    """
    if linear is None:
        return None
    sets, probability = linear.sets, linear.probability
    chosen = sets.image.chosen
    score = np.einsum("kab,ka->kb", linear.jacobian, linear.residual)
    rows = (np.sqrt(probability)[:, None, None] * linear.jacobian).reshape(-1, POSE)
    complete = rows.T @ rows
    expected = np.zeros((len(chosen), POSE))
    np.add.at(expected, linear.image, probability[:, None] * score)
    between = expected.T @ expected
    share = len(sets.bearings) / len(chosen)
    known = _known(linear)
    observed = share * (complete - (probability[:, None] * score).T @ score + between) + known
    # In units in which the complete information is one, so that its rank can be told.
    unit = 1 / np.sqrt(np.maximum(np.diag(share * complete + known), 1e-300))
    values, vectors = np.linalg.eigh(observed * np.outer(unit, unit))
    if values[0] <= 1e-9:
        return None
    root = unit[:, None] * vectors / np.sqrt(values)
    ratio, axes = np.linalg.eigh(root.T @ (share * between + known) @ root)
    along = root @ axes
    return np.asarray(along * np.maximum(ratio, 1.0) @ along.T)


class Linearised(NamedTuple):
    """A pose, and the k possible matches that are near each other under it, as they depend on it.

    image: (k,) places among the chosen image points. probability: (k,) of the match. seen: (k, 3) direction in which
    the pose sees the scene point. points: (k, 3) of the latter in the camera's axes, from the middle of the scene.
    residual: (k, 3) of the image point, jacobian: (k, 3, 6) of `seen` by turn and shift about that middle; in scales.
    scale: standard deviation of the residuals, radians. middle: (3,) of the scene, seen from the camera, in its axes.
    """

    sets: PointSets
    rotation: Array
    image: NDArray[np.int64]
    probability: Array
    seen: Array
    points: Array
    residual: Array
    jacobian: Array
    scale: float
    middle: Array


def linearised(sets: PointSets, rotation: Array, translation: Array, scale: float) -> Linearised | None:
    """A pose with the matches that are within a few scales, radians, of each other; None if there is none."""
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
    i, j, probability = _partners(sets, seen, places, scale)
    if not len(i):
        return None
    middle = rotation @ sets.middle
    p, u = turned[j] - middle, seen[j]
    across = (np.eye(3) - u[:, :, None] * u[:, None, :]) / depth[j, None, None]
    jacobian = np.concatenate([np.cross(p[:, None], across, axisb=2, axisc=2), across], -1) / scale
    residual = (sets.bearings[sets.image.chosen[i]] - u) / scale
    return Linearised(sets, rotation, i, probability, u, p, residual, jacobian, scale, middle + translation)


def _partners(
    sets: PointSets, seen: Array, places: Labels, scale: float
) -> tuple[NDArray[np.int64], NDArray[np.int64], Array]:
    """Matches (k,) of a chosen image point and a scene point near it, and the probability of each.

    seen: (n, 3) directions of the scene points at `places`.
    """
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
    j, candidates = j.astype(np.int64), np.full(len(bearings), len(seen))
    if sets.labels2d is not None and sets.labels3d is not None:
        label, others = sets.labels2d[sets.image.chosen], sets.labels3d[places]
        agree = (label[i] == others[j]) | (label[i] < 0) | (others[j] < 0)
        i, j, squared = i[agree], j[agree], squared[agree]
        counts = np.bincount(others + 1, minlength=int(label.max(initial=0)) + 2)
        candidates = np.where(label < 0, len(seen), counts[label + 1] + counts[0])
    density = np.exp(squared * (-0.5 / scale**2)) * (1 - OUTLIERS) / (candidates[i] * 2 * math.pi * scale**2)
    every = np.bincount(i, density, len(bearings)) + OUTLIERS / sets.image.solid_angle
    return i, j, density / every[i]


def _known(linear: Linearised) -> Array:
    """The information (6, 6) that a prior has about turn and shift."""
    information, prior = np.zeros((POSE, POSE)), linear.sets.prior
    if isinstance(prior, GravityPrior):
        up = np.asarray(prior.up_camera, np.float64) / np.linalg.norm(prior.up_camera)
        information[:3, :3] = (np.eye(3) - np.outer(up, up)) / math.radians(prior.sigma_deg) ** 2
    elif isinstance(prior, PosePrior):
        information[:3, :3] = np.eye(3) / math.radians(prior.rotation_sigma_deg) ** 2
        if prior.translation is not None:
            moved = np.concatenate([_crossed(linear.rotation @ linear.sets.middle), np.eye(3)], 1)
            information += moved.T @ moved / prior.translation_sigma**2
    return information


def _crossed(vector: Array) -> Array:
    """The matrix (3, 3) that gives the cross product of `vector` with another."""
    x, y, z = vector
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])


class Misfit(NamedTuple):
    """How far the pose would be if the camera and the scene were free: radians, and share of the distance."""

    turn: float
    shift: float


def systematic_misfit(linear: Linearised | None, count: float) -> Misfit:
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
    if linear is None:
        return Misfit(0.0, 0.0)
    free = 2 * min(count, float(linear.probability.sum())) - POSE
    zoomed = linear.seen * (1, 1, 0) / linear.scale
    zoomed -= (zoomed * linear.seen).sum(1, keepdims=True) * linear.seen
    strained = linear.jacobian[:, :, 3:] @ (linear.points @ STRAINS).transpose(1, 2, 0)
    columns = np.concatenate([linear.jacobian, zoomed[..., None], strained, linear.residual[..., None]], -1)
    weighed = (np.sqrt(linear.probability)[:, None, None] * columns).reshape(-1, columns.shape[-1])
    products = weighed.T @ weighed
    pose = np.linalg.pinv(products[:6, :6], hermitian=True)
    parts = slice(6, 7), slice(7, 7 + len(STRAINS))
    moved = np.stack([_moved(products, pose, part, free) for part in parts])
    turn, shift = (float(np.linalg.norm(part, axis=-1).max()) for part in (moved[:, :3], moved[:, 3:]))
    return Misfit(turn, shift / max(float(np.linalg.norm(linear.middle)), 1e-300))


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
