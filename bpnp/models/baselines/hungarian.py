"""Hard assignment of BPnPNet's features: the Hungarian algorithm in place of the transport, for evaluation."""

import torch
from jaxtyping import Float
from scipy.optimize import linear_sum_assignment
from torch import Tensor, nn

from bpnp.layers.ransac.layer import Backend, RansacPnP
from bpnp.models.bpnpnet import BPnPNet
from bpnp.models.pose_stages import pnp_pose, ransac_pose
from bpnp.types import Batch, Prediction


class Hungarian(nn.Module):
    """BPnPNet with the Hungarian algorithm: min(m, n) one-to-one matches of least total feature distance.

    RANSAC uses all of these matches, and weighted PnP refines its pose. All matches have the same weight. The
    assignment has no gradient.

    Differences from the paper, which names the algorithm as the exact and slower alternative to Sinkhorn (section 3.3)
    and has no figures for it:

    - The network is trained with Sinkhorn, and the Hungarian algorithm is used in tests only.
    - RANSAC is PoseLib's by default; `ransac_backend="opencv"` is the paper's.

    Args:
        checkpoint: Checkpoint of a BPnPNet, written by `bpnp fit`; None to use `net`.
        net: Network; None with a checkpoint of None for untrained weights with the default settings.
        ransac_backend: Backend of `bpnp.layers.RansacPnP`, default "poselib"; "opencv" is the paper's. Threshold and
            number of hypotheses are those of the network's RANSAC.

    Raises:
        ValueError: `checkpoint` and `net` are both given.
    """

    estimates = ("ransac", "pnp")

    def __init__(
        self, *, checkpoint: str | None = None, net: BPnPNet | None = None, ransac_backend: Backend = "poselib"
    ) -> None:
        super().__init__()
        if checkpoint is not None and net is not None:
            raise ValueError("`checkpoint` and `net` are both given; give one of them")
        self.net = BPnPNet.from_checkpoint(checkpoint) if checkpoint is not None else net or BPnPNet()
        self.ransac = RansacPnP(
            backend=ransac_backend,
            matches_factor=1.0,
            threshold=getattr(self.net.ransac, "threshold", 0.01),
            max_iterations=getattr(self.net.ransac, "max_iterations", 1000),
        )

    def forward(self, batch: Batch) -> Prediction:
        """Return the assignment and the poses "ransac" and "pnp".

        Args:
            batch: Problems.
        """
        assignment = self.match(batch).assignment
        assert assignment is not None
        start = ransac_pose(self.ransac, assignment, batch)
        return Prediction(assignment, None, {"ransac": start, "pnp": pnp_pose(self.net.pnp, assignment, batch, start)})

    def match(self, batch: Batch) -> Prediction:
        """Return the assignment without poses.

        Args:
            batch: Problems.
        """
        with torch.no_grad():
            return Prediction(hungarian(self.net.cost(batch), batch))


def hungarian(cost: Float[Tensor, "b m n"], batch: Batch) -> Float[Tensor, "b m n"]:
    """Return the least-cost one-to-one matches of the real points as equal probabilities that sum to one."""
    assignment = torch.zeros_like(cost)
    for i, (real2d, real3d) in enumerate(zip(batch.mask2d.cpu(), batch.mask3d.cpu(), strict=True)):
        indices2d, indices3d = real2d.nonzero()[:, 0], real3d.nonzero()[:, 0]
        rows, columns = linear_sum_assignment(cost[i].cpu()[real2d][:, real3d].numpy())
        assignment[i, indices2d[rows], indices3d[columns]] = 1 / len(rows)
    return assignment
