"""Residuals that no pose explains, but another focal length or other proportions of the scene would."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import fdtrc

from bpnp.search.evidence.uncertainty import EXCEEDED, linearised
from bpnp.search.point_sets import PointSets

Array = NDArray[np.float64]
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
FITTED = 6 + len(STRAINS)  # numbers


class Misfit(NamedTuple):
    """How far the pose would be if the camera and the scene were free: radians, and share of the distance."""

    turn: float
    shift: float


def systematic_misfit(sets: PointSets, rotation: Array, translation: Array, scale: float, count: float) -> Misfit:
    """What is significant in the residuals of a pose with `count` matches at `scale` radians.

    Beside the pose, the log of the focal length, or five strains of the scene, are fitted to the residuals, weighed
    with the probabilities of the partners. Of their principal directions, the pose eliminated, those count whose F
    statistic chance exceeds once in a thousand. Zero if there is none, else the larger step of the two.

    >>> import numpy as np
    >>> rng = np.random.default_rng(0)
    >>> points = rng.uniform(-1, 1, (40, 3))
    >>> seen = points + [0, 0, 5] + 1e-3 * rng.standard_normal((40, 3))
    >>> sets = PointSets(seen / np.linalg.norm(seen, axis=1, keepdims=True), points)
    >>> systematic_misfit(sets, np.eye(3), np.array([0, 0, 5.0]), 2e-4, 40.0)
    Misfit(turn=0.0, shift=0.0)
    """
    if 2 * count <= FITTED:
        return Misfit(0.0, 0.0)
    pairs = linearised(sets, rotation, translation, scale)
    if pairs is None or 2 * pairs.probability.sum() <= FITTED:
        return Misfit(0.0, 0.0)
    free = 2 * min(count, float(pairs.probability.sum())) - FITTED
    zoomed = pairs.seen * (1, 1, 0) / scale
    zoomed -= (zoomed * pairs.seen).sum(1, keepdims=True) * pairs.seen
    strained = (pairs.jacobian[:, None, :, 3:] @ (pairs.points @ STRAINS).transpose(1, 0, 2)[..., None])[..., 0]
    columns = np.concatenate(
        [pairs.jacobian, zoomed[..., None], strained.transpose(0, 2, 1), pairs.residual[..., None]], -1
    )
    weighed = (np.sqrt(pairs.probability)[:, None, None] * columns).reshape(-1, columns.shape[-1])
    products = weighed.T @ weighed
    moved = np.stack([_moved(products, slice(6, 7), free), _moved(products, slice(7, 7 + len(STRAINS)), free)])
    turn, shift = (float(np.linalg.norm(part, axis=-1).max()) for part in (moved[:, :3], moved[:, 3:]))
    return Misfit(turn, shift / max(float(np.linalg.norm(rotation @ sets.middle + translation)), 1e-300))


def _moved(products: Array, fitted: slice, free: float) -> Array:
    """The step (6,) of the pose if the `fitted` columns are fitted to the residuals beside it.

    products: of the columns with each other; the first six are the pose's, the last one holds the residuals.
    """
    pose = np.linalg.pinv(products[:6, :6], hermitian=True)
    across = pose @ products[:6, fitted]
    values, directions = np.linalg.eigh(products[fitted, fitted] - products[fitted, :6] @ across)
    known = values > 1e-9 * float(np.diag(products)[fitted].max())
    if not known.any():
        return np.zeros(6)
    values, directions = values[known], directions[:, known]
    step = (products[fitted, -1] - across.T @ products[:6, -1]) @ directions / values
    gain = step**2 * values
    rest = products[-1, -1] - float(products[-1, :6] @ pose @ products[:6, -1]) - float(gain.sum())
    significant = fdtrc(1, free, gain * free / max(rest, 1e-300)) < EXCEEDED / len(values)
    return np.asarray(across @ directions @ np.where(significant, step, 0.0))
