"""Feature networks of point sets; no result depends on a padded point.

Norms of padded sets: the context norm (Yi et al. 2018) and batch norm. Point features with PointNet's input transform
(paper section 3.4). Attention within and between two sets.
"""

from itertools import pairwise
from typing import Any

import torch
import torch.distributed as dist
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.autograd.function import once_differentiable
from torch.nn import functional

from bpnp.types import has_no_padding

CONTEXT_EPS = 1e-3  # added to the variance, as in the authors' code


def subtract_mean(x: Float[Tensor, "b k c"], mask: Bool[Tensor, "b k"]) -> Float[Tensor, "b k c"]:
    """Subtract the mean over the real points of each set, per channel."""
    weight = mask.unsqueeze(-1).to(x.dtype)
    return x - (x * weight).sum(1, keepdim=True) / weight.sum(1, keepdim=True)


def linear_context_norm(
    x: Float[Tensor, "b k c"],
    weight: Float[Tensor, "d c"],
    bias: Float[Tensor, " d"],
    mask: Bool[Tensor, "b k"] | None,
    skip: Float[Tensor, "b k d"] | None = None,
) -> Float[Tensor, "b k d"]:
    """Apply a linear map and the context norm: y = CN(x W^T + b), CN(z) = (z - mean) / sqrt(var + 1e-3).

    The statistics are over the points of each set, per channel; the variance is unbiased, and zero for a set of one
    point. The context norm is the only exchange between the points of a set. Statistics of half-precision values are
    computed in float32. The bias has no effect and its gradient is zero. Padded points have y = 0; with `skip`, the
    result is skip + relu(y).
    """
    device = x.device.type
    if torch.is_autocast_enabled(device):
        dtype = torch.get_autocast_dtype(device)
        x, weight, bias = x.to(dtype), weight.to(dtype), bias.to(dtype)
    with torch.autocast(device, enabled=False):
        return _LinearContextNorm.apply(x, weight, bias, mask, skip)


class _LinearContextNorm(torch.autograd.Function):
    """Linear map and context norm in place; results in new memory would cost more than their arithmetic.

    x and y are stored for the gradient: dL/dz = (g - mean(g) - y sum(g y) / (count - 1)) / std with the gradient g of
    y.
    """

    @staticmethod
    def forward(ctx: Any, x: Tensor, weight: Tensor, bias: Tensor, mask: Tensor | None, skip: Tensor | None) -> Tensor:
        z = functional.linear(x, weight, bias)
        y = _zero_padding(z if z.dtype == torch.float64 else z.float(), mask)
        count = y.new_full((1, 1, 1), y.shape[1]) if mask is None else mask.sum(1)[:, None, None].to(y.dtype)
        y = _zero_padding(y.sub_(y.sum(1, keepdim=True) / count), mask)
        scale = torch.rsqrt(y.square().sum(1, keepdim=True) / (count - 1).clamp_min(1) + CONTEXT_EPS)
        y = y.mul_(scale).to(x.dtype)
        ctx.rectified = skip is not None
        ctx.save_for_backward(x, weight, y, scale, count, mask)
        return y if skip is None else torch.relu(y).add_(skip)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        x, weight, y, scale, count, mask = ctx.saved_tensors
        g = gradient.to(y.dtype)
        g = _zero_padding(torch.ops.aten.threshold_backward(g, y, 0) if ctx.rectified else g, mask)
        wide = y.to(scale.dtype)
        dz = g * wide
        along = dz.sum(1, keepdim=True) / (count - 1).clamp_min(1)
        mean = g.sum(1, keepdim=True, dtype=scale.dtype) / count
        torch.mul(wide, along, out=dz).add_(mean).sub_(g).mul_(-scale)
        dz = _zero_padding(dz, mask).to(x.dtype)
        to_x, to_weight = ctx.needs_input_grad[:2]
        dx = dz @ weight if to_x else None
        dw = dz.flatten(0, 1).mT @ x.flatten(0, 1) if to_weight else None
        return dx, dw, torch.zeros_like(dz[0, 0]), None, gradient if ctx.rectified else None


def _zero_padding(x: Float[Tensor, "b k c"], mask: Bool[Tensor, "b k"] | None) -> Float[Tensor, "b k c"]:
    """Return x with zeros at padded points."""
    return x if mask is None else x.masked_fill(~mask.unsqueeze(-1), 0)


class _SumOverProcesses(torch.autograd.Function):
    """Sum of a tensor over all processes; its gradient is the sum of theirs."""

    @staticmethod
    def forward(ctx: Any, values: Tensor) -> Tensor:
        total = values.clone(memory_format=torch.contiguous_format)
        dist.all_reduce(total)
        return total

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Tensor:
        return _SumOverProcesses.apply(gradient)


