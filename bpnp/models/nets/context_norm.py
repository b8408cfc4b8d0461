"""The context norm (Yi et al. 2018) of padded sets and its gradient, a set at a time while it is in the cache.

y = (z - mean) / sqrt(var + 1e-3) over the points of each set, per channel, with the unbiased variance, zero for a set
of one point; padded points have y = 0. Its gradient is dL/dz = (g - mean(g) - y sum(g y) / (count - 1)) / sqrt(var +
1e-3) for the gradient g of y. Float32 on the CPU goes through a compiled loop, all else and traced graphs through
torch; both add up in the same order and give the same digits.
"""

from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from bpnp.compilation import compiler, in_threads

CONTEXT_EPS = 1e-3  # as in the released code
GROUP = 16  # terms that torch adds up at a time, in float32; so many such sums are again added up at a time
LEVELS = 4
compiled = compiler(error_model="numpy")


def context_norm_(
    z: Float[Tensor, "b k c"], real: Float[Tensor, "b k"] | None, skip: Float[Tensor, "b k c"] | None = None
) -> tuple[Tensor, Float[Tensor, "b 1 c"], Tensor]:
    """y, which may be written over z, 1 / sqrt(var + 1e-3), and skip + relu(y), which is y itself without `skip`.

    real: 1 for a real point and 0 for a padded one; None: all are real.
    """
    if applies_to(z):
        z = z.contiguous()
        scale = z.new_empty(len(z), 1, z.shape[2])
        out = z if skip is None else torch.empty_like(z)
        arrays = [_array(x) for x in (z, _weights(z, real), z if skip is None else skip, out, scale)]
        in_threads(lambda first, last: _normalise(first, last, skip is not None, *arrays), len(z))
        return z, scale, out
    count, weight = _count(z, real)
    z.sub_((z if weight is None else z * weight).sum(1, keepdim=True) / count)
    z = z if weight is None else z.mul_(weight)
    scale = torch.rsqrt(z.square().sum(1, keepdim=True) / (count - 1).clamp_min(1) + CONTEXT_EPS)
    z = z.mul_(scale)
    return z, scale, z if skip is None else torch.relu(z).add_(skip)


def context_norm_gradient(
    gradient: Float[Tensor, "b k c"],
    y: Float[Tensor, "b k c"],
    scale: Float[Tensor, "b 1 c"],
    real: Float[Tensor, "b k"] | None,
    *,
    rectified: bool,
) -> Float[Tensor, "b k c"]:
    """dL/dz from that of y, or of relu(y) where `rectified`."""
    if applies_to(gradient):
        dz = torch.empty_like(y)
        arrays = [_array(x) for x in (gradient, y, scale, _weights(y, real), dz)]
        in_threads(lambda first, last: _differentiate(first, last, rectified, *arrays), len(y))
        return dz
    count, weight = _count(y, real)
    g = torch.ops.aten.threshold_backward(gradient, y, 0) if rectified else gradient
    g = g if weight is None else g * weight
    dz = g * y
    along = dz.sum(1, keepdim=True) / (count - 1).clamp_min(1)
    torch.mul(y, along, out=dz).add_(g.sum(1, keepdim=True) / count).sub_(g).mul_(-scale)
    return dz if weight is None else dz.mul_(weight)


def applies_to(x: Tensor) -> bool:
    """Whether the compiled loops can read this tensor."""
    return x.is_cpu and x.dtype == torch.float32 and not torch.compiler.is_compiling()


def _array(x: Tensor) -> np.ndarray:
    return x.detach().contiguous().numpy()


def _weights(x: Tensor, real: Tensor | None) -> Tensor:
    return x.new_ones(x.shape[:2]) if real is None else real


def _count(x: Tensor, real: Tensor | None) -> tuple[Tensor, Tensor | None]:
    """Number of real points (b or 1, 1, 1), and the weights of the points (b, k, 1)."""
    if real is None:
        return x.new_full((1, 1, 1), x.shape[1]), None
    return real.sum(1, keepdim=True).unsqueeze(2), real.unsqueeze(2)


