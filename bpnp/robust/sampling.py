"""Minimal samples of candidate pairs: triples drawn uniformly, from a growing pool, or pairs in proportion to a weight.

The random numbers are a hash of a seed and a counter. They are the same on every device and for every sample of a
batch, so that a pose depends neither on the other samples nor on padding.
"""

import torch
from jaxtyping import Float, Int
from torch import Tensor

SMALLEST_POOL = 16  # pairs of largest weight, from which the first triples of a growing pool are drawn


def growing_pool(count: Int[Tensor, " b"], draws: int) -> Float[Tensor, "b d"]:
    """Size of the pool of each draw: it grows geometrically from SMALLEST_POOL to `count`.

    The order of growth is that of PROSAC (Chum, Matas, CVPR 2005): pairs of large weight are tried first.
    """
    progress = (torch.arange(draws, device=count.device, dtype=torch.float64) + 0.5) / draws
    last = count.clamp(min=3).unsqueeze(-1).double()
    first = last.clamp(max=SMALLEST_POOL)
    return (first * (last / first) ** progress).ceil()


def distinct_triples(pool: Float[Tensor, "b d"], seed: int, *, skip: int = 0) -> Int[Tensor, "b d 3"]:
    """Three different indices below the pool size of each draw, uniform and in random order.

    skip: draws of earlier calls with this seed; their random numbers are not used again.
    """
    draws = pool.shape[1]
    uniform = hashed_uniform(3 * draws, seed, pool.device, skip=3 * skip).view(3, draws)
    first, second, third = ((uniform[i] * (pool - i)).long() for i in range(3))
    # A draw from pool - i numbers skips the i numbers already taken.
    second = second + (second >= first)
    third = third + (third >= torch.minimum(first, second))
    third = third + (third >= torch.maximum(first, second))
    return torch.stack([first, second, third], -1)


def weighted_draws(weights: Float[Tensor, "b k"], count: int, seed: int) -> Int[Tensor, "b c"]:
    """Indices drawn with replacement in proportion to the weights, which are not negative and not all zero."""
    total = weights.double().cumsum(-1)
    uniform = hashed_uniform(count, seed, weights.device)
    # The first sum above the number drawn: never an index of weight zero.
    return torch.searchsorted(total, uniform * total[:, -1:], right=True).clamp(max=weights.shape[1] - 1)


def hashed_uniform(size: int, seed: int, device: torch.device, *, skip: int = 0) -> Float[Tensor, " k"]:
    """float64 in (0, 1): a 32-bit integer hash (two multiplications and shifts) of the counter and the seed."""
    state = torch.arange(skip, skip + size, device=device)
    for salt in (0, (seed * 0x9E3779B1 + 1) & 0xFFFFFFFF):
        state = (state + salt) & 0xFFFFFFFF
        for shift, factor in ((16, 0x21F0AAAD), (15, 0x735A2D97)):
            state = ((state ^ (state >> shift)) * factor) & 0xFFFFFFFF
        state = state ^ (state >> 15)
    return (state + 0.5) / 2.0**32


def take(values: Tensor, index: Int[Tensor, "b k"]) -> Tensor:
    """values[b, index[b, i], ...] for every sample b."""
    trailing = values.shape[2:]
    return values.gather(1, index.view(*index.shape, *(1 for _ in trailing)).expand(*index.shape, *trailing))