class MaskedBatchNorm(nn.BatchNorm1d):
    """Batch norm over the real points of (b, k, c), or over the samples of (b, c).

    In training the statistics cover the batches of all processes, so that splitting a batch over processes changes
    nothing. A batch with a single value per channel has no variance and uses the running statistics. With `momentum`
    None these are the mean over all batches, as in `torch.nn.BatchNorm1d`.
    """

    running_mean: Tensor
    running_var: Tensor
    num_batches_tracked: Tensor
    momentum: float | None

    def forward(self, x: Tensor, mask: Bool[Tensor, "b k"] | None = None) -> Tensor:
        """Return the normalised features, in the shape of x.

        Args:
            x: Features (b, k, c) or (b, c).
            mask: True at real points (b, k). Default: None, all are real.
        """
        mean, variance = self.running_mean, self.running_var
        if self.training:
            mean, variance = self._statistics(x, mask)
        scale = torch.rsqrt(variance + self.eps)
        if self.affine:
            scale = scale * self.weight
        return torch.addcmul((self.bias if self.affine else 0) - mean * scale, x, scale)

    def _statistics(self, x: Tensor, mask: Bool[Tensor, "b k"] | None) -> tuple[Tensor, Tensor]:
        """Return mean and variance over all processes, and update the running statistics."""
        real = torch.ones_like(x[..., :1]) if mask is None else mask.unsqueeze(-1)
        weight, axes = real.to(self.running_mean), tuple(range(x.ndim - 1))  # in the dtype of the statistics, not half
        count, total = weight.sum().reshape(1), (x * weight).sum(axes)
        if dist.is_initialized():
            count, total = _SumOverProcesses.apply(count), _SumOverProcesses.apply(total)
        mean = total / count
        scatter = (((x - mean) * weight) ** 2).sum(axes)
        if dist.is_initialized():
            scatter = _SumOverProcesses.apply(scatter)
        enough = count > 1
        with torch.no_grad():
            self.num_batches_tracked += enough.squeeze()
            latest = 1 / self.num_batches_tracked.clamp_min(1) if self.momentum is None else self.momentum
            rate = latest * enough.to(self.running_mean.dtype)
            self.running_mean.lerp_(mean.to(self.running_mean.dtype), rate)
            self.running_var.lerp_((scatter / (count - 1).clamp_min(1)).to(self.running_var.dtype), rate)
        return torch.where(enough, mean, self.running_mean), torch.where(enough, scatter / count, self.running_var)


