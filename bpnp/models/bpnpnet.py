"""BPnPNet (Campbell, Liu, Gould, ECCV 2020): blind PnP end to end."""

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from bpnp.layers.assignment import Sinkhorn
from bpnp.layers.implicit import first_derivative
from bpnp.layers.pnp import WeightedPnP
from bpnp.layers.ransac import RansacPnP
from bpnp.models.evaluation import Refinement, match_again, pnp_pose, ransac_pose, round_widths
from bpnp.models.nets import ImageFeatures, SceneFeatures
from bpnp.models.weights import AnyModule, TrainedNet, chosen
from bpnp.precision import full_precision
from bpnp.types import Batch, Prediction

SQUARED_FLOOR = 1e-7  # rounding of the product of two float32 unit vectors


class BPnPNet(TrainedNet):
    """Features of both point sets, transport between them, RANSAC on the best matches, weighted PnP on all of them.

    Every part is a module with its own options and may be replaced by another of the same arguments and results. A
    part that is None is the paper's with its default options.

    Args:
        features2d: image points (b, m, 2) and their mask to unit features (b, m, c).
        features3d: scene points (b, n, 3) and their mask to unit features (b, n, c).
        transport: cost (b, m, n) and both masks to the assignment (b, m, n) and its `SolveStats`.
        ransac: assignment, points2d, points3d and both masks to the rotation, translation and `SolveStats` of a first
            pose.
        pnp: assignment, bearings, points3d and the first pose to a pose that is differentiable in the assignment.
        refinement: in evaluation, the third pose "refined".
        rounds: in evaluation, how often the points are matched again under the last pose, of which RANSAC's is the
            first (`bpnp.models.evaluation.match_again`); the residuals of the last round are as wide as the `threshold`
            of `ransac`.

    >>> net = BPnPNet(transport=Sinkhorn(mu=0.05)).eval()
    >>> prediction = net(Batch.from_arrays(torch.rand(20, 2), torch.rand(30, 3)))
    >>> tuple(prediction.assignment.shape), list(prediction.poses)
    ((1, 20, 30), ['ransac', 'pnp', 'refined'])
    """

    def __init__(
        self,
        features2d: ImageFeatures | AnyModule | None = None,
        features3d: SceneFeatures | AnyModule | None = None,
        transport: Sinkhorn | AnyModule | None = None,
        ransac: RansacPnP | AnyModule | None = None,
        pnp: WeightedPnP | AnyModule | None = None,
        *,
        refinement: Refinement | None = None,
        rounds: int = 0,
    ) -> None:
        super().__init__()
        self.features2d = chosen(features2d, ImageFeatures)
        self.features3d = chosen(features3d, SceneFeatures)
        self.transport = chosen(transport, Sinkhorn)
        self.ransac = chosen(ransac, RansacPnP)
        self.pnp = chosen(pnp, WeightedPnP)
        self.refinement = Refinement() if refinement is None else refinement
        self.rounds = rounds
        self.widths = round_widths(rounds, self.ransac)

    def forward(self, batch: Batch) -> Prediction:
        """The assignment and the poses "ransac" and "pnp"; in evaluation after its rounds, and with "refined"."""
        cost = self.cost(batch)
        assignment, stats = self.transport(cost, batch.mask2d, batch.mask3d)
        ransac = ransac_pose(self.ransac, assignment, batch)
        pnp = pnp_pose(self.pnp, assignment, batch, ransac)
        prediction = Prediction(assignment, stats, {"ransac": ransac, "pnp": pnp})
        if self.training:
            return prediction
        again = match_again(prediction, cost, batch, transport=self.transport, pnp=self.pnp, widths=self.widths)
        return self.refinement(again, batch)

    def match(self, batch: Batch) -> Prediction:
        """The assignment alone: what a training without the pose loss needs."""
        return Prediction(*self.transport(self.cost(batch), batch.mask2d, batch.mask3d))

    def cost(self, batch: Batch) -> Float[Tensor, "b m n"]:
        """M_ij = ||z_i - z_j||_2 between the unit features of both sides, in [0, 2], in the network's dtype."""
        return pairwise_distance(*self.features(batch))

    def features(self, batch: Batch) -> tuple[Float[Tensor, "b m c"], Float[Tensor, "b n c"]]:
        """Unit features of both sides, in the network's dtype."""
        batch = batch.to(next((p.dtype for p in self.parameters()), batch.points2d.dtype))
        return self.features2d(batch.points2d, batch.mask2d), self.features3d(batch.points3d, batch.mask3d)


@full_precision
def pairwise_distance(a: Float[Tensor, "b m c"], b: Float[Tensor, "b n c"]) -> Float[Tensor, "b m n"]:
    """||a_i - b_j||_2 of unit vectors from one matrix product. The gradient at distance zero is taken as zero."""
    return _PairwiseDistance.apply(a, b)


class _PairwiseDistance(torch.autograd.Function):
    """One matrix is kept for the gradient, the distances: dL/da = -(G / D) b. Its products are exact too."""

    @staticmethod
    def forward(ctx: Any, a: Tensor, b: Tensor) -> Tensor:
        squared = torch.baddbmm(a.new_full((1, 1, 1), 2.0), a, b.mT, alpha=-2)
        distance = nn.functional.threshold(squared, SQUARED_FLOOR, 0.0, inplace=True).sqrt_()
        ctx.save_for_backward(a, b, distance)
        return distance

    @staticmethod
    @first_derivative
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, Tensor]:
        a, b, distance = ctx.saved_tensors
        weight = torch.ops.aten.threshold_backward(gradient / distance, distance, 0)  # zero where the distance is
        return weight @ -b, weight.mT @ -a
