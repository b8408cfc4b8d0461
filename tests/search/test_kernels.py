"""The compiled loops against the formulas of docs/search.md in float64, finite differences, and each other."""

from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.distance import cdist

from bpnp.geometry import random_rotations, retract
from bpnp.search.kernels.dense import POWER, assign, dense_scratch, normal_equations
from bpnp.search.kernels.sides import WeightedBearings, WeightedPoints
from bpnp.search.kernels.sparse import REACH, Tiles, assign_sparse, build_tiles, sparse_scratch

FORWARD = np.array([0.0, 0.0, 1.0])


class View:
    """60 points of unit extent that fill `spread` radians, 50 of them and 10 outliers as bearings."""

    def __init__(self, spread: float, seed: int = 0) -> None:
        rng = np.random.default_rng(seed)
        self.rotation = random_rotations(1, torch.Generator().manual_seed(seed))[0].double().numpy()
        self.translation = np.array([0.1, -0.05, 1.4 / spread])
        self.points = rng.normal(size=(60, 3)) * 0.8
        seen = self.directions()[:50] + 0.02 * spread * rng.normal(size=(50, 3))
        lost = FORWARD + spread * np.column_stack([rng.normal(size=(10, 2)), np.zeros(10)])
        self.bearings = np.concatenate([seen, lost])
        self.bearings /= np.linalg.norm(self.bearings, axis=-1, keepdims=True)
        self.offsets = np.ascontiguousarray((self.bearings - FORWARD).T.astype(np.float32))
        self.a, self.b = (rng.uniform(0.5, 2, 60).astype(np.float32) for _ in range(2))

    def directions(self) -> np.ndarray:
        camera = self.points @ self.rotation.T + self.translation
        return camera / np.linalg.norm(camera, axis=-1, keepdims=True)

    def pose(self) -> tuple[np.ndarray, np.ndarray]:
        return self.rotation.astype(np.float32), self.translation.astype(np.float32)

    def sides(
        self, a: np.ndarray | None = None, b: np.ndarray | None = None
    ) -> tuple[WeightedBearings, WeightedPoints]:
        """Both sides with these weights, 1 by default, any labels, and points that are seen from everywhere."""
        one, free = np.ones(60, np.float32), np.full(60, -1, np.int32)
        points, everything = self.points.T.astype(np.float32).copy(), np.array([[0, 60, 0, 60]], np.uintp)
        return (
            WeightedBearings(self.offsets, one if a is None else a, one, free),
            WeightedPoints(points, one if b is None else b, one, free, everything, np.empty((6, 0), np.float32)),
        )

    def tiles(self, largest: float) -> Tiles:
        return build_tiles(self.sides()[0]).with_margin(largest)


@pytest.mark.parametrize("spread", [0.5, 0.1, 0.01, 0.0008])
@pytest.mark.parametrize("relative", [0.3, 0.05])
def test_the_assignment_on_clusters_is_the_product_form(entry: Any, spread: float, relative: float) -> None:
    view, scale, outlier = View(spread), relative * spread, 0.07
    scratch = dense_scratch(60, 60)
    scratch.weight[:] = view.b
    likelihood = entry(assign)(
        *view.sides(view.a, view.b), *view.pose(), np.float32(scale), np.float32(outlier), scratch
    )
    q = scratch.q
    a, b, u = view.a.astype(float), view.b.astype(float), view.directions()
    k = np.maximum(1 - cdist(view.bearings, u, "sqeuclidean") / (2 * scale**2 * POWER), 0) ** POWER
    row = k @ b + outlier * b.sum()
    weight = (a[:, None] * k / row[:, None]) * (k * b / (a @ k + outlier * a.sum()))
    assert likelihood == pytest.approx((a * np.log(row / (b.sum() * scale**2))).sum() / a.sum(), abs=2e-3)
    np.testing.assert_allclose(q[3], weight.sum(0), rtol=0.01, atol=1e-3)
    residual = weight.T @ view.bearings - weight.sum(0)[:, None] * u
    np.testing.assert_allclose(q[:3].T, residual, atol=2e-3 * scale * max(1.0, weight.sum(0).max()))


@pytest.mark.parametrize("spread", [0.5, 0.01, 0.0008])
def test_the_likelihood_on_tiles_is_the_mixture_and_close_to_that_on_clusters(entry: Any, spread: float) -> None:
    view, scale, outlier = View(spread), 0.05 * spread, 0.002
    tiles, sides = view.tiles(scale), view.sides()
    sparse, dense = sparse_scratch(tiles, 60), dense_scratch(60, 60)
    sparse.weight[:] = dense.weight[:] = 1
    at = *view.pose(), np.float32(scale), np.float32(outlier)
    likelihood, matched, _ = entry(assign_sparse)(tiles, sides[1], *at, sparse)
    squared = cdist(view.bearings, view.directions(), "sqeuclidean")
    k = np.where(squared < (REACH * scale) ** 2, np.exp(-squared / (2 * scale**2)), 0)
    assert likelihood == pytest.approx(np.log((k.mean(1) + outlier) / scale**2).mean(), abs=2e-3)
    assert 0.5 < matched < 50 / 60 + 0.05
    assert entry(assign)(*sides, *at, dense) == pytest.approx(likelihood, abs=0.1)


@pytest.mark.parametrize("spread", [0.5, 0.01])
def test_the_gradient_is_that_of_finite_differences(entry: Any, spread: float) -> None:
    view = View(spread)
    rng = np.random.default_rng(1)
    total, u = rng.uniform(0.5, 1, 60), view.directions()
    residual = 0.1 * spread * rng.normal(size=(60, 3))
    weighted = residual + total[:, None] * u  # sum_i W_ij f_i
    system, points = np.zeros((8, 6)), np.ascontiguousarray(view.points.T)
    entry(normal_equations)(np.vstack([residual.T, total]), points, view.rotation, view.translation, system)
    hessian, gradient = np.tril(system[:6]), system[6]
    depth = float(view.translation[2])
    for k in range(6):
        step = torch.zeros(6, dtype=torch.float64)
        step[k] = 1e-5 * (depth if k == 5 else 1)
        values = []
        for sign in (1, -1):
            r, t = retract(sign * step, torch.as_tensor(view.rotation), torch.as_tensor(view.translation))
            camera = view.points @ r.numpy().T + t.numpy()
            values.append((weighted * (camera / np.linalg.norm(camera, axis=-1, keepdims=True) - u)).sum())
        slope = (values[0] - values[1]) / (2 * float(step[k]))
        assert gradient[k] == pytest.approx(slope, rel=1e-4, abs=1e-6 * np.abs(gradient).max() * spread)
    assert np.linalg.eigvalsh(hessian + np.tril(hessian, -1).T).min() > 0