class ResidualBlock(nn.Module):
    """Residual block x + relu(CN(linear_c(CN(linear_b(linear_a(x)))))) with the context norm CN.

    There is nothing between linear_a and linear_b, so their product is applied as one map.

    Args:
        channels: Width.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.linear_a = nn.Linear(channels, channels)
        self.linear_b = nn.Linear(channels, channels)
        self.linear_c = nn.Linear(channels, channels)

    def forward(self, x: Float[Tensor, "b k c"], mask: Bool[Tensor, "b k"] | None) -> Float[Tensor, "b k c"]:
        """Return the features (b, k, c).

        Args:
            x: Features (b, k, c).
            mask: True at real points (b, k), None without padding.
        """
        a, b, c = self.linear_a, self.linear_b, self.linear_c
        with torch.autocast(x.device.type, enabled=False):  # full precision for the product of the weights
            weight, bias = b.weight @ a.weight, torch.addmv(b.bias, b.weight, a.bias)
        return linear_context_norm(linear_context_norm(x, weight, bias, mask), c.weight, c.bias, mask, skip=x)


class PointFeatures(nn.Module):
    """Unit feature vector of each point, from its coordinates and the statistics of its set.

    Args:
        coordinates: Number of coordinates, 2 or 3.
        channels: Width of the residual network.
        depth: Number of residual blocks.
        centre: Subtract the mean feature of the set before scaling to unit length, which sharpens the assignment (an
            addition to the paper). Default False.
    """

    def __init__(self, coordinates: int, *, channels: int = 128, depth: int = 12, centre: bool = False) -> None:
        super().__init__()
        self.coordinates, self.channels, self.depth, self.centre = coordinates, channels, depth, centre
        self.enter = nn.Linear(coordinates, channels)
        self.blocks = nn.ModuleList(ResidualBlock(channels) for _ in range(depth))

    def forward(self, points: Float[Tensor, "b k d"], mask: Bool[Tensor, "b k"]) -> Float[Tensor, "b k c"]:
        """Return unit features (b, k, c).

        Args:
            points: Coordinates (b, k, d).
            mask: True at real points (b, k).
        """
        z, padding_mask = self.enter(points), None if has_no_padding(mask) else mask
        for block in self.blocks:
            z = block(z, padding_mask)
        return functional.normalize(subtract_mean(z, mask) if self.centre else z, dim=-1)


class ImageFeatures(PointFeatures):
    """Features of normalised image points.

    Args:
        channels: Width of the residual network.
        depth: Number of residual blocks.
        centre: As in `PointFeatures`.
        scale: Factor of the coordinates, default 1. With 4 the coordinates of a camera with a field of view of 50
            degrees, which reach +-0.47, reach +-1.9 and are thus of the order of those of the scene.
    """

    def __init__(self, *, channels: int = 128, depth: int = 12, centre: bool = False, scale: float = 1.0) -> None:
        super().__init__(2, channels=channels, depth=depth, centre=centre)
        self.scale = scale

    def forward(self, points: Float[Tensor, "b m 2"], mask: Bool[Tensor, "b m"]) -> Float[Tensor, "b m c"]:
        """Return unit features (b, m, c).

        Args:
            points: Normalised image coordinates (b, m, 2).
            mask: True at real points (b, m).
        """
        return super().forward(self.scale * points, mask)


class SceneFeatures(PointFeatures):
    """Features of scene points, after PointNet's learned transform of the set.

    Args:
        channels: Width of the residual network.
        depth: Number of residual blocks.
        centre: As in `PointFeatures`.
        normalise: Centre the points and scale them to unit size first, so that the features depend neither on the unit
            nor on the origin of the scene.
    """

    def __init__(self, *, channels: int = 128, depth: int = 12, centre: bool = False, normalise: bool = False) -> None:
        super().__init__(3, channels=channels, depth=depth, centre=centre)
        self.normalise = normalise
        self.align = InputTransform()

    def forward(self, points: Float[Tensor, "b n 3"], mask: Bool[Tensor, "b n"]) -> Float[Tensor, "b n c"]:
        """Return unit features (b, n, c).

        Args:
            points: Scene points (b, n, 3).
            mask: True at real points (b, n).
        """
        points = normalise_points3d(points, mask) if self.normalise else points
        return super().forward(self.align(points, mask), mask)


class InputTransform(nn.Module):
    """PointNet's learned 3 x 3 transform of a 3D set: points @ T, T = I + output of a small set network."""

    def __init__(self) -> None:
        super().__init__()
        widths = (3, 64, 128, 1024, 512, 256)
        self.linears = nn.ModuleList(nn.Linear(a, b) for a, b in pairwise(widths))
        self.norms = nn.ModuleList(MaskedBatchNorm(width) for width in widths[1:])
        self.out = nn.Linear(256, 9)

    def forward(self, points: Float[Tensor, "b n 3"], mask: Bool[Tensor, "b n"]) -> Float[Tensor, "b n 3"]:
        """Return the transformed points (b, n, 3).

        Args:
            points: Scene points (b, n, 3).
            mask: True at real points (b, n).
        """
        z, padding_mask = points, None if has_no_padding(mask) else mask
        for linear, norm in zip(self.linears[:3], self.norms[:3], strict=True):
            z = torch.relu(norm(linear(z), padding_mask))
        z = (z if padding_mask is None else z.masked_fill(~padding_mask.unsqueeze(-1), 0)).amax(1)
        for linear, norm in zip(self.linears[3:], self.norms[3:], strict=True):
            z = torch.relu(norm(linear(z)))
        transform = torch.eye(3, dtype=z.dtype, device=z.device) + self.out(z).unflatten(-1, (3, 3))
        return points @ transform


def normalise_points3d(points3d: Float[Tensor, "b n 3"], mask: Bool[Tensor, "b n"]) -> Float[Tensor, "b n 3"]:
    """Centre the points of each set at their mean and scale them to a root mean square distance of 1; padding is 0."""
    weight = mask.unsqueeze(-1).to(points3d.dtype)
    around = subtract_mean(points3d, mask) * weight
    radius = ((around**2).sum((1, 2), keepdim=True) / weight.sum(1, keepdim=True)).sqrt()
    return around / torch.where(radius > 0, radius, 1)


class Attention(nn.Module):
    """Residual attention x + out(softmax(q k^T / sqrt(d)) v), with layer norm of both inputs.

    Args:
        channels: Width, a multiple of heads.
        heads: Number of heads.
    """

    def __init__(self, channels: int, heads: int) -> None:
        super().__init__()
        if channels % heads:
            raise ValueError(f"`channels` {channels} is no multiple of `heads` {heads}")
        self.heads = heads
        self.norm = nn.LayerNorm(channels)
        self.query = nn.Linear(channels, channels)
        self.key_value = nn.Linear(channels, 2 * channels)
        self.out = nn.Linear(channels, channels)

    def forward(
        self, x: Float[Tensor, "b k c"], source: Float[Tensor, "b l c"], mask: Bool[Tensor, "b l"]
    ) -> Float[Tensor, "b k c"]:
        """Return the features (b, k, c).

        Args:
            x: Features that give the queries (b, k, c).
            source: Features that give keys and values (b, l, c).
            mask: True at the real points of `source` (b, l).
        """
        q = self._split(self.query(self.norm(x)))
        k, v = (self._split(part) for part in self.key_value(self.norm(source)).chunk(2, -1))
        z = functional.scaled_dot_product_attention(q, k, v, attn_mask=mask[:, None, None, :])
        return x + self.out(z.transpose(1, 2).flatten(2))

    def _split(self, x: Float[Tensor, "b k c"]) -> Float[Tensor, "b h k d"]:
        return x.unflatten(-1, (self.heads, -1)).transpose(1, 2)


