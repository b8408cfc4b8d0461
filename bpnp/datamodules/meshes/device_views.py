"""Fresh views of meshes made in whole batches, in torch, on the device that trains.

What `views.draw_pair` and `outliers.with_outliers` do for one pair in numpy. The loader sends only the keys of a batch;
the surface samples lie on the device. A pair is a function of (seed, epoch, index), whatever batch, process or device
it is made in, but another function than on the CPU path: the same distribution, other pairs.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import roma
import torch
from jaxtyping import Float, Int
from numpy.typing import NDArray
from torch import Tensor

from bpnp.datamodules.loader import Key, PairDataset
from bpnp.datamodules.meshes.source import MeshSource
from bpnp.datamodules.meshes.views import Views
from bpnp.datamodules.outliers import Amounts, Outliers
from bpnp.datamodules.seeded import normal, permutations, row_keys, uniform
from bpnp.geometry import MIN_POINTS, project, transform
from bpnp.types import Batch

SUBSET, POSE, NOISE, HIDDEN, CLUTTER2D, CLUTTER3D, ORDER2D, ORDER3D = range(8)  # what random numbers are for
ROWS_AT_ONCE = 512  # of the samples, on their way to the device


@dataclass(frozen=True)
class ViewKeys:
    """The batch to be made: row of the surface samples, position in the data set and name of each pair."""

    epoch: int
    row: Int[Tensor, " b"]
    index: Int[Tensor, " b"]
    ids: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.ids)

    def to(self, *args: Any, **kwargs: Any) -> "ViewKeys":
        return replace(self, row=self.row.to(*args, **kwargs), index=self.index.to(*args, **kwargs))

    def pin_memory(self) -> "ViewKeys":
        return replace(self, row=self.row.pin_memory(), index=self.index.pin_memory())


class KeyDataset(PairDataset):
    """Maps a list of keys of a `MeshSource` to `ViewKeys`, without touching a point."""

    source: MeshSource

    def __getitem__(self, keys: Sequence[Key]) -> Any:
        index = np.array([index for _, index in keys])
        view, mesh = np.divmod(index, len(self.source.rows))
        row = self.source.rows[mesh]
        ids = tuple(f"{self.source.pools.names[r]}#{v}" for r, v in zip(row, view, strict=True))
        return ViewKeys(keys[0][0], torch.as_tensor(row), torch.as_tensor(index), ids)


class DeviceViews:
    """Makes the batches of a `MeshSource`, with outliers if there are any, on one device.

    Raises ValueError if a camera could come too near to a point, or for outliers whose number is drawn for each pair:
    a batch of one size cannot leave points out.
    """

    def __init__(self, source: MeshSource, outliers: Outliers | None, *, device: torch.device) -> None:
        if not source.views.sees_all(source.pools.radius):
            raise ValueError(
                f"expected meshes that every camera sees whole, to make views on the device, got a radius of "
                f"{source.pools.radius:.3g} at `distance` {source.views.distance}; try views_on_device false, "
                "normalisation unit_sphere or a larger distance"
            )
        amounts = (outliers or Outliers()).fixed
        if amounts is None:
            raise ValueError(
                f"expected outliers of one `ratio`, `occlusion` and side, to make views on the device, got {outliers}; "
                "try views_on_device false"
            )
        self.views, self.outliers = source.views, amounts
        self.num_points, self.seed = source.num_points, source.seed
        self.samples = _on_device(source.pools.points, device)

    def batch(self, keys: ViewKeys) -> Batch:
        """The batch of `keys`, on the device of both."""

        def stream(number: int) -> Tensor:
            return row_keys(self.seed, keys.epoch, keys.index, number)

        samples = self.samples[keys.row]
        subset = permutations(stream(SUBSET), samples.shape[1])[:, : self.num_points]
        points3d = _picked(samples, subset)
        rotation, translation = draw_poses(self.views, stream(POSE))
        # In float64, as on the CPU path, so that rounding is not one more noise.
        points2d = project(transform(rotation, translation, points3d.double()))
        noise = normal(stream(NOISE), 2 * self.num_points).view_as(points2d)
        points2d = (points2d + noise * (self.views.noise_px / self.views.focal)).float()
        points2d, points3d, match3d = _with_outliers(points2d, points3d, self.outliers, stream)
        points2d, points3d, match3d = _shuffled(points2d, points3d, match3d, stream)
        shape2d, shape3d, device = points2d.shape[:2], points3d.shape[:2], points3d.device
        return Batch(
            points2d=points2d,
            points3d=points3d,
            mask2d=torch.ones(shape2d, dtype=torch.bool, device=device),
            mask3d=torch.ones(shape3d, dtype=torch.bool, device=device),
            focal=torch.full(shape2d[:1], self.views.focal, device=device),
            index=keys.index,
            ids=keys.ids,
            rotation=rotation.float(),
            translation=translation.float(),
            match3d=match3d,
            origin=torch.zeros(len(keys), 3, device=device),
        )


def draw_poses(views: Views, keys: Int[Tensor, " b"]) -> tuple[Float[Tensor, "b 3 3"], Float[Tensor, "b 3"]]:
    """A random rotation and translation for each key, as `views.draw_pose`; float64."""
    numbers = uniform(keys, 6)
    if views.rotation == "so3":
        # The keys' next numbers: a normal 4-vector has a uniform direction.
        quaternion = torch.nn.functional.normalize(normal(keys + 1, 4), dim=-1)
        rotation = roma.unitquat_to_rotmat(quaternion)
    else:
        low, high = (math.radians(angle) for angle in views.euler_range)
        rotation = roma.euler_to_rotmat("xyz", low + (high - low) * numbers[:, :3])
    offset = views.translation_range * (2 * numbers[:, 3:] - 1)
    offset[:, 2] += views.distance
    return rotation, offset


def _with_outliers(points2d: Tensor, points3d: Tensor, outliers: Amounts, stream: Any) -> tuple[Tensor, Tensor, Tensor]:
    """As `outliers.with_outliers`, for pairs whose 3D point j is 2D point j; the order of the true points is random."""
    n = points3d.shape[1]
    hidden = max(0, min(round(outliers.occlusion * n), n - MIN_POINTS))
    hidden2d = {"2d": hidden, "3d": 0, "both": hidden // 2}[outliers.occluded_side]
    true = n - hidden
    # The first `true` points keep both sides, the next lose their 2D point, the last their 3D point.
    order = permutations(stream(HIDDEN), n)
    kept2d = torch.cat([order[:, :true], order[:, true + hidden2d :]], 1)
    points2d, points3d = _picked(points2d, kept2d), _picked(points3d, order[:, : true + hidden2d])
    count = int(outliers.ratio * true)
    count2d, count3d = count * (outliers.side != "3d"), count * (outliers.side != "2d")
    match3d = torch.arange(true, device=order.device).expand(len(order), -1)
    match3d = torch.nn.functional.pad(match3d, (0, hidden2d + count3d), value=-1)
    points2d = torch.cat([points2d, _in_box(points2d[:, :true], count2d, stream(CLUTTER2D))], 1)
    points3d = torch.cat([points3d, _in_box(points3d[:, :true], count3d, stream(CLUTTER3D))], 1)
    return points2d, points3d, match3d


def _shuffled(points2d: Tensor, points3d: Tensor, match3d: Tensor, stream: Any) -> tuple[Tensor, Tensor, Tensor]:
    order2d, order3d = (
        permutations(stream(ORDER2D), points2d.shape[1]),
        permutations(stream(ORDER3D), points3d.shape[1]),
    )
    match3d = match3d.gather(1, order3d)
    place = order2d.argsort(-1).gather(1, match3d.clamp(min=0))
    return _picked(points2d, order2d), _picked(points3d, order3d), place.where(match3d >= 0, -1)


def _in_box(points: Tensor, count: int, keys: Tensor) -> Tensor:
    """`count` points a row, uniform in the axis-aligned bounding box of the row's points."""
    low, high = points.amin(1, keepdim=True), points.amax(1, keepdim=True)
    share = uniform(keys, count * points.shape[2]).view(len(points), count, points.shape[2]).to(points.dtype)
    return low + (high - low) * share


def _picked(points: Tensor, order: Tensor) -> Tensor:
    return points.gather(1, order[..., None].expand(-1, -1, points.shape[2]))


def _on_device(samples: NDArray[np.float32], device: torch.device) -> Tensor:
    """The samples on the device, copied in parts: mapped files may be larger than the memory of the host."""
    whole = torch.empty(samples.shape, dtype=torch.float32, device=device)
    for start in range(0, len(samples), ROWS_AT_ONCE):
        part = np.array(samples[start : start + ROWS_AT_ONCE], np.float32)
        whole[start : start + ROWS_AT_ONCE] = torch.from_numpy(part).to(device)
    return whole
