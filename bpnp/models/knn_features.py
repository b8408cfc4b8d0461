"""Features of point sets from graphs of nearest neighbours (Liu et al. 2020, the concurrent work that the paper names).

Source: Liu, Campbell, Li, Zhou, Song, Yang, "Learning 2D-3D Correspondences To Solve The Blind Perspective-n-Point
Problem", arXiv:2003.06752.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn import functional

from bpnp.checks import check_within
from bpnp.models.nets import InputTransform, MaskedBatchNorm, linear_context_norm, normalise_points3d
from bpnp.types import has_no_padding

NEIGHBOURS = 10  # points of a neighbourhood, the point itself included [points; convention, as in the authors' code]


def neighbour_mean(x: Float[Tensor, "b k c"], mask: Bool[Tensor, "b k"], neighbours: int) -> Float[Tensor, "b k c"]:
    """Return the mean feature of each point's nearest real points in feature space; the point itself is the nearest.

    A set of fewer real points has them all as neighbours. No gradient reaches the choice of the neighbours.
    """
    b, n, c = x.shape
    k = min(neighbours, n)
    with torch.no_grad():
        far = torch.cdist(x.float(), x.float(), compute_mode="donot_use_mm_for_euclid_dist")
        distance, index = far.masked_fill(~mask.unsqueeze(1), torch.inf).topk(k, largest=False)
        weight = distance.isfinite().to(x.dtype)
        weight = weight / weight.sum(-1, keepdim=True).clamp_min(1)
        row = index + n * torch.arange(b, device=x.device)[:, None, None]
    # A sum of rows by their index, which does not keep the neighbours' features (b, n, k, c) for the gradient.
    table, bags = x.reshape(b * n, c), row.view(b * n, k)
    return functional.embedding_bag(bags, table, mode="sum", per_sample_weights=weight.view(b * n, k)).view(b, n, c)


def edges(x: Float[Tensor, "b k c"], mask: Bool[Tensor, "b k"], neighbours: int) -> Float[Tensor, "b k 2*c"]:
    """Return the mean of (x_j - x_i, x_i) over the neighbours j of each point.

    A linear map of it is the mean over the neighbours of the map of their edges.
    """
    return torch.cat([neighbour_mean(x, mask, neighbours) - x, x], -1)


class NeighbourBlock(nn.Module):
    """Residual block of two linear maps of edges, each with the context norm, batch norm without parameters and ReLU.

    Args:
        channels: Width.
        neighbours: Number of neighbours.
    """

    def __init__(self, channels: int, neighbours: int) -> None:
        super().__init__()
        self.neighbours = neighbours
        self.linears = nn.ModuleList(nn.Linear(2 * channels, channels) for _ in range(2))
        self.norms = nn.ModuleList(MaskedBatchNorm(channels, affine=False) for _ in range(2))

    def forward(self, x: Float[Tensor, "b k c"], mask: Bool[Tensor, "b k"]) -> Float[Tensor, "b k c"]:
        """Return the features (b, k, c).

        Args:
            x: Features (b, k, c).
            mask: True at real points (b, k).
        """
        padding_mask = None if has_no_padding(mask) else mask
        z = x
        for linear, norm in zip(self.linears, self.norms, strict=True):
            assert isinstance(linear, nn.Linear)
            around = edges(z, mask, self.neighbours)
            z = torch.relu(norm(linear_context_norm(around, linear.weight, linear.bias, padding_mask), padding_mask))
        return x + z


class KnnFeatures(nn.Module):
    """Unit features of a point set by layers that average over nearest neighbours in feature space.

    A part of `BPnPNet` for `features2d` and `features3d`. Differences from the authors' code: padded points are masked,
    and scene points may be normalised.

    Args:
        coordinates: Number of coordinates: 2 for image points, 3 for scene points. These pass PointNet's learned
            transform first, as in `bpnp.models.nets.SceneFeatures`.
        channels: Width, default 128.
        depth: Number of residual blocks of two layers, default 12.
        neighbours: Number of neighbours, the point itself included, default 10.
        normalise: Centre the scene points and scale them to unit size first. Default False.

    >>> import torch
    >>> from bpnp.models import KnnFeatures
    >>> KnnFeatures(2, channels=8, depth=2)(torch.rand(1, 20, 2), torch.ones(1, 20, dtype=torch.bool)).shape
    torch.Size([1, 20, 8])
    """

    def __init__(
        self,
        coordinates: int,
        *,
        channels: int = 128,
        depth: int = 12,
        neighbours: int = NEIGHBOURS,
        normalise: bool = False,
    ) -> None:
        super().__init__()
        check_within(2, 3, coordinates=coordinates)
        self.coordinates, self.channels, self.depth = coordinates, channels, depth
        self.neighbours, self.normalise = neighbours, normalise
        self.align = InputTransform() if coordinates == 3 else None
        self.enter = nn.Linear(2 * coordinates, channels)
        self.blocks = nn.ModuleList(NeighbourBlock(channels, neighbours) for _ in range(depth))

    def forward(self, points: Float[Tensor, "b k d"], mask: Bool[Tensor, "b k"]) -> Float[Tensor, "b k c"]:
        """Return unit features (b, k, c).

        Args:
            points: Coordinates (b, k, d).
            mask: True at real points (b, k).
        """
        if self.align is not None:
            points = self.align(normalise_points3d(points, mask) if self.normalise else points, mask)
        z = self.enter(edges(points, mask, self.neighbours))
        for block in self.blocks:
            z = block(z, mask)
        return functional.normalize(z, dim=-1)
