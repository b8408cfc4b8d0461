"""The context norm compiled for the CPU: the passes over a set one after the other while the set is in the cache.

torch makes each pass over the whole batch, through memory. Sets are divided among torch's threads. Sums are in the
precision of the data over an eighth of a set and in float64 beyond.
"""

from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

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
