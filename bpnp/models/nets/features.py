"""Point features (paper section 3.3, after Yi et al. 2018) and PointNet's input transform; padding changes nothing."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from bpnp.models.nets.normalisation import MaskedBatchNorm, centred, highest_normed
from bpnp.models.nets.pointwise import Pointwise, pointwise_norm
from bpnp.types import unpadded


class ResidualBlock(nn.Module):
    """x + relu(CN(linear_c(CN(linear_b(linear_a(x)))))), CN the context norm, optionally followed by a batch norm.

    Nothing stands between linear_a and linear_b: they are applied as one map, made of their product. Where x itself is
    a linear map of the points' coordinates, its narrow matrix is a factor too.
    """

    def __init__(self, channels: int, *, batch_norm: bool) -> None:
        super().__init__()
        self.linear_a = nn.Linear(channels, channels)
        self.linear_b = nn.Linear(channels, channels)
        self.linear_c = nn.Linear(channels, channels)
        self.norm_b = MaskedBatchNorm(channels) if batch_norm else None
        self.norm_c = MaskedBatchNorm(channels) if batch_norm else None

    def forward(
        self,
        x: Float[Tensor, "b k c"],
        mask: Bool[Tensor, "b k"] | None,
        entered: tuple[Float[Tensor, "b k d"], nn.Linear] | None = None,
    ) -> Float[Tensor, "b k c"]:
        """mask: None where nothing is padded. entered: coordinates that x is a linear map of, and the map."""
        z = pointwise_norm(x if entered is None else entered[0], *self._first_map(entered), mask)
        c = self.linear_c
        if self.norm_b is None or self.norm_c is None:
            return pointwise_norm(z, c.weight, c.bias, mask, skip=x)
        z = pointwise_norm(self.norm_b(z, mask), c.weight, c.bias, mask)
        return x + torch.relu(self.norm_c(z, mask))

    def _first_map(self, entered: tuple[Tensor, nn.Linear] | None) -> tuple[Tensor, Tensor]:
        """Weight and bias; under autocast, their product keeps its digits."""
        weight: Tensor = self.linear_b.weight
        bias: Tensor = self.linear_b.bias
        with torch.autocast(weight.device.type, enabled=False):
            for inner in (self.linear_a,) if entered is None else (self.linear_a, entered[1]):
                weight, bias = weight @ inner.weight, torch.addmv(bias, weight, inner.bias)
        return weight, bias


class PointFeatures(nn.Module):
    """A vector of unit length for each point, from its coordinates and the statistics of its set.

    Args:
        coordinates: 2 or 3.
        channels: width of the residual net.
        depth: its residual blocks.
        batch_norm: batch norm after each context norm, as in the paper's text; the authors' code has none.
        centre: subtract the mean feature of the set before the normalisation to unit length, which sharpens the
            assignment (ours; off in the paper).
    """

    def __init__(
        self, coordinates: int, *, channels: int = 128, depth: int = 12, batch_norm: bool = False, centre: bool = False
    ) -> None:
        super().__init__()
        self.coordinates, self.channels, self.depth = coordinates, channels, depth
        self.batch_norm, self.centre = batch_norm, centre
        self.enter = Pointwise(coordinates, channels)
        self.blocks = nn.ModuleList(ResidualBlock(channels, batch_norm=batch_norm) for _ in range(depth))

    def forward(self, points: Float[Tensor, "b k d"], mask: Bool[Tensor, "b k"]) -> Float[Tensor, "b k c"]:
        z, seen = self.enter(points), None if unpadded(mask) else mask
        for k, block in enumerate(self.blocks):
            z = block(z, seen, None if k else (points, self.enter))
        return nn.functional.normalize(centred(z, mask) if self.centre else z, dim=-1)


class ImageFeatures(PointFeatures):
    """Features of normalised image points.

    Args:
        channels, depth, batch_norm, centre: as in `PointFeatures`.
        scale: factor on the coordinates; 4 brings the image of a 50 degree camera to the size of a unit scene.
    """

    def __init__(
        self,
        *,
        channels: int = 128,
        depth: int = 12,
        batch_norm: bool = False,
        centre: bool = False,
        scale: float = 1.0,
    ) -> None:
        super().__init__(2, channels=channels, depth=depth, batch_norm=batch_norm, centre=centre)
        self.scale = scale

    def forward(self, points: Float[Tensor, "b m 2"], mask: Bool[Tensor, "b m"]) -> Float[Tensor, "b m c"]:
        return super().forward(self.scale * points, mask)


class SceneFeatures(PointFeatures):
    """Features of scene points after PointNet's learned transform of the set.

    Args:
        channels, depth, batch_norm, centre: as in `PointFeatures`.
        normalise: centre the points and scale them to unit size first, so that the features depend neither on the
            scene's unit nor on its origin.
    """

    def __init__(
        self,
        *,
        channels: int = 128,
        depth: int = 12,
        batch_norm: bool = False,
        centre: bool = False,
        normalise: bool = False,
    ) -> None:
        super().__init__(3, channels=channels, depth=depth, batch_norm=batch_norm, centre=centre)
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
        kinds = (Pointwise, Pointwise, Pointwise, nn.Linear, nn.Linear)
        sizes = zip(kinds, widths[:-1], widths[1:], strict=True)
        self.linears = nn.ModuleList(kind(a, b) for kind, a, b in sizes)
        self.norms = nn.ModuleList(MaskedBatchNorm(width) for width in widths[1:])
        self.out = nn.Linear(256, 9)

    def forward(self, points: Float[Tensor, "b n 3"], mask: Bool[Tensor, "b n"]) -> Float[Tensor, "b n 3"]:
        z, seen = points, None if unpadded(mask) else mask
        for linear, norm in zip(self.linears[:2], self.norms[:2], strict=True):
            z = torch.relu(norm(linear(z), seen))
        z = torch.relu(highest_normed(z, self.linears[2], self.norms[2], seen))  # type: ignore[arg-type]
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
