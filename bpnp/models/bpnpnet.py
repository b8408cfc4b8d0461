"""BPnPNet (Campbell, Liu, Gould, ECCV 2020): blind PnP end to end."""

from functools import partial
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from bpnp.layers.assignment import Sinkhorn
from bpnp.layers.pnp import Method
from bpnp.layers.ransac import Backend
from bpnp.models.evaluation import cost_under_pose, widths
from bpnp.models.nets.features import InputTransform, PointFeatures, normalise_points3d
from bpnp.models.pose_head import PoseStage
from bpnp.models.pretrained import Restorable
from bpnp.precision import full_precision
from bpnp.types import Batch, Pose, Prediction

SQUARED_FLOOR = 1e-7  # rounding of the product of two float32 unit vectors


class BPnPNet(Restorable):
    """Features of both point sets, transport between them, RANSAC on the best pairs, weighted PnP on all of them.

    Args:
        channels: width of the feature nets.
        blocks: residual blocks of each feature net.
        batch_norm: batch norm after each context norm, as in the paper's text; the released code has none.
        centre_features: subtract each set's mean feature before the normalisation to unit length.
        image_scale: factor on the image coordinates at the input of the 2D net.
        normalise_scene: centre and scale the 3D points at the input of the 3D net; poses stay in scene units.
        mu: entropy weight of the transport.
        learn_mu: whether mu is learned.
        dustbin: cost of leaving a point unmatched; null for a full assignment.
        sinkhorn_tolerance: L1 error of the marginals at which the transport stops.
        ransac_backend: poselib (LO-RANSAC, PROSAC order), opencv (the paper's P3P-RANSAC and EPnP), torch (the whole
            batch on its device), or auto (torch on cuda, else poselib).
        ransac_iterations: most hypotheses, as in the paper.
        threshold: inlier threshold of RANSAC, normalised image coordinates.
        pairs_factor: RANSAC sees the pairs_factor * min(m, n) most probable pairs.
        pnp_method: newton, or lbfgs as in the paper.
        pnp_iterations: most iterations of the PnP layer.
        refine: give a third pose in evaluation, "refined", annealed without the assignment from the other two and from
            poses that the assignment proposes.
        hypotheses: poses that the assignment proposes for it, at most; 0 for none.
        rounds: in evaluation, how often the points are matched again under the last pose, RANSAC's the first, and the
            PnP layer run on the new assignment (`bpnp.models.evaluation`); the last width is the threshold.
    """

    estimates: tuple[str, ...] = ("ransac", "pnp", "refined")

    def __init__(
        self,
        *,
        channels: int = 128,
        blocks: int = 12,
        batch_norm: bool = False,
        centre_features: bool = False,
        image_scale: float = 1.0,
        normalise_scene: bool = False,
        mu: float = 0.1,
        learn_mu: bool = False,
        dustbin: float | None = None,
        sinkhorn_tolerance: float = 1e-6,
        ransac_backend: Backend = "auto",
        ransac_iterations: int = 1000,
        threshold: float = 0.01,
        pairs_factor: float = 1.5,
        pnp_method: Method = "newton",
        pnp_iterations: int = 50,
        refine: bool = True,
        hypotheses: int = 192,
        rounds: int = 0,
    ) -> None:
        super().__init__()
        self.settings: dict[str, Any] = {
            k: v for k, v in locals().items() if k not in ("self", "__class__")
        }  # fmt: skip
        if rounds < 0:
            raise ValueError(f"expected a number of `rounds`, got {rounds}; try 0 for none")
        self.image_scale = image_scale
        self.normalise_scene = normalise_scene
        shape = {"channels": channels, "blocks": blocks, "batch_norm": batch_norm, "centre": centre_features}
        self.features2d = PointFeatures(2, **shape)  # type: ignore[arg-type]
        self.features3d = PointFeatures(3, **shape)  # type: ignore[arg-type]
        self.align = InputTransform()
        self.sinkhorn = Sinkhorn(mu=mu, learn_mu=learn_mu, dustbin=dustbin, tolerance=sinkhorn_tolerance)
        self.pose_stage = PoseStage(
            ransac_backend=ransac_backend,
            ransac_iterations=ransac_iterations,
            threshold=threshold,
            pairs_factor=pairs_factor,
            pnp_method=pnp_method,
            pnp_iterations=pnp_iterations,
            refine=refine,
            hypotheses=hypotheses,
        )
        self.widths = widths(rounds, threshold)
        self.estimates = self.pose_stage.estimates

    def forward(self, batch: Batch, *, poses: bool = True) -> Prediction:
        """Prediction with the assignment and, if `poses`, the estimates "ransac" and "pnp"; in evaluation "refined"."""
        cost = self.cost(batch)
        prediction = self.match(cost, batch)
        if not poses:
            return prediction

        def rematch(pose: Pose, *, width: float) -> Prediction:
            return self.match(cost_under_pose(cost, batch, pose, width=width, mu=self.sinkhorn.entropy), batch)

        rounds = [] if self.training else [partial(rematch, width=width) for width in self.widths]
        return self.pose_stage(prediction, batch, rounds)

    def match(self, cost: Float[Tensor, "b m n"], batch: Batch) -> Prediction:
        """The assignment at which the transport of this cost ends."""
        return Prediction(*self.sinkhorn(cost, batch.mask2d, batch.mask3d))

    def cost(self, batch: Batch) -> Float[Tensor, "b m n"]:
        """M_ij = ||z_i - z_j||_2 between the unit features of both sides, in [0, 2], in the network's dtype."""
        batch = batch.to(self.features2d.enter.weight.dtype)
        points3d = normalise_points3d(batch.points3d, batch.mask3d) if self.normalise_scene else batch.points3d
        z2d = self.features2d(self.image_scale * batch.points2d, batch.mask2d)
        z3d = self.features3d(self.align(points3d, batch.mask3d), batch.mask3d)
        return pairwise_distance(z2d, z3d)


@full_precision
def pairwise_distance(a: Float[Tensor, "b m c"], b: Float[Tensor, "b n c"]) -> Float[Tensor, "b m n"]:
    """||a_i - b_j||_2 of unit vectors from one matrix product.

    The gradient at distance zero is taken as zero.
    """
    return _PairwiseDistance.apply(a, b)


class _PairwiseDistance(torch.autograd.Function):
    """One matrix is kept for the gradient, the distances: dL/da = -(G / D) b."""

    @staticmethod
    def forward(ctx: Any, a: Tensor, b: Tensor) -> Tensor:
        squared = torch.baddbmm(a.new_full((1, 1, 1), 2.0), a, b.mT, alpha=-2)
        near = squared <= SQUARED_FLOOR
        distance = squared.sqrt_().masked_fill_(near, 0)
        ctx.save_for_backward(a, b, distance)
        return distance

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, Tensor]:
        a, b, distance = ctx.saved_tensors
        weight = (gradient / distance).masked_fill_(distance == 0, 0).neg_()
        return weight @ b, weight.mT @ a
