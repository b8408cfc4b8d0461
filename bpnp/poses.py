"""Comparison of poses that are NumPy arrays."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bpnp.arrays import Floats

AT_ONCE = 16  # poses compared with all others in one matrix product
MIN_POINTS = 4  # matches that fix a pose; three fit up to four poses exactly
UPRIGHT_DEG = 30.0  # largest angle between the upward directions of upright photos [degrees; not tuned]
LEAST_UPRIGHT = 0.5  # smallest fraction of the photos that agree on the direction up [fraction; not tuned]


def rotation_angle(one: Floats, other: Floats) -> float:
    """Return the angle between two rotations (3, 3), radians, in [0, pi]."""
    cosine = (float((one * other).sum()) - 1) / 2
    return math.acos(min(max(cosine, -1.0), 1.0))


class Tolerance(NamedTuple):
    """Largest difference between two poses that count as the same one."""

    degrees: float = 2.0  # angle between the rotations
    shift: float = 0.05  # motion of the centroid of the scene in the camera's frame, a fraction of its distance

    def times(self, factor: float | int) -> "Tolerance":
        """Return a tolerance that is larger by a factor."""
        return Tolerance(factor * self.degrees, factor * self.shift)


SAME = Tolerance()


def same_pose(
    pose: tuple[Floats, Floats], rotation: Floats, translation: Floats, centre: Floats, tolerance: Tolerance = SAME
) -> NDArray[np.bool_]:
    """Find the poses (c,) that are the same as a given one, for a scene with the centroid `centre` (3,).

    >>> import numpy as np
    >>> from bpnp.poses import same_pose
    >>> shifts = np.array([[0, 0, 10], [0.4, 0, 10], [0, 0, 10.6]])
    >>> same_pose((np.eye(3), shifts[0]), np.stack([np.eye(3)] * 3), shifts, np.zeros(3))
    array([ True,  True, False])
    """
    rotations = np.concatenate([pose[0][None], rotation])
    centroid = rotations @ centre + np.concatenate([pose[1][None], translation])
    return close_poses(rotations, polar_coordinates(centroid), 0, *tolerance)[1:]


def polar_coordinates(points: Floats) -> Floats:
    """Return the directions and log distances (c, 4 k) of points (c, 3) or (c, k, 3) in cameras' frames."""
    distance = np.maximum(np.linalg.norm(points, axis=-1, keepdims=True), 1e-300)
    polar = np.concatenate([points / distance, np.log(distance)], -1)
    return np.asarray(polar.reshape(len(polar), int(np.prod(polar.shape[1:]))))


def close_poses(
    rotation: Floats, translation: Floats, i: int | NDArray[np.int64], degrees: float, shift: float
) -> NDArray[np.bool_]:
    """Find the poses that are close to pose i, or to several indices (k,): a mask (c,) or (k, c).

    `shift` is the largest distance of the translations (c, 3), or of whatever else is given for them; `math.inf`
    ignores them. Pose i is close to itself; NaN is close to nothing.
    """
    flat = rotation.reshape(-1, 9)
    alike = flat[i] @ flat.T >= 1 + 2 * math.cos(math.radians(degrees))
    if shift == math.inf:
        return np.asarray(alike)
    return alike & (np.linalg.norm(translation - translation[i][..., None, :], axis=-1) <= shift)


def distinct(
    rotation: Floats, translation: Floats, score: Floats, count: int, degrees: float, shift: float
) -> NDArray[np.int64]:
    """Return the indices of at most `count` poses, best first, of which no two are closer than both limits.

    The limits are those of `close_poses`, the score (c,) is larger for a better pose. Poses with NaN or an infinite
    score are left out.
    """
    kept: list[int] = []
    free = np.isfinite(score)
    order = np.argsort(-np.where(free, score, -np.inf), kind="stable")
    for first in range(0, len(order), AT_ONCE):
        several = order[first : first + AT_ONCE]
        for i, same in zip(several.tolist(), close_poses(rotation, translation, several, degrees, shift), strict=True):
            if len(kept) == count:
                return np.array(kept, dtype=np.int64)
            if free[i]:
                kept.append(i)
                free &= ~same
    return np.array(kept, dtype=np.int64)


def common_up(rotations: Floats) -> Floats | None:
    """Return the direction up (3,) of a map, a unit vector, on which most photos with rotations (v, 3, 3) agree.

    The y axis of an upright photo points down. Photos stored on their side are outvoted. None if too few agree.
    """
    ups = -rotations[:, 1]
    cosines = ups @ ups[:: -(-len(ups) // 200)].T  # compared with at most 200 photos
    agree = cosines > math.cos(math.radians(UPRIGHT_DEG))
    best = agree[:, int(agree.sum(0).argmax())]
    if best.mean() < LEAST_UPRIGHT:
        return None
    mean = ups[best].mean(0)
    return np.asarray(mean / np.linalg.norm(mean))
