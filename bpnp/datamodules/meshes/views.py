"""Virtual cameras: what cameras drawn at random see of surface samples."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import roma
import torch
from jaxtyping import Float, Int
from torch import Tensor

from bpnp.datamodules.augment import picked
from bpnp.datamodules.keyed_random import Purpose, normal, permutations, rotations, stream, uniform
from bpnp.geometry import MIN_POINTS, project, transform
from bpnp.types import Batch

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


def draw_poses(views: Views, keys: Int[Tensor, " b"]) -> tuple[Float[Tensor, "b 3 3"], Float[Tensor, "b 3"]]:
    """A random camera = R p + t for each key; float64."""
    numbers = uniform(keys, 6)
    if views.rotation == "so3":
        rotation = rotations(stream(keys, Purpose.POSE))
    else:
        low, high = (math.radians(angle) for angle in views.euler_range)
        rotation = roma.euler_to_rotmat("xyz", low + (high - low) * numbers[:, :3])
    offset = views.translation_range * (2 * numbers[:, 3:] - 1)
    offset[:, 2] += views.distance
    return rotation, offset


def draw_views(
    samples: Float[Tensor, "b k 3"], index: Int[Tensor, " b"], views: Views, num_points: int, keys: Int[Tensor, " b"]
) -> Batch:
    """A random camera's view of `num_points` samples of each row, drawn without replacement; as `stacked` makes pairs.

    2D points are x/z and y/z plus noise, computed in float64. A point behind the camera, or less than 0.1 in front of
    it, has no 2D point and -1 in match3d.
    """
    subset = permutations(stream(keys, Purpose.SUBSET), samples.shape[1])[:, :num_points]
    points3d = picked(samples, subset)
    rotation, translation = draw_poses(views, stream(keys, Purpose.POSE))
    camera = transform(rotation, translation, points3d.double())
    seen = camera[..., 2] > MIN_DEPTH
    noise = normal(stream(keys, Purpose.NOISE), 2 * num_points).view(-1, num_points, 2)
    points2d = project(camera) + noise * (views.noise_px / views.focal)
    return Batch(
        points2d=(points2d.where(seen[..., None], 0.0)).float(),
        points3d=points3d,
        mask2d=seen,
        mask3d=torch.ones_like(seen),
        focal=torch.full((len(samples),), views.focal, device=samples.device),
        index=index,
        ids=(),
        rotation=rotation,
        translation=translation,
        match3d=torch.arange(num_points, device=samples.device).where(seen, -1),
        origin=torch.zeros(len(samples), 3, dtype=torch.float64, device=samples.device),
    )


def check_seen(batch: Batch, names: Sequence[str]) -> None:
    """Raises ValueError that names the first pair of which a camera sees fewer than 4 points."""
    count = batch.count2d
    if bool((few := count < MIN_POINTS).any()):
        first = int(few.nonzero()[0, 0])
        raise ValueError(
            f"expected at least {MIN_POINTS} points in front of the camera, got {int(count[first])} in {names[first]}; "
            "try normalisation unit_sphere or a larger `distance`"
        )
