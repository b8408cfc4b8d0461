"""The views of a map: which points they see and from where."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bpnp.cameras import Camera

Array = NDArray[np.float64]
# A local feature is found again from some way beside the cameras that saw it, and hardly from farther: of the points
# that photos of five models see, 95 % are seen from 22 degrees or less beyond the directions of the track, where of the
# points that project into these photos and are not seen 21 to 85 % would be seen from more than 30 degrees beyond.
MARGIN_DEG = 25.0  # beyond the directions of the track


@dataclass(frozen=True, eq=False)
class View:
    """A registered image of the map; camera = rotation p + translation (COLMAP's cam_from_world).

    points: (k,) places in `SceneMap.points3d` of the points that it sees, ascending.
    """

    name: str
    camera: Camera
    rotation: Array
    translation: Array
    points: NDArray[np.int32]

    @property
    def centre(self) -> Array:
        """Centre of the camera in the scene, -R^T t."""
        return -self.rotation.T @ self.translation


class Cones(NamedTuple):
    """axes: (n, 3) unit vectors. cosines: (n,) of the angle about the axis from within which a point is seen."""

    axes: Array
    cosines: Array


def viewing_cones(points3d: Array, views: Iterable[tuple[Array, NDArray[np.integer]]]) -> Cones:
    """The cones of n points from views: the centre of the camera, and the places of the points that it sees.

    The axis is the mean direction to the cameras; the cone holds all of them and MARGIN_DEG more. A point that no view
    sees has a cone of all directions.

    >>> cones = viewing_cones(np.zeros((1, 3)), [(np.array([0.0, 0, 2]), np.array([0]))])
    >>> (cones.axes + 0.0).tolist(), round(float(np.degrees(np.arccos(cones.cosines[0]))))
    ([[0.0, 0.0, 1.0]], 25)
    """
    tracks = list(views)
    sums, least = np.zeros_like(points3d), np.ones(len(points3d))
    for centre, seen in tracks:
        sums[seen] += _directions(points3d[seen], centre)
    axes = _directions(sums, np.zeros(3)) * -1
    for centre, seen in tracks:
        cosine = (_directions(points3d[seen], centre) * axes[seen]).sum(-1)
        least[seen] = np.minimum(least[seen], cosine)
    half = np.degrees(np.arccos(np.clip(least, -1, 1))) + MARGIN_DEG
    cosines = np.cos(np.radians(np.minimum(half, 180.0)))
    unseen = np.asarray(~sums.any(-1))
    return Cones(np.where(unseen[:, None], [0.0, 0, 1], axes), np.where(unseen, -1.0, cosines))


def _directions(points: Array, centre: Array) -> Array:
    """Unit vectors (n, 3) from points to a centre; zero for one that lies there."""
    towards = centre - points
    return np.asarray(towards / np.maximum(np.linalg.norm(towards, axis=-1, keepdims=True), 1e-300))
