"""One linear map for all points of a padded set, and the same followed by the context norm (Yi et al. 2018)."""

from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.autograd.function import once_differentiable
from torch.nn.grad import conv2d_weight

from bpnp.models.nets.context_norm import norm_gradient, normalise

CONTEXT_EPS = 1e-3  # as in the released code


def pointwise(x: Float[Tensor, "b k c"], weight: Float[Tensor, "d c"], bias: Tensor | None) -> Float[Tensor, "b k d"]:
    """x W^T + b.

    On the CPU as a 1 x 1 convolution whose channels are last in memory: oneDNN has AVX-512 for every processor, while
    MKL's matrix products leave half of the peak of those that are not Intel's.
    """
    if not x.is_cpu or x.dtype == torch.float64:
        return nn.functional.linear(x, weight, bias)
    out = nn.functional.conv2d(_images(x), weight[..., None, None], bias)
    return out.squeeze(2).mT.reshape(*x.shape[:2], len(weight))


def products(x: Float[Tensor, "b m c"], y: Float[Tensor, "b n c"], offset: float = 0.0) -> Float[Tensor, "b m n"]:
    """x_i . y_j + offset in each sample; of a single one by the kernels of `pointwise`."""
    if len(x) == 1:
        return pointwise(x, y[0], y.new_full(y.shape[1:2], offset))
    return torch.baddbmm(y.new_full((1, 1, 1), offset), x, y.mT)


def _images(x: Float[Tensor, "b k c"]) -> Float[Tensor, "i c 1 p"]:
    """The points as images of one row. With one thread torch gives oneDNN no batch of fewer than 16 images."""
    b, k, c = x.shape
    count = b if b >= 16 else next((count for count in range(16, 64) if b * k % count == 0), b)
    return x.reshape(count, -1, c).mT.unsqueeze(2)


class Pointwise(nn.Linear):
    """`pointwise` with its weights as a module."""

    def forward(self, x: Float[Tensor, "b k c"]) -> Float[Tensor, "b k d"]:
        return pointwise(x, self.weight, self.bias)


def pointwise_norm(
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
        return _PointwiseNorm.apply(x, weight, bias, mask, skip)


class _PointwiseNorm(torch.autograd.Function):
    """Keeps x and y for the gradient, and works in place: results in new memory cost more than their arithmetic.

    In a training on the CPU the norm is a compiled loop where nothing is padded.

    dL/dz = (g - mean(g) - y sum(g y) / (count - 1)) / std for the gradient g of y.
    """

    @staticmethod
    def forward(
        ctx: Any, x: Tensor, weight: Tensor, bias: Tensor, mask: Tensor | None, skip: Tensor | None
    ) -> Tensor:  # fmt: skip
        ctx.rectified = skip is not None
        z = pointwise(x, weight, bias)
        if mask is None and z.is_cpu and z.dtype == torch.float32 and any(ctx.needs_input_grad):
            scale, result = normalise(z, skip, CONTEXT_EPS)
            ctx.save_for_backward(x, weight, z, scale, None, None)
            return result
        y = z if z.dtype == torch.float64 else z.float()
        real = None if mask is None else mask.unsqueeze(-1).to(y.dtype)
        count = y.new_full((1, 1, 1), y.shape[1]) if real is None else real.sum(1, keepdim=True)
        y.sub_((y if real is None else y * real).sum(1, keepdim=True) / count)
        y = y if real is None else y.mul_(real)
        variance = y.square().sum(1, keepdim=True) / (count - 1).clamp_min(1)
        scale = torch.rsqrt(variance + CONTEXT_EPS)
        y = y.mul_(scale).to(x.dtype)
        ctx.save_for_backward(x, weight, y, scale, count, real)
        return y if skip is None else torch.relu(y).add_(skip)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        x, weight, y, scale, count, real = ctx.saved_tensors
        if count is None:
            dz = norm_gradient(gradient, y, scale, rectified=ctx.rectified)
        else:
            g = gradient.to(y.dtype)
            g = torch.ops.aten.threshold_backward(g, y, 0) if ctx.rectified else g
            g = g if real is None else g * real
            wide = y.to(scale.dtype)
            dz = g * wide
            along = dz.sum(1, keepdim=True) / (count - 1).clamp_min(1)
            mean = g.sum(1, keepdim=True, dtype=scale.dtype) / count
            torch.mul(wide, along, out=dz).add_(mean).sub_(g).mul_(-scale)
            dz = (dz if real is None else dz.mul_(real)).to(x.dtype)
        to_x, to_weight = ctx.needs_input_grad[:2]
        dx = pointwise(dz, weight.mT, None) if to_x else None
        dw = _weight_gradient(x, dz) if to_weight else None
        return dx, dw, torch.zeros_like(dz[0, 0]), None, gradient if ctx.rectified else None


class _Gram(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        ctx.save_for_backward(x)
        return _weight_gradient(x, x)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Tensor:
        (x,) = ctx.saved_tensors
        return pointwise(x, gradient + gradient.mT, None)


def gram(x: Float[Tensor, "b k c"]) -> Float[Tensor, "c c"]:
    """sum of x x^T over all points, by the kernels of `pointwise`; one product for its gradient."""
    return _Gram.apply(x)


def _weight_gradient(x: Float[Tensor, "b k c"], dz: Float[Tensor, "b k d"]) -> Float[Tensor, "d c"]:
    """sum of dz x^T over all points, by the kernels of `pointwise`."""
    if not x.is_cpu or x.dtype == torch.float64:
        return dz.flatten(0, 1).mT @ x.flatten(0, 1)
    size = (dz.shape[-1], x.shape[-1], 1, 1)
    return conv2d_weight(_images(x), size, _images(dz))[..., 0, 0]
