"""What a soft assignment says of a pose that was found without it."""

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from bpnp.geometry import chords, is_finite

TRUST = 0.7  # of the assignment; the rest is a uniform one
ALONE = 0.2  # share of the image points without a partner
WIDTH = 0.01  # standard deviation of the residuals, radians: as wide as RANSAC's threshold


def log_support(
    assignment: Float[Tensor, "b m n"],
    bearings: Float[Tensor, "b m 3"],
    points3d: Float[Tensor, "b n 3"],
    rotation: Float[Tensor, "b 3 3"],
    translation: Float[Tensor, "b 3"],
    *,
    mask2d: Bool[Tensor, "b m"],
    mask3d: Bool[Tensor, "b n"],
    unmatched2d: Float[Tensor, "b m"] | None = None,
) -> Float[Tensor, " b"]:
    """Log-likelihood of the bearings under a pose and an assignment, against bearings that have nothing to do with it.

    L = sum_i log(o + (1 - o) sum_j Q_ij A N(r_ij)), r_ij the chord between bearing i and the direction of R p_j + t, N
    the density of a normal distribution on the plane, A = 2 pi s^2 with s the spread of the bearings, o the share of
    those without a partner, and Q_ij = P(j | i) but for a uniform part. unmatched2d: mass of each bearing in the bin.

    In nats: above zero the assignment speaks for the pose, below against it. -inf without a pose.
    """
    real = mask2d.unsqueeze(2) & mask3d.unsqueeze(1)
    mass = assignment.sum(2) if unmatched2d is None else assignment.sum(2) + unmatched2d
    given = assignment / mass.clamp_min(torch.finfo(assignment.dtype).tiny).unsqueeze(2)
    prior = (TRUST * given + (1 - TRUST) / mask3d.sum(1)[:, None, None]) * real
    squared = chords(bearings, points3d, rotation, translation).square()
    count = mask2d.sum(1)
    rays = bearings * mask2d.unsqueeze(2)
    spread = rays.square().sum((1, 2)) / count - (rays.sum(1) / count.unsqueeze(1)).square().sum(1)
    density = torch.exp(-squared / (2 * WIDTH**2)) * (spread / WIDTH**2)[:, None, None]
    each = torch.log(ALONE + (1 - ALONE) * (prior * density).sum(2)) * mask2d
    return torch.where(is_finite(rotation, translation), each.sum(1), -math.inf)
