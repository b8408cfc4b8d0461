"""Sampling and scoring of candidate matches for a whole batch at once.

The random numbers are a hash of a seed and a counter, the same on every device and for every sample of a batch. A pose
therefore depends neither on the other samples nor on padding.
"""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from bpnp.geometry import transform

# 1 MiB in float32 stays in the cache of a core.
RESIDUALS_AT_ONCE = 2**18  # number of residuals scored at a time [residuals; cost]


def distinct_triples(pool: Float[Tensor, "b d"], seed: int, *, skip: int = 0) -> Int[Tensor, "b d 3"]:
    """Draw triples of different indices below the pool size of each draw, uniform and in random order.

    The random numbers of `skip` draws, by earlier calls with this seed, are not used again.
    """
    draws = pool.shape[1]
    uniform = hashed_uniform(3 * draws, seed, pool.device, skip=3 * skip).view(3, draws)
    first, second, third = ((uniform[i] * (pool - i)).long() for i in range(3))
    # A draw from pool - i numbers skips the i numbers already taken.
    second = second + (second >= first)
    third = third + (third >= torch.minimum(first, second))
    third = third + (third >= torch.maximum(first, second))
    return torch.stack([first, second, third], -1)


def weighted_draws(weights: Float[Tensor, "b k"], count: int, seed: int) -> Int[Tensor, "b c"]:
    """Draw indices with replacement in proportion to weights, which are not negative and not all zero."""
    total = weights.double().cumsum(-1)
    uniform = hashed_uniform(count, seed, weights.device)
    # The first sum above the number drawn: never an index of weight zero.
    return torch.searchsorted(total, uniform * total[:, -1:], right=True).clamp(max=weights.shape[1] - 1)


def hashed_uniform(size: int, seed: int, device: torch.device, *, skip: int = 0) -> Float[Tensor, " k"]:
    """Return float64 numbers in (0, 1) by a 32-bit integer hash of counter and seed.

    The hash takes two multiplications and shifts a round.
    """
    state = torch.arange(skip, skip + size, device=device)
    for salt in (0, (seed * 0x9E3779B1 + 1) & 0xFFFFFFFF):
        state = (state + salt) & 0xFFFFFFFF
        for shift, factor in ((16, 0x21F0AAAD), (15, 0x735A2D97)):
            state = ((state ^ (state >> shift)) * factor) & 0xFFFFFFFF
        state = state ^ (state >> 15)
    return (state.double() + 0.5) / 2.0**32


class Matches(NamedTuple):
    """Candidate matches of a 2D and a 3D point."""

    points2d: Float[Tensor, "b k 2"]  # normalised image coordinates
    points3d: Float[Tensor, "b k 3"]  # scene points
    real: Bool[Tensor, "b k"]  # False for padding, whose points are zero


class Residuals(NamedTuple):
    """Residuals of c poses on k matches."""

    squared: Float[Tensor, "b c k"]  # squared reprojection errors
    # True for a real match in front of the camera with an error below the threshold.
    inlier: Bool[Tensor, "b c k"]
    residual: Float[Tensor, "b c k 2"]  # reprojection errors
    camera: Float[Tensor, "b c k 3"]  # points in the camera frame


def normalise_matches(matches: Matches) -> tuple[Matches, Float[Tensor, "b 3"], Float[Tensor, "b 1"]]:
    """Return float64 matches with centred points q of unit variance, and centre and scale of p = scale q + centre.

    A scene far from its origin then loses no digits in the minimal solver. Points with NaN or infinity are not real.
    """
    usable = matches.real & matches.points2d.isfinite().all(-1) & matches.points3d.isfinite().all(-1)
    real = usable.unsqueeze(-1)
    image, scene = (torch.where(real, points, 0).double() for points in matches[:2])
    count = usable.sum(-1, keepdim=True).clamp(min=1)
    centre = scene.sum(1) / count
    scene = torch.where(real, scene - centre.unsqueeze(1), 0)
    scale = (scene.square().sum((1, 2)).unsqueeze(-1) / count).sqrt().clamp(min=1e-300)
    return Matches(image, scene / scale.unsqueeze(-1), usable), centre, scale


def in_scene(
    poses: Float[Tensor, "b c 3 4"], centre: Float[Tensor, "b 3"], scale: Float[Tensor, "b 1"]
) -> tuple[Float[Tensor, "b c 3 3"], Float[Tensor, "b c 3"]]:
    """Convert poses [R | t] of `normalise_matches` to rotations and translations in the scene's own coordinates."""
    rotation = poses[..., :3]
    return rotation, scale.unsqueeze(1) * poses[..., 3] - (rotation @ centre[:, None, :, None]).squeeze(-1)


def truncated_scores(
    poses: Float[Tensor, "b c 3 4"], matches: Matches, threshold2: float | Float[Tensor, "b 1 1"]
) -> Float[Tensor, "b c"]:
    """Compute sum_i min(r_i^2, threshold2) over the real matches in float32.

    r_i is the reprojection error, infinite behind the camera. The score of a NaN pose is NaN.
    """
    x, y = matches.points2d.float().unsqueeze(1).unbind(-1)
    scene = torch.cat([matches.points3d.float(), torch.ones_like(x).mT], -1).mT
    real = matches.real.unsqueeze(1).float()
    # x' - x = (row_0 - x row_2) [p; 1] / depth: one product for the numerator, and the depth is only squared.
    along_x, along_y = torch.cat([scene, -x * scene], 1), torch.cat([scene, -y * scene], 1)
    scores = []
    for part in poses.float().split(max(1, RESIDUALS_AT_ONCE // max(1, x.shape[0] * x.shape[2])), dim=1):
        row0, row1, row2 = part.unbind(2)
        squared = (torch.cat([row0, row2], -1) @ along_x).square_()
        squared += (torch.cat([row1, row2], -1) @ along_y).square_()
        depth = (row2 @ scene).clamp_(min=1e-12)  # behind the camera: an infinite residual
        squared.div_(depth.square_()).clamp_(max=threshold2)
        scores.append((squared @ real.mT).squeeze(-1))
    return torch.cat(scores, 1)


def residuals(poses: Float[Tensor, "b c 3 4"], matches: Matches, threshold2: float) -> Residuals:
    """Compute the reprojection error of every match under every pose, in the type of the points."""
    points3d = matches.points3d.unsqueeze(1).expand(-1, poses.shape[1], -1, -1)
    camera = transform(poses[..., :3], poses[..., 3], points3d)
    residual = camera[..., :2] / camera[..., 2:] - matches.points2d.unsqueeze(1)
    squared = residual.square().sum(-1)
    inlier = (squared < threshold2) & (camera[..., 2] > 0) & matches.real.unsqueeze(1)
    return Residuals(squared, inlier, residual, camera)
