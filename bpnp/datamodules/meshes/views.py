"""Virtual cameras: what a camera drawn at random sees of a set of surface samples."""

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from bpnp.datamodules.loader import Pair
from bpnp.geometry import MIN_POINTS

MIN_DEPTH = 0.1  # scene units; nothing nearer to the camera is seen


@dataclass(frozen=True)
class Views:
    """How cameras are drawn. The defaults are those of Campbell et al. (ECCV 2020) for ModelNet40.

    rotation: "euler" draws R = Rz Ry Rx with each angle uniform in `euler_range` (degrees); "so3" draws R uniformly.
    translation_range, distance: t = (x, y, distance + z), each of x, y, z uniform in +-translation_range; scene units.
    focal: pixels. The paper's image has 640 x 480 pixels, but points beyond its border are kept, there and here.
    noise_px: standard deviation of the normal noise on each 2D coordinate, in pixels.
    """

    rotation: Literal["euler", "so3"] = "euler"
    euler_range: tuple[float, float] = (0.0, 45.0)
    translation_range: float = 0.5
    distance: float = 4.5
    focal: float = 800.0
    noise_px: float = 2.0

    def __post_init__(self) -> None:
        if self.rotation not in ("euler", "so3"):
            raise ValueError(f"expected `rotation` euler or so3, got {self.rotation!r}")
        low, high = self.euler_range
        if not -math.inf < low <= high < math.inf:
            raise ValueError(f"expected `euler_range` as (low, high) in degrees, got {self.euler_range}")
        for name in ("translation_range", "distance", "noise_px"):
            if not 0 <= getattr(self, name) < math.inf:
                raise ValueError(f"expected a finite, non-negative `{name}`, got {getattr(self, name)}")
        if not 0 < self.focal < math.inf:
            raise ValueError(f"expected a positive `focal` in pixels, got {self.focal}")

    def sees_all(self, radius: float) -> bool:
        """Whether no camera can come too near to a point within `radius` of the origin."""
        return self.distance - self.translation_range - radius > MIN_DEPTH


def draw_pose(views: Views, rng: np.random.Generator) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Rotation (3, 3) and translation (3,) of a camera = R p + t."""
    if views.rotation == "so3":
        rotation = Rotation.from_quat(rng.standard_normal(4))  # a normal 4-vector has a uniform direction
    else:
        rotation = Rotation.from_euler("xyz", rng.uniform(*views.euler_range, 3), degrees=True)
    offset = rng.uniform(-views.translation_range, views.translation_range, 3)
    return rotation.as_matrix(), offset + np.array([0.0, 0.0, views.distance])


def draw_pair(
    name: str,
    samples: NDArray[np.float32],
    *,
    num_points: int,
    views: Views,
    rng: np.random.Generator,
) -> Pair:
    """A random camera's view of `num_points` of the samples (k, 3), drawn without replacement.

    points2d are the points seen, x/z and y/z plus noise, in random order. A point behind the camera, or less than
    0.1 in front of it, has no 2D point and -1 in match3d. Raises ValueError if fewer than 4 points are seen.
    """
    points3d = samples[rng.permutation(len(samples))[:num_points]]
    rotation, translation = draw_pose(views, rng)
    camera = points3d @ rotation.T + translation
    order = rng.permutation(np.flatnonzero(camera[:, 2] > MIN_DEPTH))  # 2D point i shows 3D point order[i]
    if len(order) < MIN_POINTS:
        raise ValueError(
            f"expected at least {MIN_POINTS} points in front of the camera, got {len(order)} in {name}; "
            "try normalisation unit_sphere or a larger `distance`"
        )
    points2d = camera[order, :2] / camera[order, 2:]
    points2d += rng.normal(scale=views.noise_px / views.focal, size=points2d.shape)
    match3d = np.full(len(points3d), -1)
    match3d[order] = np.arange(len(order))
    return Pair(name, points2d.astype(np.float32), points3d, rotation, translation, match3d, views.focal)
