"""Reprojection errors of many poses on candidate pairs, and their truncated score (MSAC)."""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from bpnp.geometry import transform

CHUNK = 2**18  # residuals scored at a time: 1 MiB in float32, which stays in the cache of a core


class Pairs(NamedTuple):
    """Candidate pairs of a 2D and a 3D point; `real` is False for padding, whose points are zero."""

    points2d: Float[Tensor, "b k 2"]
    points3d: Float[Tensor, "b k 3"]
    real: Bool[Tensor, "b k"]


class Residuals(NamedTuple):
    """Of c poses on k pairs. inlier: real, in front of the camera and with a reprojection error below the threshold."""

    squared: Float[Tensor, "b c k"]
    inlier: Bool[Tensor, "b c k"]
    residual: Float[Tensor, "b c k 2"]
    camera: Float[Tensor, "b c k 3"]


def normalised(pairs: Pairs) -> tuple[Pairs, Float[Tensor, "b 3"], Float[Tensor, "b 1"]]:
    """The pairs in float64 with 3D points q, centred and of unit variance; centre and scale in p = scale q + centre.

    A scene far from its origin then loses no digits in the minimal solver. Points with NaN or infinity are not real.
    """
    usable = pairs.real & pairs.points2d.isfinite().all(-1) & pairs.points3d.isfinite().all(-1)
    real = usable.unsqueeze(-1)
    image, scene = (torch.where(real, points, 0).double() for points in pairs[:2])
    count = usable.sum(-1, keepdim=True).clamp(min=1)
    centre = scene.sum(1) / count
    scene = torch.where(real, scene - centre.unsqueeze(1), 0)
    scale = (scene.square().sum((1, 2)).unsqueeze(-1) / count).sqrt().clamp(min=1e-300)
    return Pairs(image, scene / scale.unsqueeze(-1), usable), centre, scale


def in_scene(
    poses: Float[Tensor, "b c 3 4"], centre: Float[Tensor, "b 3"], scale: Float[Tensor, "b 1"]
) -> tuple[Float[Tensor, "b c 3 3"], Float[Tensor, "b c 3"]]:
    """Rotation and translation, in the scene's own coordinates, of poses that were found on normalised pairs."""
    rotation = poses[..., :3]
    return rotation, scale.unsqueeze(1) * poses[..., 3] - (rotation @ centre[:, None, :, None]).squeeze(-1)


def truncated_scores(
    poses: Float[Tensor, "b c 3 4"], pairs: Pairs, threshold2: float | Float[Tensor, "b 1 1"]
) -> Float[Tensor, "b c"]:
    """sum_i min(r_i^2, threshold2) over the real pairs, r_i the reprojection error, infinite behind the camera.

    Computed in float32. NaN for a pose that is NaN.
    """
    x, y = pairs.points2d.float().unsqueeze(1).unbind(-1)
    scene = torch.cat([pairs.points3d.float(), torch.ones_like(x).mT], -1).mT
    real = pairs.real.unsqueeze(1).float()
    # x' - x = (row_0 - x row_2) [p; 1] / depth: one product for the numerator, and the depth is only squared.
    along_x, along_y = torch.cat([scene, -x * scene], 1), torch.cat([scene, -y * scene], 1)
    scores = []
    for part in poses.float().split(max(1, CHUNK // (x.shape[0] * x.shape[2])), dim=1):
        row0, row1, row2 = part.unbind(2)
        squared = (torch.cat([row0, row2], -1) @ along_x).square_()
        squared += (torch.cat([row1, row2], -1) @ along_y).square_()
        depth = (row2 @ scene).clamp_(min=1e-12)  # behind the camera: an infinite residual
        squared.div_(depth.square_()).clamp_(max=threshold2)
        scores.append((squared @ real.mT).squeeze(-1))
    return torch.cat(scores, 1)


def residuals(poses: Float[Tensor, "b c 3 4"], pairs: Pairs, threshold2: float) -> Residuals:
    """Reprojection error of every pair under every pose, in the type of the points."""
    points3d = pairs.points3d.unsqueeze(1).expand(-1, poses.shape[1], -1, -1)
    camera = transform(poses[..., :3], poses[..., 3], points3d)
    residual = camera[..., :2] / camera[..., 2:] - pairs.points2d.unsqueeze(1)
    squared = residual.square().sum(-1)
    inlier = (squared < threshold2) & (camera[..., 2] > 0) & pairs.real.unsqueeze(1)
    return Residuals(squared, inlier, residual, camera)
