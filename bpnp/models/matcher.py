"""Matcher for clutter: attention within and between both point sets, and dustbins for unmatched points."""

import math
from dataclasses import replace
from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from bpnp.geometry import masked_median
from bpnp.layers.assignment import check_mu, dustbin_marginals, sinkhorn, uniform_marginal
from bpnp.layers.implicit import BackwardStats
from bpnp.layers.pnp import WeightedPnP
from bpnp.layers.ransac.layer import RansacPnP
from bpnp.models.bpnpnet import pairwise_distance
from bpnp.models.nets import ExchangeBlock, Neighbourhood, subtract_mean
from bpnp.models.pose_stages import StageClock, pnp_pose, ransac_pose
from bpnp.models.refinement import Refinement
from bpnp.models.weights import AnyModule, TrainedNet, module_or_default
from bpnp.types import Batch, Prediction, SolveStats

WIDEST = 4.0  # largest distance from the centre of a view's image in focal lengths; 76 degrees
FREQUENCIES = 8  # frequencies that encode a coordinate, from half a period per robust radius upwards by sqrt(2)


class Matcher(TrainedNet):
    """Network for point sets with many points that have no correspondence.

    Points are encoded from their coordinates in a robust frame of their set and from their nearest neighbours. Blocks
    of self and cross attention exchange information between both sets, which BPnPNet's features do not. A head predicts
    the cost of leaving each point unmatched. Entropic transport with dustbins of these costs gives the assignment;
    RANSAC, weighted PnP and the refinement turn it into poses as in `BPnPNet`.

    Args:
        channels: Width, a multiple of heads. Default 128.
        depth: Number of attention blocks, default 6.
        heads: Number of heads of each attention, default 4.
        neighbours: Number of nearest neighbours that describe a point, default 8; 0 for none.
        frame: Frame in which the 3D points are expected: "any", or "view", that of a camera nearby which looks along
            the third axis, such as a map's view of the same scene. In "view" a 3D point is also described by its image
            in that camera, as a 2D point is. `bpnp.solve` and `SceneMap.localize` transform the points, and the pose
            back.
        mu: Entropy weight of the transport at the start of training, default 0.1; it is learned.
        tolerance: L1 error of the marginals at which the transport stops, default 1e-6.
        ransac: As in `BPnPNet`.
        pnp: As in `BPnPNet`.
        refinement: As in `BPnPNet`.

    >>> import torch
    >>> from bpnp import Batch, Matcher
    >>> net = Matcher(channels=32, depth=2).eval()
    >>> prediction = net.match(Batch.from_arrays(torch.rand(20, 2), torch.rand(30, 3)))
    >>> mass = prediction.assignment.sum(2) + prediction.unmatched2d
    >>> bool(torch.allclose(mass, torch.full((1, 20), 1 / 50)))
    True
    """

    def __init__(
        self,
        *,
        channels: int = 128,
        depth: int = 6,
        heads: int = 4,
        neighbours: int = 8,
        frame: Literal["any", "view"] = "any",
        mu: float = 0.1,
        tolerance: float = 1e-6,
        ransac: RansacPnP | AnyModule | None = None,
        pnp: WeightedPnP | AnyModule | None = None,
        refinement: Refinement | None = None,
    ) -> None:
        super().__init__()
        check_mu(mu)
        if frame not in ("any", "view"):
            raise ValueError(f"`frame` is {frame!r}; it is any or view")
        self.frame = frame
        self.channels, self.depth, self.heads, self.neighbours = channels, depth, heads, neighbours
        self.mu, self.tolerance = mu, tolerance
        self.backward_stats = BackwardStats()
        self.enter2d = nn.Linear(2 * (1 + 2 * FREQUENCIES) + 3, channels)
        self.enter3d = nn.Linear(3 * (1 + 2 * FREQUENCIES), channels)
        self.around2d = Neighbourhood(2, channels, neighbours=neighbours) if neighbours else None
        self.around3d = Neighbourhood(3, channels, neighbours=neighbours) if neighbours else None
        self.seen = None
        if frame == "view":  # zero at first, so that training can continue from weights for the frame "any"
            self.seen = nn.Linear(channels, channels, bias=False)
            nn.init.zeros_(self.seen.weight)
        self.blocks = nn.ModuleList(ExchangeBlock(channels, heads) for _ in range(depth))
        self.norm = nn.LayerNorm(channels)
        self.project = nn.Linear(channels, channels)
        self.leave = nn.Linear(channels, 1)
        self.bin_cost = nn.Parameter(torch.ones(()))
        self.log_mu = nn.Parameter(torch.tensor(math.log(mu)))
        self.ransac = module_or_default(ransac, RansacPnP)
        self.pnp = module_or_default(pnp, WeightedPnP)
        self.refinement = Refinement() if refinement is None else refinement

    def forward(self, batch: Batch) -> Prediction:
        """Return the assignment, unmatched probabilities, and poses "ransac", "pnp" and, in evaluation, "refined".

        Args:
            batch: Problems.

        Returns:
            Prediction with P (b, m, n), `unmatched2d` (b, m), `unmatched3d` (b, n), the stats and the poses.
        """
        clock = StageClock()
        prediction = self.match(batch)
        assert prediction.assignment is not None
        ransac = ransac_pose(self.ransac, prediction.assignment, batch)
        clock.record("ransac")
        pnp = pnp_pose(self.pnp, prediction.assignment, batch, ransac)
        clock.record("pnp")
        prediction = replace(prediction, poses={"ransac": ransac, "pnp": pnp})
        return prediction if self.training else clock.add_times(self.refinement(prediction, batch))

    def match(self, batch: Batch) -> Prediction:
        """Return the assignment and the unmatched probabilities, without poses.

        Args:
            batch: Problems.

        Returns:
            Prediction with P (b, m, n), `unmatched2d` (b, m), `unmatched3d` (b, n) and the stats.
        """
        plan, stats = self.transport(batch)
        return Prediction(plan[:, :-1, :-1], stats, unmatched2d=plan[:, :-1, -1], unmatched3d=plan[:, -1, :-1])

    def transport(self, batch: Batch) -> tuple[Float[Tensor, "b rows cols"], SolveStats]:
        """Compute the plan over the points and one dustbin on each side.

        Every real point has the mass 1 / (m + n), each dustbin that of all points of the other side. A match costs the
        distance of the unit features, an unmatched point its own predicted cost.

        Args:
            batch: Problems.

        Returns:
            The plan (b, m + 1, n + 1), dustbins last, and the stats of the transport.
        """
        batch = batch.to(self.bin_cost.dtype)
        z2d, z3d = self.features(batch)
        cost = pairwise_distance(self._unit(z2d, batch.mask2d), self._unit(z3d, batch.mask3d))
        leave2d, leave3d = self.bin_cost + self.leave(z2d), self.bin_cost + self.leave(z3d)
        corner = self.bin_cost.expand(len(batch), 1, 1)
        cost = torch.cat([torch.cat([cost, leave2d], 2), torch.cat([leave3d.mT, corner], 2)], 1)
        rows, cols = (uniform_marginal(mask, cost.dtype) for mask in (batch.mask2d, batch.mask3d))
        rows, cols = dustbin_marginals(rows, cols, batch.mask2d, batch.mask3d)
        return sinkhorn(
            cost,
            mu=self.log_mu.exp(),
            row_marginal=rows,
            col_marginal=cols,
            tolerance=self.tolerance,
            backward_stats=self.backward_stats,
        )

    def features(self, batch: Batch) -> tuple[Float[Tensor, "b m c"], Float[Tensor, "b n c"]]:
        """Return the features of both sides after the last block, layer-normalised, not of unit length.

        Args:
            batch: Problems, in the dtype of the network.

        Returns:
            Features of the image points (b, m, c) and of the scene points (b, n, c).
        """
        centre3d, radius3d = robust_frame(batch.points3d, batch.mask3d)
        local3d = (batch.points3d - centre3d) / radius3d
        x2d, x3d = self._image_features(batch.points2d, batch.mask2d), self.enter3d(encode(local3d))
        if self.around3d is not None:
            x3d = x3d + self.around3d(local3d, batch.mask3d)
        if self.seen is not None:
            x3d = x3d + self.seen(self._image_features(image_of(batch.points3d), batch.mask3d))
        for block in self.blocks:
            x2d, x3d = block(x2d, x3d, batch.mask2d, batch.mask3d)
        return self.norm(x2d), self.norm(x3d)

    def _image_features(self, points2d: Float[Tensor, "b k 2"], mask: Bool[Tensor, "b k"]) -> Float[Tensor, "b k c"]:
        """Encode image points: position in a robust frame, the frame itself, and the neighbourhood."""
        centre, radius = robust_frame(points2d, mask)
        local = (points2d - centre) / radius
        frame = torch.cat([centre, radius.log()], -1).expand(-1, local.shape[1], -1)
        x = self.enter2d(torch.cat([encode(local), frame], -1))
        return x if self.around2d is None else x + self.around2d(local, mask)

    def _unit(self, z: Float[Tensor, "b k c"], mask: Bool[Tensor, "b k"]) -> Float[Tensor, "b k c"]:
        """Project features, subtract their mean over the set, and scale them to unit length.

        Without the mean, the features of a set cannot all be the same.
        """
        return nn.functional.normalize(subtract_mean(self.project(z), mask), dim=-1)


