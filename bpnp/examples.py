"""Problems to try, with the true pose.

Nothing is downloaded: the points come from the generators that the package trains on.
"""

from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np
from scipy.spatial.transform import Rotation

from bpnp.datamodules.meshes.procedural import procedural_shape
from bpnp.datamodules.meshes.surfaces import sample_surface
from bpnp.datamodules.synthetic_maps.maps import LONG_SIDE, MapOptions, draw_map_pair

Kind = Literal["mesh", "photo", "leds"]
CAMERA = np.array([[800.0, 0.0, 640.0], [0.0, 800.0, 480.0], [0.0, 0.0, 1.0]])  # of 1280 x 960 pixels
NOISE_PX = 0.5
LEDS, LIGHTS = 17, 3


@dataclass(frozen=True)
class Example:
    """points2d: (m, 2) pixels. points3d: (n, 3). camera: (3, 3). rotation, translation: camera = R p + t.

    normals3d: (n, 3) outward normals, None where points have none.
    """

    points2d: np.ndarray[Any, np.dtype[np.float64]]
    points3d: np.ndarray[Any, np.dtype[np.float64]]
    camera: np.ndarray[Any, np.dtype[np.float64]]
    rotation: np.ndarray[Any, np.dtype[np.float64]]
    translation: np.ndarray[Any, np.dtype[np.float64]]
    normals3d: np.ndarray[Any, np.dtype[np.float64]] | None = None

    def rotation_error_deg(self, rotation: Any) -> float:
        """Angle between a rotation and the true one, degrees."""
        return float(np.degrees(Rotation.from_matrix(np.asarray(rotation) @ self.rotation.T).magnitude()))


def load(kind: Kind | str, *, seed: int = 0) -> Example:
    """A problem of one kind; the same for the same seed.

    - "mesh": 200 points on a shape, all of them seen, from any side;
    - "photo": keypoints of a photo and points of a map, of which a third have no partner;
    - "leds": 17 LEDs on a ring with their normals, those that face the camera, and 3 background lights.

    Raises ValueError for another kind.

    >>> from bpnp.examples import load
    >>> load("mesh").points2d.shape
    (200, 2)
    """
    if kind not in get_args(Kind):
        raise ValueError(f"expected an example among {', '.join(get_args(Kind))}, got {kind!r}")
    rng = np.random.default_rng(seed)
    return {"mesh": _mesh, "photo": _photo, "leds": _leds}[kind](rng)


def _mesh(rng: np.random.Generator) -> Example:
    points = sample_surface(procedural_shape(rng), 200, rng)
    points = (points - points.mean(0)) / np.abs(points - points.mean(0)).max()
    rotation = Rotation.from_quat(rng.standard_normal(4)).as_matrix()
    translation = np.array([0.1, -0.2, 4.0])
    seen = _pixels(points, rotation, translation) + rng.normal(0, NOISE_PX, (len(points), 2))
    return Example(rng.permutation(seen), points, CAMERA, rotation, translation)


def _photo(rng: np.random.Generator) -> Example:
    options = MapOptions(
        num_points=300, min_points=150, outliers=0.33, views=(1, 1), kinds={"facades": 1.0}, noise_px=NOISE_PX
    )
    pair = draw_map_pair("photo", options, rng)
    camera = np.diag([LONG_SIDE, LONG_SIDE, 1.0])
    return Example(
        LONG_SIDE * pair.points2d.astype(np.float64), pair.points3d.astype(np.float64), camera,
        np.asarray(pair.rotation, np.float64), np.asarray(pair.translation, np.float64),
    )  # fmt: skip


def _leds(rng: np.random.Generator) -> Example:
    angle = np.sort(rng.uniform(0, 2 * np.pi, LEDS))
    height = rng.uniform(-0.03, 0.03, LEDS)  # metres
    points = np.stack([0.1 * np.cos(angle), 0.1 * np.sin(angle), height], -1)
    normals = points * [1, 1, 0] / 0.1
    rotation = Rotation.from_euler("xyz", [75, 10, 40], degrees=True).as_matrix()
    translation = np.array([0.02, 0.01, 0.6])  # metres
    facing = ((points @ rotation.T + translation) * (normals @ rotation.T)).sum(-1) < 0
    seen = _pixels(points[facing], rotation, translation) + rng.normal(0, NOISE_PX, (facing.sum(), 2))
    lights = rng.uniform(seen.min(0) - 40, seen.max(0) + 40, (LIGHTS, 2))
    return Example(rng.permutation(np.concatenate([seen, lights])), points, CAMERA, rotation, translation, normals)


def _pixels(points: Any, rotation: Any, translation: Any) -> Any:
    camera = points @ rotation.T + translation
    return camera[:, :2] / camera[:, 2:] @ CAMERA[:2, :2].T + CAMERA[:2, 2]
