"""How many points of both sides have a partner under a pose, where no matches are known."""

from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from bpnp.geometry import project, transform

CHUNK = 2**22  # distances computed at a time, in float32


class Agreement(NamedTuple):
    """Points of each side with a point of the other within the threshold in the image, per pose."""

    partnered2d: Int[Tensor, " h"]
    partnered3d: Int[Tensor, " h"]

    @property
    def points(self) -> Int[Tensor, " h"]:
        return self.partnered2d + self.partnered3d

    @property
    def pairs(self) -> Int[Tensor, " h"]:
        """Upper bound on the number of one-to-one matches within the threshold."""
        return torch.minimum(self.partnered2d, self.partnered3d)


def agreement(
    points2d: Float[Tensor, "m 2"],
    points3d: Float[Tensor, "n 3"],
    rotation: Float[Tensor, "h 3 3"],
    translation: Float[Tensor, "h 3"],
    *,
    threshold: float,
) -> Agreement:
    """Count the points with a partner closer than `threshold` (normalised image units), for every pose.

    A 3D point behind the camera has none, and no point has one under a pose that is NaN.
    """
    part = max(1, CHUNK // (len(points2d) * len(points3d)))
    counts2d, counts3d = [], []
    for turned, shift in zip(rotation.split(part), translation.split(part), strict=True):
        camera = transform(turned, shift, points3d.expand(len(turned), -1, -1))
        front = camera[..., 2:] > 0
        seen = torch.where(front, project(camera), torch.inf).nan_to_num(torch.inf).float()
        x, y = points2d.float().unsqueeze(-1).unbind(1)
        squared = (seen[:, None, :, 0] - x).square_()
        squared += (seen[:, None, :, 1] - y).square_()
        counts2d.append((squared.amin(2) < threshold**2).sum(-1))
        counts3d.append((squared.amin(1) < threshold**2).sum(-1))
    return Agreement(torch.cat(counts2d), torch.cat(counts3d))