def robust_frame(
    points: Float[Tensor, "b k d"], mask: Bool[Tensor, "b k"]
) -> tuple[Float[Tensor, "b 1 d"], Float[Tensor, "b 1 1"]]:
    """Return the median of each coordinate and the median distance from it; one for coinciding points.

    Up to half of the points may be clutter. Padding is ignored.
    """
    centre = masked_median(points.mT, mask.unsqueeze(1)).unsqueeze(1)
    radius = masked_median(torch.linalg.vector_norm(points - centre, dim=-1), mask)[:, None, None]
    return centre, torch.where(radius > 0, radius, 1)


def image_of(points3d: Float[Tensor, "b n 3"]) -> Float[Tensor, "b n 2"]:
    """Return x/z, y/z of points in camera coordinates, limited to a wide image for points far off or behind."""
    plane = points3d[..., :2]
    depth = torch.maximum(points3d[..., 2:], plane.norm(dim=-1, keepdim=True) / WIDEST)
    return plane / depth.clamp_min(torch.finfo(depth.dtype).tiny)


def encode(points: Float[Tensor, "b k d"]) -> Float[Tensor, "b k e"]:
    """Return coordinates, and their sines and cosines at increasing frequencies."""
    frequencies = math.pi / 2 * math.sqrt(2) ** torch.arange(FREQUENCIES, dtype=points.dtype, device=points.device)
    phase = (points.unsqueeze(-1) * frequencies).flatten(-2)
    return torch.cat([points, phase.sin(), phase.cos()], -1)
