"""Residuals that no pose explains, but another focal length or other proportions of the scene would."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import fdtrc

from bpnp.search.evidence.uncertainty import EXCEEDED, Pairs, linearised
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
    pairs = linearised(sets, rotation, translation, scale)
    if pairs is None:
        return Misfit(0.0, 0.0)
    free = 2 * min(count, float(pairs.probability.sum())) - 6 - len(STRAINS)
    if free <= 0:
        return Misfit(0.0, 0.0)
    u = pairs.seen
    zoomed = np.column_stack([u[:, :2], np.zeros(len(u))]) / scale
    zoomed -= (zoomed * u).sum(1, keepdims=True) * u
    strained = np.einsum("kab,ekb->kae", pairs.jacobian[:, :, 3:], pairs.points @ STRAINS)
    distance = float(np.linalg.norm(rotation @ sets.middle + translation))
    moved = np.stack([_moved(pairs, columns, free) for columns in (zoomed[:, :, None], strained)])
    turn, shift = (float(np.linalg.norm(part, axis=-1).max()) for part in (moved[:, :3], moved[:, 3:]))
    return Misfit(turn, shift / max(distance, 1e-300))


def _moved(pairs: Pairs, columns: Array, free: float) -> Array:
    """The step (6,) of the pose if the columns (k, 3, e) are fitted to the residuals beside it."""
    both = np.concatenate([pairs.jacobian, columns], -1)
    weighed = pairs.probability[:, None, None] * both
    normal, gradient = np.einsum("kab,kac->bc", weighed, both), np.einsum("kab,ka->b", weighed, pairs.residual)
    pose = np.linalg.pinv(normal[:6, :6], hermitian=True)
    across = pose @ normal[:6, 6:]
    values, directions = np.linalg.eigh(normal[6:, 6:] - normal[6:, :6] @ across)
    known = values > 1e-9 * float(np.diag(normal)[6:].max())
    if not known.any():
        return np.zeros(6)
    values, directions = values[known], directions[:, known]
    step = (gradient[6:] - across.T @ gradient[:6]) @ directions / values
    total = float((pairs.probability * (pairs.residual**2).sum(-1)).sum()) - float(gradient[:6] @ pose @ gradient[:6])
    gain = step**2 * values
    rest = max(total - float(gain.sum()), 1e-300) / free
    significant = fdtrc(1, free, gain / rest) < EXCEEDED / len(values)
    return np.asarray(across @ directions @ np.where(significant, step, 0.0))