@compiled
def _normalise(start: int, stop: int, rectified: bool, z: Any, real: Any, skip: Any, out: Any, scale: Any) -> None:
    """Sets start to stop of z (b, k, c), in place; real (b, k), skip (b, k, c) -> out (b, k, c), scale (b, 1, c)."""
    sums, value = np.zeros((LEVELS, z.shape[2]), np.float32), np.empty(z.shape[2], np.float32)
    one = np.float32(1)
    for s in range(start, stop):
        count = real[s].sum()
        for i in range(z.shape[1]):
            weight = real[s, i]
            for j in range(z.shape[2]):
                sums[0, j] += z[s, i, j] * weight
            _carry(sums, i + 1)
        _total(sums, count, value)
        for i in range(z.shape[1]):
            weight = real[s, i]
            for j in range(z.shape[2]):
                centred = (z[s, i, j] - value[j]) * weight
                z[s, i, j] = centred
                sums[0, j] += centred * centred
            _carry(sums, i + 1)
        _total(sums, max(count - one, one), value)
        for j in range(z.shape[2]):
            scale[s, 0, j] = one / np.sqrt(value[j] + np.float32(CONTEXT_EPS))
        for i in range(z.shape[1]):
            for j in range(z.shape[2]):
                z[s, i, j] *= scale[s, 0, j]
            if rectified:
                for j in range(z.shape[2]):
                    y = z[s, i, j]
                    out[s, i, j] = (np.float32(0) if y <= 0 else y) + skip[s, i, j]


@compiled
def _differentiate(
    start: int, stop: int, rectified: bool, gradient: Any, y: Any, scale: Any, real: Any, dz: Any
) -> None:
    """Sets start to stop: gradient, y (b, k, c), scale (b, 1, c), real (b, k) -> dz (b, k, c)."""
    channels = y.shape[2]
    sums, products = np.zeros((LEVELS, channels), np.float32), np.zeros((LEVELS, channels), np.float32)
    mean, along = np.empty(channels, np.float32), np.empty(channels, np.float32)
    zero, one = np.float32(0), np.float32(1)
    lowest = zero if rectified else np.float32(-np.inf)
    for s in range(start, stop):
        count = real[s].sum()
        for i in range(y.shape[1]):
            weight = real[s, i]
            for j in range(channels):
                dz[s, i, j] = (zero if y[s, i, j] <= lowest else gradient[s, i, j]) * weight
            for j in range(channels):
                sums[0, j] += dz[s, i, j]
            for j in range(channels):
                products[0, j] += dz[s, i, j] * y[s, i, j]
            _carry(sums, i + 1)
            _carry(products, i + 1)
        _total(sums, count, mean)
        _total(products, max(count - one, one), along)
        for i in range(y.shape[1]):
            weight = real[s, i]
            for j in range(channels):
                dz[s, i, j] = ((y[s, i, j] * along[j] + mean[j]) - dz[s, i, j]) * -scale[s, 0, j]
            for j in range(channels):
                dz[s, i, j] *= weight


@compiled
def _carry(sums: Any, terms: int) -> None:
    """Add each level of sums (LEVELS, c) that has its `GROUP` terms to the next one; terms: added to the first."""
    level = 0
    while level < LEVELS - 1 and terms % GROUP == 0:
        for j in range(sums.shape[1]):
            sums[level + 1, j] += sums[level, j]
            sums[level, j] = 0
        terms //= GROUP
        level += 1


@compiled
def _total(sums: Any, count: Any, mean: Any) -> None:
    """mean (c,) = all levels of sums (LEVELS, c) / count; sums becomes zero."""
    for j in range(sums.shape[1]):
        mean[j] = (((sums[0, j] + sums[1, j]) + sums[2, j]) + sums[3, j]) / count
    sums[:] = 0
