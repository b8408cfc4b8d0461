"""BPnPNet's features with a hard assignment: the Hungarian algorithm in the place of the transport, at test time."""

import torch
from jaxtyping import Float
from scipy.optimize import linear_sum_assignment
from torch import Tensor, nn

from bpnp.layers.ransac import Backend, RansacPnP
from bpnp.models.bpnpnet import BPnPNet
from bpnp.models.evaluation import pnp_pose, ransac_pose
from bpnp.types import Batch, Prediction


class Hungarian(nn.Module):
    """min(m, n) one-to-one matches of least total feature distance, RANSAC on all of them, the weighted PnP layer.

    A variant for evaluation: the assignment has no gradient. All its matches weigh the same.

    Args:
        checkpoint: of a BPnPNet, as `bpnp fit` wrote it; null for `net`.
        net: the network; null for untrained weights with the default settings where there is no checkpoint either.
        ransac_backend: as in BPnPNet; opencv is the paper's.
    """

    estimates = ("ransac", "pnp")

    def __init__(
        self, *, checkpoint: str | None = None, net: BPnPNet | None = None, ransac_backend: Backend = "poselib"
    ) -> None:
        super().__init__()
        if checkpoint is not None and net is not None:
            raise ValueError("expected `checkpoint` or `net`, got both")
        self.net = BPnPNet.from_checkpoint(checkpoint) if checkpoint is not None else net or BPnPNet()
        self.ransac = RansacPnP(
            backend=ransac_backend,
            matches_factor=1.0,
            threshold=getattr(self.net.ransac, "threshold", 0.01),
            max_iterations=getattr(self.net.ransac, "max_iterations", 1000),
        )

    def forward(self, batch: Batch) -> Prediction:
        assignment = self.match(batch).assignment
        assert assignment is not None
        start = ransac_pose(self.ransac, assignment, batch)
        return Prediction(assignment, None, {"ransac": start, "pnp": pnp_pose(self.net.pnp, assignment, batch, start)})

    def match(self, batch: Batch) -> Prediction:
        """The assignment alone."""
        with torch.no_grad():
            return Prediction(hungarian(self.net.cost(batch), batch))


def hungarian(cost: Float[Tensor, "b m n"], batch: Batch) -> Float[Tensor, "b m n"]:
    """The permutation of least cost between the real points, as a joint probability: equal entries of sum one."""
    assignment = torch.zeros_like(cost)
    for i, (real2d, real3d) in enumerate(zip(batch.mask2d.cpu(), batch.mask3d.cpu(), strict=True)):
        places2d, places3d = real2d.nonzero()[:, 0], real3d.nonzero()[:, 0]
        rows, columns = linear_sum_assignment(cost[i].cpu()[real2d][:, real3d].numpy())
        assignment[i, places2d[rows], places3d[columns]] = 1 / len(rows)
    return assignment
