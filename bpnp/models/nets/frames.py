"""Frames of point sets of which half may be clutter: a centre, a radius, and for 3D points the principal axes."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

ROUNDS = 20  # of reweighting, towards the point with the smallest sum of distances
NEAR = 2.0  # median distances from the centre at which a point's weight is a quarter
FARTHEST = 3.0  # median distances; a point beyond counts as much as one there for the direction of an axis


def robust_frame(
    points: Float[Tensor, "b k d"], mask: Bool[Tensor, "b k"]
) -> tuple[Float[Tensor, "b 1 d"], Float[Tensor, "b 1 1"]]:
    """Median of each coordinate and median distance from it: half of the points may be clutter. Padding is not seen.

    A set whose points coincide has radius one.
    """
    hidden = points.masked_fill(~mask.unsqueeze(-1), torch.nan)
    centre = hidden.nanmedian(1, keepdim=True).values
    return centre, _radius(torch.linalg.vector_norm(hidden - centre, dim=-1))


@torch.no_grad()
def principal_axes(points: Float[Tensor, "b k 3"], mask: Bool[Tensor, "b k"]) -> Float[Tensor, "b 3 3"]:
    """Columns: axes of the points' covariance about their geometric median, far points counting less; shortest first.

    They turn with the points. An axis points to where the points' tail is longer, but for the first, which makes the
    frame right-handed; without a tail, as in a symmetric set, the direction is arbitrary. Padding is not seen.
    """
    weight = mask.unsqueeze(-1).to(points.dtype)
    hidden = points.masked_fill(~mask.unsqueeze(-1), torch.nan)
    centre, radius = robust_frame(points, mask)
    for _ in range(ROUNDS):
        near = weight / torch.linalg.vector_norm(points - centre, dim=-1, keepdim=True).clamp_min(1e-3 * radius)
        centre = (points * near).sum(1, keepdim=True) / near.sum(1, keepdim=True)
    radius = _radius(torch.linalg.vector_norm(hidden - centre, dim=-1))
    offset = (points - centre) / radius * weight
    weight = weight * (1 + (offset**2).sum(-1, keepdim=True) / NEAR**2) ** -2
    axes = torch.linalg.eigh(((offset * weight).mT @ offset).double()).eigenvectors.to(points.dtype)
    tail = (weight * (offset @ axes).clamp(-FARTHEST, FARTHEST) ** 3).sum(1, keepdim=True)
    axes = torch.where(tail < 0, -axes, axes)
    return torch.cat([axes[:, :, :1] * torch.linalg.det(axes)[:, None, None], axes[:, :, 1:]], 2)


def _radius(distance: Float[Tensor, "b k"]) -> Float[Tensor, "b 1 1"]:
    """Median of each row but for NaN; one for zero."""
    radius = distance.nanmedian(1).values[:, None, None]
    return torch.where(radius > 0, radius, 1)
