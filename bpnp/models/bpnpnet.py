"""BPnPNet (Campbell, Liu, Gould, ECCV 2020): blind PnP end to end."""

from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from bpnp.geometry import bearings
from bpnp.layers.hypotheses import pose_hypotheses
from bpnp.layers.pnp import Method, WeightedPnP
from bpnp.layers.precision import full_precision
from bpnp.layers.ransac import Backend, RansacPnP
from bpnp.layers.refine import Refine
from bpnp.layers.sinkhorn import Sinkhorn
from bpnp.models.checkpoint import read_checkpoint
from bpnp.models.features import InputTransform, PointFeatures, normalise_points3d
from bpnp.models.pretrained import pretrained_path
from bpnp.types import Batch, Pose, Prediction

SQUARED_FLOOR = 1e-7  # rounding of the product of two float32 unit vectors


class BPnPNet(nn.Module):
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
    ) -> None:
        super().__init__()
        self.settings: dict[str, Any] = {
            k: v for k, v in locals().items() if k not in ("self", "__class__")
        }  # fmt: skip
        self.image_scale = image_scale
        self.normalise_scene = normalise_scene
        shape = {"channels": channels, "blocks": blocks, "batch_norm": batch_norm, "centre": centre_features}
        self.features2d = PointFeatures(2, **shape)  # type: ignore[arg-type]
        self.features3d = PointFeatures(3, **shape)  # type: ignore[arg-type]
        self.align = InputTransform()
        self.sinkhorn = Sinkhorn(mu=mu, learn_mu=learn_mu, dustbin=dustbin, tolerance=sinkhorn_tolerance)
        self.ransac = RansacPnP(
            backend=ransac_backend,
            pairs_factor=pairs_factor,
            threshold=threshold,
            max_iterations=ransac_iterations,
        )
        self.pnp = WeightedPnP(method=pnp_method, max_iterations=pnp_iterations)
        self.refine = Refine() if refine else None
        if hypotheses < 0:
            raise ValueError(f"expected a number of `hypotheses`, got {hypotheses}; try 0 for none")
        self.hypotheses = hypotheses
        if not refine:
            self.estimates = ("ransac", "pnp")

    def forward(self, batch: Batch, *, poses: bool = True) -> Prediction:
        """Prediction with the assignment and, if `poses`, the estimates "ransac" and "pnp"; in evaluation "refined"."""
        cost = self.cost(batch)
        assignment, assignment_stats = self.sinkhorn(cost, batch.mask2d, batch.mask3d)
        if not poses:
            return Prediction(assignment, assignment_stats)
        rays = bearings(batch.points2d)
        ransac = Pose(*self.ransac(assignment.detach(), batch.points2d, batch.points3d, batch.mask2d, batch.mask3d))
        pnp = Pose(*self.pnp(assignment, rays, batch.points3d, ransac.rotation, ransac.translation))
        estimates = {"ransac": ransac, "pnp": pnp}
        if self.refine is not None and not self.training:
            starts = self._starts(assignment, batch, [ransac, pnp])
            estimates["refined"] = Pose(*self.refine(rays, batch.points3d, *starts, batch.mask2d, batch.mask3d))
        return Prediction(assignment, assignment_stats, estimates)

    def cost(self, batch: Batch) -> Float[Tensor, "b m n"]:
        """M_ij = ||z_i - z_j||_2 between the unit features of both sides, in [0, 2], in the network's dtype."""
        batch = batch.to(self.features2d.enter.weight.dtype)
        points3d = normalise_points3d(batch.points3d, batch.mask3d) if self.normalise_scene else batch.points3d
        z2d = self.features2d(self.image_scale * batch.points2d, batch.mask2d)
        z3d = self.features3d(self.align(points3d, batch.mask3d), batch.mask3d)
        return pairwise_distance(z2d, z3d)

    def _starts(
        self, assignment: Float[Tensor, "b m n"], batch: Batch, poses: list[Pose]
    ) -> tuple[Float[Tensor, "b s 3 3"], Float[Tensor, "b s 3"]]:
        """The estimates, and the poses that the assignment proposes."""
        rotation = torch.stack([pose.rotation for pose in poses], 1)
        translation = torch.stack([pose.translation for pose in poses], 1)
        if not self.hypotheses:
            return rotation, translation
        turns, shifts, _ = pose_hypotheses(
            assignment, batch.points2d, batch.points3d, count=self.hypotheses, mask2d=batch.mask2d,
            mask3d=batch.mask3d,
        )  # fmt: skip
        return torch.cat([rotation, turns.to(rotation)], 1), torch.cat([translation, shifts.to(translation)], 1)

    @classmethod
    def from_checkpoint(cls, path: str | Path) -> "BPnPNet":
        """The network of a checkpoint that `bpnp fit` wrote, in evaluation mode.

        Raises FileNotFoundError, or ValueError naming the file if it holds no BPnPNet.
        """
        content = read_checkpoint(path)
        solver = content.get("solver", {})
        if solver.get("class") != cls.__name__:
            raise ValueError(f"expected a checkpoint of BPnPNet, got {solver.get('class', 'another file')} in {path}")
        net = cls(**solver["settings"])
        prefix = "solver."
        state = {k.removeprefix(prefix): v for k, v in content["state_dict"].items() if k.startswith(prefix)}
        net.load_state_dict(state)
        return net.eval()

    @classmethod
    def from_pretrained(cls, name: str) -> "BPnPNet":
        """A network with weights of this package, in evaluation mode; `docs/model-card.md` tells what they can do.

        name: "procedural-so3". Raises ValueError that lists the names for any other. Nothing is downloaded.
        """
        return cls.from_checkpoint(pretrained_path(name))


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
