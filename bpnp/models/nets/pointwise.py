"""One linear map for all points of a padded set, and the same followed by the context norm (Yi et al. 2018).

On the CPU the norm of a training is compiled: the passes over a set one after the other while the set is in the cache,
where torch makes each pass over the whole batch, through memory. Sets are divided among torch's threads. Sums are in
the precision of the data over an eighth of a set and in float64 beyond.
"""

from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.autograd.function import once_differentiable
from torch.nn.grad import conv2d_weight

from bpnp.loops.compilation import FAST, compiler
from bpnp.loops.parallel import in_threads

compiled, part = compiler(fastmath=FAST), compiler(fastmath=FAST, no_cpython_wrapper=True, _nrt=False)
AT_ONCE = 8  # points: a loop over the channels of one would be short


def normalise(
    z: Float[Tensor, "b k c"], skip: Float[Tensor, "b k c"] | None, eps: float
) -> tuple[Float[Tensor, "b 1 c"], Float[Tensor, "b k c"]]:
    """z becomes y = scale (z - mean) with scale = 1 / sqrt(var + eps). Returns scale, and y or skip + relu(y)."""
    scale = z.new_empty(len(z), 1, z.shape[2])
    result = z if skip is None else torch.empty_like(z)
    added = z[:0] if skip is None else skip.detach().contiguous()
    arrays = [value.numpy() for value in (z, scale, added, result)]
    in_threads(lambda first, last: _normalise(first, last, eps, *arrays), len(z))
    return scale, result


def norm_gradient(
    incoming: Float[Tensor, "b k c"], y: Float[Tensor, "b k c"], scale: Float[Tensor, "b 1 c"], *, rectified: bool
) -> Float[Tensor, "b k c"]:
    """dL/dz from dL/dy or, if rectified, from dL/drelu(y)."""
    result = torch.empty_like(y)
    arrays = [value.numpy() for value in (incoming.contiguous(), y, scale, result)]
    in_threads(lambda first, last: _gradient(first, last, 0.0 if rectified else -np.inf, *arrays), len(y))
    return result


@compiler(fastmath=FAST, no_cpython_wrapper=True)
def _zeros(count: int, like: Any) -> Any:
    """Zeros that begin with a cache line: stores that cross two take longer."""
    values = np.zeros(count + 64, like.dtype)
    first = -values.ctypes.data % 64 // values.itemsize
    return values[first : first + count]


@compiled
def _normalise(start: int, stop: int, eps: float, z: Any, scale: Any, skip: Any, result: Any) -> None:
    """Sets start to stop of z, skip, result (b, k, c), scale (b, 1, c); an empty skip leaves the result as it is."""
    k, c = z.shape[1:]
    size, wide = k * c, AT_ONCE * c
    total, short = np.zeros(c), _zeros(wide, z)
    mean, factor = _zeros(wide, z), _zeros(wide, z)
    for s in range(start, stop):
        x = z[s].reshape(size)
        for i in range(0, size, wide):
            _add(x[i : i + wide], short)
        _fold(short, total, 1 / k, mean)
        for i in range(0, size, wide):
            _add_squares(x[i : i + wide], mean, short)
        _fold(short, total, 1 / max(k - 1, 1), factor)
        for j in range(wide):
            factor[j] = 1 / np.sqrt(factor[j] + eps)
        scale[s, 0] = factor[:c]
        for i in range(0, size, wide):
            _scale(x[i : i + wide], mean, factor)
        if len(skip):
            added, out = skip[s].reshape(size), result[s].reshape(size)
            for i in range(0, size, wide):
                _rectify(x[i : i + wide], added[i : i + wide], out[i : i + wide])


@compiled
def _gradient(start: int, stop: int, floor: float, incoming: Any, y: Any, scale: Any, result: Any) -> None:
    """Sets start to stop of incoming, y, result (b, k, c), scale (b, 1, c). What comes in counts where y > floor."""
    k, c = y.shape[1:]
    size, wide = k * c, AT_ONCE * c
    total, short, along = np.zeros(c), _zeros(wide, y), _zeros(wide, y)
    mean, slope, factor = _zeros(wide, y), _zeros(wide, y), _zeros(wide, y)
    floor = y.dtype.type(floor)
    for s in range(start, stop):
        g, x, out = incoming[s].reshape(size), y[s].reshape(size), result[s].reshape(size)
        for i in range(0, size, wide):
            _add_products(g[i : i + wide], x[i : i + wide], floor, short, along)
        _fold(short, total, 1 / k, mean)
        _fold(along, total, 1 / max(k - 1, 1), slope)
        for j in range(wide):
            factor[j] = scale[s, 0, j % c]
        for i in range(0, size, wide):
            _pull_back(g[i : i + wide], x[i : i + wide], floor, mean, slope, factor, out[i : i + wide])


@part
def _fold(short: Any, total: Any, weight: float, repeated: Any) -> None:
    """The sums of each channel (c,) in `short` (a multiple of c,), times a weight, once for each point in `repeated`.

    short, total: zero afterwards.
    """
    c = len(total)
    for j in range(len(short)):
        total[j % c] += short[j]
        short[j] = 0
    for j in range(len(short)):
        repeated[j] = weight * total[j % c]
    total[:] = 0


@part
def _add(x: Any, short: Any) -> None:
    for j in range(len(x)):
        short[j] += x[j]


@part
def _add_squares(x: Any, mean: Any, short: Any) -> None:
    for j in range(len(x)):
        short[j] += (x[j] - mean[j]) ** 2


@part
def _scale(x: Any, mean: Any, factor: Any) -> None:
    for j in range(len(x)):
        x[j] = (x[j] - mean[j]) * factor[j]


@part
def _rectify(x: Any, added: Any, out: Any) -> None:
    zero = x.dtype.type(0)
    for j in range(len(x)):
        out[j] = added[j] + max(x[j], zero)


@part
def _add_products(g: Any, y: Any, floor: float, short: Any, along: Any) -> None:
    zero = y.dtype.type(0)
    for j in range(len(g)):
        passed = g[j] if y[j] > floor else zero
        short[j] += passed
        along[j] += passed * y[j]


@part
def _pull_back(g: Any, y: Any, floor: float, mean: Any, slope: Any, factor: Any, out: Any) -> None:
    zero = y.dtype.type(0)
    for j in range(len(g)):
        passed = g[j] if y[j] > floor else zero
        out[j] = (passed - mean[j] - y[j] * slope[j]) * factor[j]


CONTEXT_EPS = 1e-3  # as in the authors' code


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
    def forward(ctx: Any, x: Tensor, weight: Tensor, bias: Tensor, mask: Tensor | None, skip: Tensor | None) -> Tensor:
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
