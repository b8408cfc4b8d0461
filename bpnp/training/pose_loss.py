"""The pose loss L_p = L_r + L_t of the paper (Eqs. 12 to 14) as a module."""

import math

import torch
from jaxtyping import Float
from torch import Tensor, nn

from bpnp.checks import check_positive
from bpnp.training.losses import pose_terms, true_pose
from bpnp.types import Batch, Prediction


class PoseLoss(nn.Module):
    """Errors of the pose "pnp": L_r, the angle to the true rotation, and L_t, the distance to the true translation.

    A sample at a limit has the value of the limit and no gradient.

    Args:
        max_rotation: Largest L_r, radians; pi / 2 in the authors' code. Default: None, no limit, as in the paper.
        max_translation: Largest L_t, scene units; 1 in the authors' code. Default: None, no limit, as in the paper.

    >>> import torch
    >>> from bpnp import Batch, BPnPNet
    >>> from bpnp.training import PoseLoss
    >>> truth = torch.eye(3), torch.tensor([0.0, 0.0, 5.0])
    >>> batch = Batch.from_arrays(torch.rand(20, 2), torch.rand(20, 3), *truth)
    >>> list(PoseLoss(max_translation=1.0)(BPnPNet()(batch), batch))
    ['rotation', 'translation']
    """

    def __init__(self, *, max_rotation: float | None = None, max_translation: float | None = None) -> None:
        super().__init__()
        self.max_rotation, self.max_translation = max_rotation, max_translation
        limits = {"max_rotation": max_rotation, "max_translation": max_translation}
        check_positive(**{name: limit for name, limit in limits.items() if limit is not None})

    def forward(self, prediction: Prediction, batch: Batch) -> dict[str, Float[Tensor, " b"]]:
        """Return "rotation" in radians and "translation" in scene units; NaN where the pose did not converge.

        Args:
            prediction: Prediction with the pose "pnp".
            batch: Problems with their true poses.

        Returns:
            The two terms (b,), by name.

        Raises:
            ValueError: The batch has no true poses.
        """
        pose, truth = prediction.poses["pnp"], true_pose(batch)
        solved = pose.stats.converged
        # A missing pose (NaN) is replaced by the true one, whose loss has no gradient.
        rotation = torch.where(solved[:, None, None], pose.rotation, truth[0])
        translation = torch.where(solved[:, None], pose.translation, truth[1])
        limits = {"rotation": self.max_rotation, "translation": self.max_translation}
        return {
            name: values.clamp_max(limits[name] or math.inf).where(solved, torch.nan)
            for name, values in pose_terms(rotation, translation, *truth).items()
        }
