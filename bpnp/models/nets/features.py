"""Point features (paper section 3.3, after Yi et al. 2018) and PointNet's input transform; padding changes nothing."""

from itertools import pairwise

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from bpnp.models.nets.normalisation import MaskedBatchNorm, centred, linear_context_norm
from bpnp.types import unpadded


class ResidualBlock(nn.Module):
    """x + relu(CN(linear_c(CN(linear_b(linear_a(x)))))), CN the context norm.

    Nothing stands between linear_a and linear_b: they are applied as one map, made of their product.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.linear_a = nn.Linear(channels, channels)
        self.linear_b = nn.Linear(channels, channels)
        self.linear_c = nn.Linear(channels, channels)

    def forward(self, x: Float[Tensor, "b k c"], mask: Bool[Tensor, "b k"] | None) -> Float[Tensor, "b k c"]:
        """mask: None where nothing is padded."""
        a, b, c = self.linear_a, self.linear_b, self.linear_c
        with torch.autocast(x.device.type, enabled=False):  # the product keeps its digits
            weight, bias = b.weight @ a.weight, torch.addmv(b.bias, b.weight, a.bias)
        return linear_context_norm(linear_context_norm(x, weight, bias, mask), c.weight, c.bias, mask, skip=x)


class PointFeatures(nn.Module):
    """A vector of unit length for each point, from its coordinates and the statistics of its set.

    Args:
        coordinates: 2 or 3.
        channels: width of the residual net.
        depth: its residual blocks.
        centre: subtract the mean feature of the set before the normalisation to unit length, which sharpens the
            assignment (ours; off in the paper).
    """

    def __init__(self, coordinates: int, *, channels: int = 128, depth: int = 12, centre: bool = False) -> None:
        super().__init__()
        self.coordinates, self.channels, self.depth, self.centre = coordinates, channels, depth, centre
        self.enter = nn.Linear(coordinates, channels)
        self.blocks = nn.ModuleList(ResidualBlock(channels) for _ in range(depth))

    def forward(self, points: Float[Tensor, "b k d"], mask: Bool[Tensor, "b k"]) -> Float[Tensor, "b k c"]:
        z, seen = self.enter(points), None if unpadded(mask) else mask
        for block in self.blocks:
            z = block(z, seen)
        return nn.functional.normalize(centred(z, mask) if self.centre else z, dim=-1)


class ImageFeatures(PointFeatures):
    """Features of normalised image points.

    Args:
        channels, depth, centre: as in `PointFeatures`.
        scale: factor on the coordinates; 4 brings the image of a 50 degree camera to the size of a unit scene.
    """

    def __init__(self, *, channels: int = 128, depth: int = 12, centre: bool = False, scale: float = 1.0) -> None:
        super().__init__(2, channels=channels, depth=depth, centre=centre)
        self.scale = scale

    def forward(self, points: Float[Tensor, "b m 2"], mask: Bool[Tensor, "b m"]) -> Float[Tensor, "b m c"]:
        return super().forward(self.scale * points, mask)


class SceneFeatures(PointFeatures):
    """Features of scene points after PointNet's learned transform of the set.

    Args:
        channels, depth, centre: as in `PointFeatures`.
        normalise: centre the points and scale them to unit size first, so that the features depend neither on the
            scene's unit nor on its origin.
    """

    def __init__(self, *, channels: int = 128, depth: int = 12, centre: bool = False, normalise: bool = False) -> None:
        super().__init__(3, channels=channels, depth=depth, centre=centre)
        self.normalise = normalise
        self.align = InputTransform()

    def forward(self, points: Float[Tensor, "b n 3"], mask: Bool[Tensor, "b n"]) -> Float[Tensor, "b n c"]:
        points = normalise_points3d(points, mask) if self.normalise else points
        return super().forward(self.align(points, mask), mask)


class InputTransform(nn.Module):
    """PointNet's learned 3 x 3 transform T of a 3D set: points @ T, T = I + output of a small set network."""

    def __init__(self) -> None:
        super().__init__()
        widths = (3, 64, 128, 1024, 512, 256)
        self.linears = nn.ModuleList(nn.Linear(a, b) for a, b in pairwise(widths))
        self.norms = nn.ModuleList(MaskedBatchNorm(width) for width in widths[1:])
        self.out = nn.Linear(256, 9)

    def forward(self, points: Float[Tensor, "b n 3"], mask: Bool[Tensor, "b n"]) -> Float[Tensor, "b n 3"]:
        z, seen = points, None if unpadded(mask) else mask
        for linear, norm in zip(self.linears[:3], self.norms[:3], strict=True):
            z = torch.relu(norm(linear(z), seen))
        z = (z if seen is None else z.masked_fill(~seen.unsqueeze(-1), 0)).amax(1)
        for linear, norm in zip(self.linears[3:], self.norms[3:], strict=True):
            z = torch.relu(norm(linear(z)))
        transform = torch.eye(3, dtype=z.dtype, device=z.device) + self.out(z).unflatten(-1, (3, 3))
        return points @ transform


def normalise_points3d(points3d: Float[Tensor, "b n 3"], mask: Bool[Tensor, "b n"]) -> Float[Tensor, "b n 3"]:
    """Centred at the mean, root mean square distance one: features that do not depend on the scene's units."""
    weight = mask.unsqueeze(-1).to(points3d.dtype)
    around = centred(points3d, mask) * weight
    radius = ((around**2).sum((1, 2), keepdim=True) / weight.sum(1, keepdim=True)).sqrt()
    return around / torch.where(radius > 0, radius, 1)
