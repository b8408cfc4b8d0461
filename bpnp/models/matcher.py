"""A matcher for clutter: attention within and between the two sets, and a bin for every point without a partner."""

import math
from dataclasses import replace
from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from bpnp.layers.assignment import check_mu, dustbin_marginals, sinkhorn, uniform_marginal
from bpnp.layers.implicit import BackwardStats
from bpnp.layers.pnp import WeightedPnP
from bpnp.layers.ransac import RansacPnP
from bpnp.models.bpnpnet import pairwise_distance
from bpnp.models.evaluation import Clock, Refinement, pnp_pose, ransac_pose
from bpnp.models.nets import ExchangeBlock, Neighbourhood, subtract_mean
from bpnp.models.weights import AnyModule, TrainedNet, module_or_default
from bpnp.types import Batch, Prediction, SolveStats

WIDEST = 4.0  # distance from the middle of a view's image over the focal length, 76 degrees
FREQUENCIES = 8  # of the encoding of a coordinate, from a half turn per robust radius, times sqrt(2) each


class Matcher(TrainedNet):
    """Pose from unmatched points of which many have no partner.

    Points are encoded from their coordinates in a robust frame of their set and from their nearest neighbours; blocks
    of self and cross attention let both sets know of each other, which BPnPNet's features do not; an inlier head gives
    each point its own cost of staying without a partner; entropic transport with these bins is the assignment, and
    RANSAC, the weighted PnP layer and the refinement make poses of it as in `BPnPNet`.

    Args:
        channels: width, a multiple of heads.
        depth: attention blocks.
        heads: of each attention.
        neighbours: nearest neighbours that a point is described by; 0 for none.
        frame: coordinates in which the 3D points are expected: "any", or "view", those of a camera nearby, such as that
            of a map's view of the same place, which looks along the third axis. There a 3D point is also described by
            its place in that camera's image, as a 2D point is. `bpnp.solve` and `SceneMap.localize` move the points
            so, and the pose back.
        mu: entropy weight of the transport at the start of a training; it is learned.
        tolerance: L1 error of the marginals at which the transport stops.
        ransac, pnp, refinement: as in `BPnPNet`.

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
            raise ValueError(f"expected `frame` any or view, got {frame!r}")
        self.frame = frame
        self.channels, self.depth, self.heads, self.neighbours = channels, depth, heads, neighbours
        self.mu, self.tolerance = mu, tolerance
        self.backward_stats = BackwardStats()
        self.enter2d = nn.Linear(2 * (1 + 2 * FREQUENCIES) + 3, channels)
        self.enter3d = nn.Linear(3 * (1 + 2 * FREQUENCIES), channels)
        self.around2d = Neighbourhood(2, channels, neighbours=neighbours) if neighbours else None
        self.around3d = Neighbourhood(3, channels, neighbours=neighbours) if neighbours else None
        self.seen = None
        if frame == "view":  # nothing of it at first, so that weights for any axes can go on so
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
        """Return the assignment, its bins and the poses "ransac" and "pnp"; in evaluation "refined" too."""
        clock = Clock()
        prediction = self.match(batch)
        assert prediction.assignment is not None
        ransac = ransac_pose(self.ransac, prediction.assignment, batch)
        clock.record("ransac")
        pnp = pnp_pose(self.pnp, prediction.assignment, batch, ransac)
        clock.record("pnp")
        prediction = replace(prediction, poses={"ransac": ransac, "pnp": pnp})
        return prediction if self.training else clock.timed(self.refinement(prediction, batch))

    def match(self, batch: Batch) -> Prediction:
        """The assignment and its bins, without poses."""
        plan, stats = self.transport(batch)
        return Prediction(plan[:, :-1, :-1], stats, unmatched2d=plan[:, :-1, -1], unmatched3d=plan[:, -1, :-1])

    def transport(self, batch: Batch) -> tuple[Float[Tensor, "b rows cols"], SolveStats]:
        """Plan over the points and one bin on each side (last row, last column).

        Every real point has the mass 1 / (m + n), each bin that of the other side's points. A match costs the distance
        of the unit features, a point its own cost to leave.
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
        """Features of both sides after the last block, normalised by layer, not to unit length."""
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
        """Of points of an image: by their place in a robust frame, the frame itself, and what lies around them."""
        centre, radius = robust_frame(points2d, mask)
        local = (points2d - centre) / radius
        frame = torch.cat([centre, radius.log()], -1).expand(-1, local.shape[1], -1)
        x = self.enter2d(torch.cat([encode(local), frame], -1))
        return x if self.around2d is None else x + self.around2d(local, mask)

    def _unit(self, z: Float[Tensor, "b k c"], mask: Bool[Tensor, "b k"]) -> Float[Tensor, "b k c"]:
        """Projected, centred over the set, of unit length: a set's features cannot all be the same."""
        return nn.functional.normalize(subtract_mean(self.project(z), mask), dim=-1)


def robust_frame(
    points: Float[Tensor, "b k d"], mask: Bool[Tensor, "b k"]
) -> tuple[Float[Tensor, "b 1 d"], Float[Tensor, "b 1 1"]]:
    """Median of each coordinate and median distance from it: half of the points may be clutter. Padding is not seen.

    A set whose points coincide has radius one.
    """
    hidden = points.masked_fill(~mask.unsqueeze(-1), torch.nan)
    centre = hidden.nanmedian(1, keepdim=True).values
    radius = torch.linalg.vector_norm(hidden - centre, dim=-1).nanmedian(1).values[:, None, None]
    return centre, torch.where(radius > 0, radius, 1)


def image_of(points3d: Float[Tensor, "b n 3"]) -> Float[Tensor, "b n 2"]:
    """x/z, y/z of points in the coordinates of a camera; of those beside or behind it, at the edge of a wide image."""
    plane = points3d[..., :2]
    depth = torch.maximum(points3d[..., 2:], plane.norm(dim=-1, keepdim=True) / WIDEST)
    return plane / depth.clamp_min(torch.finfo(depth.dtype).tiny)


def encode(points: Float[Tensor, "b k d"]) -> Float[Tensor, "b k e"]:
    """Coordinates, and their sines and cosines at rising frequencies."""
    turns = math.pi / 2 * math.sqrt(2) ** torch.arange(FREQUENCIES, dtype=points.dtype, device=points.device)
    phase = (points.unsqueeze(-1) * turns).flatten(-2)
    return torch.cat([points, phase.sin(), phase.cos()], -1)
