"""Loss without labels: the reprojection error of the pose that a network computes from its own assignment."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from bpnp.geometry import angle_between, bearings, transform
from bpnp.types import Batch, Prediction


class ReprojectionLoss(nn.Module):
    """Reprojection error of the pose "pnp", weighted by the assignment: Eq. 2 of the paper with P in place of C.

    It needs neither true poses nor true matches, and can fine-tune a trained network to a scene without labels (section
    5 of the paper). The gradient reaches the assignment directly and through the pose. It sharpens existing
    assignments; it cannot detect a wrong pose.

    >>> import torch
    >>> from bpnp import Batch, BPnPNet
    >>> from bpnp.training import ReprojectionLoss
    >>> batch = Batch.from_arrays(torch.rand(20, 2), torch.rand(20, 3))
    >>> ReprojectionLoss()(BPnPNet()(batch), batch).shape
    torch.Size([1])
    """

    needs_pose = True

    def forward(self, prediction: Prediction, batch: Batch) -> Float[Tensor, " b"]:
        """Return sum_ij P_ij angle(f_i, R p_j + t) / sum_ij P_ij in radians; NaN for a sample without a pose.

        Args:
            prediction: Prediction with an assignment and the pose "pnp".
            batch: Problems.

        Returns:
            Losses (b,), radians.

        Raises:
            ValueError: The solver has no assignment, or no pose named "pnp".
        """
        assignment, pose = prediction.assignment, prediction.poses.get("pnp")
        if assignment is None or pose is None:
            missing = "assignment" if assignment is None else 'pose "pnp"'
            raise ValueError(f"the prediction has no {missing}; ReprojectionLoss trains networks such as BPnPNet")
        solved = pose.stats.converged
        eye = torch.eye(3, dtype=pose.rotation.dtype, device=pose.rotation.device)
        rotation = torch.where(solved[:, None, None], pose.rotation, eye)
        translation = torch.where(solved[:, None], pose.translation, 0)
        camera = transform(rotation, translation, batch.points3d)
        angles = angle_between(bearings(batch.points2d).unsqueeze(2), camera.unsqueeze(1))
        real = batch.mask2d.unsqueeze(2) & batch.mask3d.unsqueeze(1)
        mean = (assignment * angles).where(real, 0).sum((-2, -1)) / assignment.where(real, 0).sum((-2, -1))
        return mean.where(solved, torch.nan)