class FeedForward(nn.Module):
    """Residual network x + linear(gelu(linear(norm(x)))) of each point.

    Args:
        channels: Width; the hidden layer has twice as many.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(channels)
        self.enter = nn.Linear(channels, 2 * channels)
        self.out = nn.Linear(2 * channels, channels)

    def forward(self, x: Float[Tensor, "b k c"]) -> Float[Tensor, "b k c"]:
        """Return the features (b, k, c).

        Args:
            x: Features (b, k, c).
        """
        return x + self.out(functional.gelu(self.enter(self.norm(x))))


class ExchangeBlock(nn.Module):
    """Self attention of each set, then cross attention between both; the two directions share their weights.

    Args:
        channels: Width.
        heads: Number of heads.
    """

    def __init__(self, channels: int, heads: int) -> None:
        super().__init__()
        self.within = Attention(channels, heads)
        self.between = Attention(channels, heads)
        self.feed = FeedForward(channels)

    def forward(
        self,
        x2d: Float[Tensor, "b m c"],
        x3d: Float[Tensor, "b n c"],
        mask2d: Bool[Tensor, "b m"],
        mask3d: Bool[Tensor, "b n"],
    ) -> tuple[Float[Tensor, "b m c"], Float[Tensor, "b n c"]]:
        """Return the features of both sets, (b, m, c) and (b, n, c).

        Args:
            x2d: Features of the image points (b, m, c).
            x3d: Features of the scene points (b, n, c).
            mask2d: True at real image points (b, m).
            mask3d: True at real scene points (b, n).
        """
        x2d, x3d = self.within(x2d, x2d, mask2d), self.within(x3d, x3d, mask3d)
        x2d, x3d = self.between(x2d, x3d, mask3d), self.between(x3d, x2d, mask2d)
        return self.feed(x2d), self.feed(x3d)


class Neighbourhood(nn.Module):
    """Features of the neighbourhood of each point: the channel-wise maximum over responses to its nearest neighbours.

    Offsets are in units of the set's mean distance to the neighbours, so that a denser sample of the same shape has
    similar features. A point without a neighbour responds with zeros, and gets the bias of the last layer.

    Args:
        coordinates: Number of coordinates, 2 or 3.
        channels: Width.
        neighbours: Number of neighbours.
    """

    def __init__(self, coordinates: int, channels: int, *, neighbours: int) -> None:
        super().__init__()
        self.neighbours = neighbours
        self.enter = nn.Linear(coordinates + 1, channels)
        self.out = nn.Linear(channels, channels)

    def forward(self, points: Float[Tensor, "b k d"], mask: Bool[Tensor, "b k"]) -> Float[Tensor, "b k c"]:
        """Return the features (b, k, c).

        Args:
            points: Coordinates (b, k, d).
            mask: True at real points (b, k).
        """
        k = min(self.neighbours, points.shape[1] - 1)
        if k < 1:
            return self.out(points.new_zeros(*points.shape[:2], self.out.in_features))
        far = torch.cdist(points, points, compute_mode="donot_use_mm_for_euclid_dist")
        far = far.masked_fill(~mask.unsqueeze(1), torch.inf)
        far.diagonal(dim1=1, dim2=2).fill_(torch.inf)
        distance, index = far.topk(k, largest=False)
        real = distance.isfinite() & mask.unsqueeze(-1)
        distance = torch.where(real, distance, 0)
        unit = distance.sum((1, 2), keepdim=True) / real.sum((1, 2), keepdim=True).clamp_min(1)
        unit = torch.where(unit > 0, unit, 1)
        around = points.gather(1, index.flatten(1).unsqueeze(-1).expand(-1, -1, points.shape[-1]))
        offset = around.unflatten(1, index.shape[1:]) - points.unsqueeze(2)
        edges = torch.cat([offset, distance.unsqueeze(-1)], -1) / unit.unsqueeze(-1)
        response = torch.relu(self.enter(edges)).masked_fill(~real.unsqueeze(-1), 0).amax(2)
        return self.out(response)
