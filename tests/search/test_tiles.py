"""Pairs of bearings in tiles and points near them, against all distances."""

from typing import Any

import numpy as np
import pytest
from scipy.spatial.distance import cdist

from bpnp.search.kernels.sides import WeightedBearings
from bpnp.search.kernels.sparse import (
    REACH,
    add_moments,
    add_to_bearings,
    add_to_points,
    build_tiles,
    meet,
    sort_points,
    sparse_scratch,
)


def offsets(rng: np.random.Generator, count: int, spread: float) -> np.ndarray:
    f = rng.normal(size=(count, 3)) * [spread, 0.5 * spread, 0] + [0, 0, 1]
    return np.ascontiguousarray((f / np.linalg.norm(f, axis=1, keepdims=True) - [0, 0, 1]).T, np.float32)


@pytest.mark.parametrize("count", [1, 16, 203])
@pytest.mark.parametrize("labelled", [False, True])
def test_pairs_are_all_that_are_within_reach(entry: Any, count: int, labelled: bool) -> None:
    rng, spread, scale, n = np.random.default_rng(count), 0.2, np.float32(0.01), 150
    f, u = offsets(rng, count, spread), offsets(rng, n, 1.2 * spread)
    labels2d, labels3d = (rng.integers(-1, 2 if labelled else 0, size=k).astype(np.int32) for k in (count, n))
    a = rng.uniform(0.5, 2, count).astype(np.float32)
    tiles = build_tiles(WeightedBearings(f, a, a, labels2d)).with_margin(float(scale))
    scratch = sparse_scratch(tiles, n)
    near, sums, row, column, q = scratch.near, scratch.sums, scratch.row, scratch.column, scratch.q
    entry(sort_points)(tiles, u, scratch.cells, scratch.start, scratch.order)
    assert entry(meet)(tiles, labels3d, u, scale, scratch.start, scratch.order, near)

    squared = cdist(f.T, u.T, "sqeuclidean")
    fits = (labels2d[:, None] == labels3d) | (labels2d[:, None] < 0) | (labels3d < 0)
    expected = np.where((squared < (REACH * scale) ** 2) & fits, np.exp(-squared / (2 * scale**2)), 0)
    values = rng.uniform(0.5, 1, n).astype(np.float32)
    entry(add_to_bearings)(values, near, sums)
    by_place = {
        tuple(at): total for at, total in zip(tiles.f.transpose(0, 2, 1).reshape(-1, 3), sums.ravel(), strict=True)
    }
    found = np.array([by_place[tuple(at)] for at in f.T])
    np.testing.assert_allclose(found, expected @ values, rtol=2e-3, atol=1e-4)
    row[:] = tiles.a
    entry(add_to_points)(row, near, column)
    np.testing.assert_allclose(column, a @ expected, rtol=2e-3, atol=1e-4)
    entry(add_moments)(tiles.f, u, row, values, near, q)
    weight = a[:, None] * expected * values
    residual = np.einsum("ij,ijc->cj", weight, f.T[:, None] - u.T)
    np.testing.assert_allclose(q, [*residual, weight.sum(0)], rtol=2e-3, atol=1e-4)
