"""Problems of meshes' surface samples and what virtual cameras, drawn at random, see of them."""

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import roma
import torch
from jaxtyping import Float, Int
from numpy.typing import NDArray
from torch import Tensor

from bpnp.datamodules.augment import picked
from bpnp.datamodules.keyed_random import Purpose, normal, permutations, rotations, row_keys, stream, uniform
from bpnp.datamodules.problem import Counts
from bpnp.datamodules.store import Store
from bpnp.geometry import MIN_POINTS, project, transform
from bpnp.types import Batch

POINTS = "points"  # the bulk column of a store of surface samples
SURFACES = "surfaces"  # the kind of such a store
MIN_DEPTH = 0.1  # scene units; nothing nearer to the camera is seen


@dataclass(frozen=True)
class RandomCameras:
    """How cameras are drawn, see `MeshDataModule`: t = (x, y, distance + z), each of x, y, z in +-translation_range.

    The defaults are those of Campbell et al. (ECCV 2020) for ModelNet40. The paper's image has 640 x 480 pixels, but
    points beyond its border stay, there and here.
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

    def poses(self, keys: Int[Tensor, " b"]) -> tuple[Float[Tensor, "b 3 3"], Float[Tensor, "b 3"]]:
        """A random camera = R p + t for each key; float64."""
        numbers = uniform(keys, 6)
        if self.rotation == "so3":
            rotation = rotations(stream(keys, Purpose.POSE))
        else:
            low, high = (math.radians(angle) for angle in self.euler_range)
            rotation = roma.euler_to_rotmat("xyz", low + (high - low) * numbers[:, :3])
        offset = self.translation_range * (2 * numbers[:, 3:] - 1)
        offset[:, 2] += self.distance
        return rotation, offset


class MeshSource:
    """A `ProblemSource`: problem i is view i // k of mesh rows[i % k] of a store of surface samples, k meshes in all.

    Fewer problems than meshes are a random choice of the meshes. A problem draws its points from the first `pool_size`
    samples of its mesh; it is a function of (seed, epoch, index).

    Warns if cameras may come too near to some points. Raises ValueError for no problems.
    """

    def __init__(
        self,
        store: Store,
        rows: NDArray[np.int64],
        *,
        num_pairs: int | None,
        num_points: int,
        pool_size: int,
        cameras: RandomCameras,
        seed: Sequence[int],
        label: str,
    ) -> None:
        if num_pairs is not None and num_pairs < 1:
            raise ValueError(f"expected at least one {label} problem, got {num_pairs}")
        radius = float(store.columns["radius"][rows].max())
        self.sees_all = cameras.distance - cameras.translation_range - radius > MIN_DEPTH
        if not self.sees_all:
            warnings.warn(
                f"the {label} meshes reach {radius:.3g} from their origin: points that fall behind a camera at "
                f"`distance` {cameras.distance} get no 2D point; try normalisation unit_sphere or a larger distance",
                stacklevel=2,
            )
        self.num_pairs = len(rows) if num_pairs is None else num_pairs
        if self.num_pairs < len(rows):  # the first meshes would all be of one class
            rows = np.sort(np.random.default_rng(seed[0]).choice(rows, self.num_pairs, replace=False))
        self.store, self.rows, self.num_points, self.pool_size = store, rows, num_points, pool_size
        self.cameras, self.seed = cameras, tuple(seed)
        self._on_device: Tensor | None = None

    @property
    def counts(self) -> Counts:
        points = np.full(self.num_pairs, self.num_points)
        return Counts(points, points, points)

    def names(self, index: Sequence[int]) -> tuple[str, ...]:
        views = (divmod(i, len(self.rows)) for i in index)
        return tuple(f"{self.store.name(int(self.rows[mesh]))}#{view}" for view, mesh in views)

    def batch(self, index: Int[Tensor, " b"], epoch: int) -> Batch:
        """A random camera's view of `num_points` samples of each mesh, drawn without replacement.

        2D points are x/z and y/z plus noise, computed in float64. A point behind the camera, or less than 0.1 in front
        of it, has no 2D point and -1 in match3d. Raises ValueError that names a problem of which fewer than 4 are left.
        """
        count, size, device = self.num_points, len(index), index.device
        keys = row_keys(index, *self.seed, epoch)
        samples = self._samples(index % len(self.rows))
        points3d = picked(samples, permutations(stream(keys, Purpose.SUBSET), samples.shape[1])[:, :count])
        rotation, translation = self.cameras.poses(stream(keys, Purpose.POSE))
        camera = transform(rotation, translation, points3d.double())
        seen = camera[..., 2] > MIN_DEPTH
        if not self.sees_all and bool((few := seen.sum(-1) < MIN_POINTS).any()):
            first = int(few.nonzero()[0, 0])
            raise ValueError(
                f"expected at least {MIN_POINTS} points in front of the camera, got {int(seen[first].sum())} in "
                f"{self.names(index.tolist())[first]}; try normalisation unit_sphere or a larger `distance`"
            )
        noise = normal(stream(keys, Purpose.NOISE), 2 * count).view(size, count, 2)
        points2d = project(camera) + noise * (self.cameras.noise_px / self.cameras.focal)
        return Batch(
            points2d=(points2d.where(seen[..., None], 0.0)).float(),
            points3d=points3d,
            mask2d=seen,
            mask3d=torch.ones_like(seen),
            focal=torch.full((size,), self.cameras.focal, device=device),
            index=index,
            ids=(),
            rotation=rotation,
            translation=translation,
            match3d=torch.arange(count, device=device).where(seen, -1),
            origin=torch.zeros(size, 3, dtype=torch.float64, device=device),
        )

    def free(self) -> None:
        """Forget the samples on the device."""
        self._on_device = None

    def _samples(self, mesh: Int[Tensor, " b"]) -> Float[Tensor, "b k 3"]:
        """Surface samples of each mesh: from the mapped files, or on another device from all samples, copied once."""
        if mesh.device.type == "cpu":
            return self._stacked(mesh.tolist())
        if self._on_device is None or self._on_device.device != mesh.device:
            self._on_device = self._stacked(range(len(self.rows))).to(mesh.device)
        return self._on_device[mesh]

    def _stacked(self, meshes: Sequence[int]) -> Float[Tensor, "b k 3"]:
        rows = (self.store.row(int(self.rows[mesh])) for mesh in meshes)
        return torch.from_numpy(np.stack([row[POINTS][: self.pool_size] for row in rows]))
