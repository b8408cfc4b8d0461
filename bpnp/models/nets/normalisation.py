"""Norms of padded sets, which see no padded point: the context norm (Yi et al. 2018) and batch norm."""

from typing import Any

import torch
import torch.distributed as dist
import torch.distributed.nn.functional as collectives
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.autograd.function import once_differentiable
from torch.nn.functional import linear

CONTEXT_EPS = 1e-3  # as in the authors' code


def centred(x: Float[Tensor, "b k c"], mask: Bool[Tensor, "b k"]) -> Float[Tensor, "b k c"]:
    """x - mean over the real points of each set, per channel."""
    weight = mask.unsqueeze(-1).to(x.dtype)
    return x - (x * weight).sum(1, keepdim=True) / weight.sum(1, keepdim=True)


def linear_context_norm(
    x: Float[Tensor, "b k c"],
    weight: Float[Tensor, "d c"],
    bias: Float[Tensor, " d"],
    mask: Bool[Tensor, "b k"] | None,
    skip: Float[Tensor, "b k d"] | None = None,
) -> Float[Tensor, "b k d"]:
    """y = CN(x W^T + b) with CN(z) = (z - mean) / sqrt(var + 1e-3) over the points of each set, per channel.

    With `skip` the result is skip + relu(y). The context norm is the only exchange between the points of a set; its
    variance is unbiased, and zero for a set of one point. Padded points have y = 0; mask None: there are none. The
    statistics of half-precision values are made in float32. The bias has no effect and its gradient is zero.
    """
    device = x.device.type
    if torch.is_autocast_enabled(device):
        dtype = torch.get_autocast_dtype(device)
        x, weight, bias = x.to(dtype), weight.to(dtype), bias.to(dtype)
    with torch.autocast(device, enabled=False):
        return _LinearContextNorm.apply(x, weight, bias, mask, skip)


class _LinearContextNorm(torch.autograd.Function):
    """Keeps x and y for the gradient, and works in place: results in new memory cost more than their arithmetic.

    dL/dz = (g - mean(g) - y sum(g y) / (count - 1)) / std for the gradient g of y.
    """

    @staticmethod
    def forward(ctx: Any, x: Tensor, weight: Tensor, bias: Tensor, mask: Tensor | None, skip: Tensor | None) -> Tensor:
        z = linear(x, weight, bias)
        y = _hidden(z if z.dtype == torch.float64 else z.float(), mask)
        count = y.new_full((1, 1, 1), y.shape[1]) if mask is None else mask.sum(1)[:, None, None].to(y.dtype)
        y = _hidden(y.sub_(y.sum(1, keepdim=True) / count), mask)
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
        g = _hidden(torch.ops.aten.threshold_backward(g, y, 0) if ctx.rectified else g, mask)
        wide = y.to(scale.dtype)
        dz = g * wide
        along = dz.sum(1, keepdim=True) / (count - 1).clamp_min(1)
        mean = g.sum(1, keepdim=True, dtype=scale.dtype) / count
        torch.mul(wide, along, out=dz).add_(mean).sub_(g).mul_(-scale)
        dz = _hidden(dz, mask).to(x.dtype)
        to_x, to_weight = ctx.needs_input_grad[:2]
        dx = dz @ weight if to_x else None
        dw = dz.flatten(0, 1).mT @ x.flatten(0, 1) if to_weight else None
        return dx, dw, torch.zeros_like(dz[0, 0]), None, gradient if ctx.rectified else None


def _hidden(x: Float[Tensor, "b k c"], mask: Bool[Tensor, "b k"] | None) -> Float[Tensor, "b k c"]:
    """Zero at padded points."""
    return x if mask is None else x.masked_fill(~mask.unsqueeze(-1), 0)


class MaskedBatchNorm(nn.BatchNorm1d):
    """Batch norm over the real points of (b, k, c), or over the samples of (b, c).

    In training the statistics cover the batches of all processes, so that splitting a batch over processes changes
    nothing; a batch with a single value per channel has no variance and uses the running statistics.
    """

    running_mean: Tensor
    running_var: Tensor
    num_batches_tracked: Tensor
    momentum: float

    def forward(self, x: Tensor, mask: Bool[Tensor, "b k"] | None = None) -> Tensor:
        mean, variance = self.running_mean, self.running_var
        if self.training:
            mean, variance = self._statistics(x, mask)
        scale = torch.rsqrt(variance + self.eps) * self.weight
        return torch.addcmul(self.bias - mean * scale, x, scale)

    def _statistics(self, x: Tensor, mask: Bool[Tensor, "b k"] | None) -> tuple[Tensor, Tensor]:
        """Mean and variance of the values of all processes, which the running statistics follow."""
        real = torch.ones_like(x[..., :1]) if mask is None else mask.unsqueeze(-1)
        weight, axes = real.to(self.running_mean), tuple(range(x.ndim - 1))  # half precision has too few digits here
        count, total = weight.sum().reshape(1), (x * weight).sum(axes)
        if dist.is_initialized():
            count, total = collectives.all_reduce(count), collectives.all_reduce(total)
        mean = total / count
        scatter = (((x - mean) * weight) ** 2).sum(axes)
        if dist.is_initialized():
            scatter = collectives.all_reduce(scatter)
        enough = count > 1
        with torch.no_grad():
            rate = self.momentum * enough.to(self.running_mean.dtype)
            self.running_mean.lerp_(mean.to(self.running_mean.dtype), rate)
            self.running_var.lerp_((scatter / (count - 1).clamp_min(1)).to(self.running_var.dtype), rate)
            self.num_batches_tracked += 1
        return torch.where(enough, mean, self.running_mean), torch.where(enough, scatter / count, self.running_var)
