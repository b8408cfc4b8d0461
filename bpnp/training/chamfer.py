"""Chamfer loss of a pose (MinCD-PnP, An et al., ICCV 2025): distances of the nearest points, without matches."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from bpnp.checks import check_positive
from bpnp.geometry import bearings, chords
from bpnp.types import Batch, Prediction


class ChamferLoss(nn.Module):
    """Chamfer distance of the image points and the scene points that the pose "pnp" projects.

    It is the mean squared distance of each point to the nearest one of the other side, summed over both sides, in units
    of a width. It needs neither true poses nor true matches: any pose that covers the image points is good. Points
    without a correspondence have a distance too.

    Differences from the paper, whose keypoints are chosen by a network: all points are used, the pose is that of the
    PnP layer, and distances are chords of directions, so that a point behind the camera is at most 2 away.

    Args:
        width: Unit of the distances, radians. Default 0.01, the threshold of RANSAC.

    >>> import torch
    >>> from bpnp import Batch, BPnPNet
    >>> from bpnp.training import ChamferLoss
    >>> batch = Batch.from_arrays(torch.rand(20, 2), torch.rand(20, 3))
    >>> list(ChamferLoss()(BPnPNet()(batch), batch))
    ['chamfer']
    """

    def __init__(self, *, width: float = 0.01) -> None:
        super().__init__()
        check_positive(width=width)
        self.width = width

    def forward(self, prediction: Prediction, batch: Batch) -> dict[str, Float[Tensor, " b"]]:
        """Return "chamfer"; NaN where the pose did not converge.

        Args:
            prediction: Prediction with the pose "pnp".
            batch: Problems.

        Returns:
            The term (b,), by name.
        """
        pose = prediction.poses["pnp"]
        solved = pose.stats.converged
        eye = torch.eye(3, dtype=pose.rotation.dtype, device=pose.rotation.device)
        rotation = torch.where(solved[:, None, None], pose.rotation, eye)
        translation = torch.where(solved[:, None], pose.translation, 1)
        rays, points3d = bearings(batch.points2d).to(rotation), batch.points3d.to(rotation)
        squared = chords(rays, points3d, rotation, translation).square() / self.width**2
        terms = []
        for axis, real, other in ((2, batch.mask2d, batch.mask3d), (1, batch.mask3d, batch.mask2d)):
            nearest = squared.masked_fill(~other.unsqueeze(3 - axis), torch.inf).amin(axis)
            terms.append(torch.where(real, nearest, 0).sum(1) / real.sum(1))
        return {"chamfer": (terms[0] + terms[1]).where(solved, torch.nan)}
