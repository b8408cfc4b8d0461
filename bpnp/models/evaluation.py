"""Match again under a pose: the distance of the features and that of the reprojections judge a pair together."""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from bpnp.geometry import bearings, chords
from bpnp.types import Batch, Pose

FIRST_WIDTH = 5.0  # of the first round, in widths of the last
FEATURES = 0.03  # weight of the feature distances beside a pose, which by then tells more than they do
LIMIT = 12.0  # nats; a pair further off than five widths is not to be told from one at the other end of the image


def widths(rounds: int, last: float) -> list[float]:
    """Standard deviations of the reprojections, radians, falling by the same factor from round to round."""
    return [float(width) for width in np.geomspace(FIRST_WIDTH * last, last, rounds)]


def cost_under_pose(
    cost: Float[Tensor, "b m n"], batch: Batch, pose: Pose, *, width: float, mu: float | Tensor
) -> Float[Tensor, "b m n"]:
    """w M_ij + mu min(r_ij^2 / (2 s^2), L), r_ij the chord between bearing i and the direction of R p_j + t.

    cost: M, distances of the features. width: s, radians. mu: entropy weight of the transport that takes the result,
    whose assignment is then in proportion to exp(-w M_ij / mu) times a Gaussian of the residual with a floor. No
    gradient reaches the pose; a sample without one keeps its M.
    """
    rotation, translation = pose.rotation.detach().to(cost), pose.translation.detach().to(cost)
    residual = chords(bearings(batch.points2d).to(cost), batch.points3d.to(cost), rotation, translation)
    surprise = (residual.square() / (2 * width**2)).clamp(max=LIMIT)
    return torch.where(pose.found[:, None, None], FEATURES * cost + mu * surprise, cost)
