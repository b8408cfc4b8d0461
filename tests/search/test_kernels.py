"""The compiled loops against the formulas of docs/search.md in float64, automatic differentiation, and each other."""

from functools import cache
from typing import Any

import numba
import numpy as np
import pytest
import torch
from scipy.spatial.distance import cdist

from bpnp.geometry import random_rotations, retract
from bpnp.search.kernels.dense import POWER, assign, dense_scratch, normal_equations
from bpnp.search.kernels.sides import WeightedBearings, WeightedPoints
from bpnp.search.kernels.sparse import KERNEL_REACH, assign_sparse, build_tiles, sparse_scratch

FORWARD = np.array([0.0, 0.0, 1.0])


@cache
def entry(function: Any) -> Any:
    """A function that Python can call of one that only compiled ones can."""
    return numba.njit(lambda *args: function(*args))


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


@pytest.mark.slow
@pytest.mark.parametrize("spread", [0.5, 0.1, 0.01, 0.0008])
@pytest.mark.parametrize("relative", [0.3, 0.05])
def test_the_assignment_on_clusters_is_the_product_form(spread: float, relative: float) -> None:
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


@pytest.mark.slow
@pytest.mark.parametrize("spread", [0.5, 0.01, 0.0008])
def test_the_likelihood_on_tiles_is_the_mixture_and_close_to_that_on_clusters(spread: float) -> None:
    view, scale, outlier = View(spread), 0.05 * spread, 0.002
    sides = view.sides()
    tiles = build_tiles(sides[0]).with_margin(scale)
    sparse, dense = sparse_scratch(tiles, 60), dense_scratch(60, 60)
    sparse.weight[:] = dense.weight[:] = 1
    at = *view.pose(), np.float32(scale), np.float32(outlier)
    likelihood, matched, _ = entry(assign_sparse)(tiles, sides[1], *at, sparse)
    squared = cdist(view.bearings, view.directions(), "sqeuclidean")
    k = np.where(squared < (KERNEL_REACH * scale) ** 2, np.exp(-squared / (2 * scale**2)), 0)
    assert likelihood == pytest.approx(np.log((k.mean(1) + outlier) / scale**2).mean(), abs=2e-3)
    assert 0.5 < matched < 50 / 60 + 0.05
    assert entry(assign)(*sides, *at, dense) == pytest.approx(likelihood, abs=0.1)


@pytest.mark.slow
@pytest.mark.parametrize("spread", [0.5, 0.01])
def test_gradient_and_hessian_are_those_of_the_objective(spread: float) -> None:
    """The Hessian is that of Gauss and Newton: the whole one where each sum points at its point."""
    view, rng, u = View(spread), np.random.default_rng(1), View(spread).directions()
    total, points = rng.uniform(0.5, 1, 60), np.ascontiguousarray(view.points.T)
    residual = 0.1 * spread * rng.normal(size=(60, 3))
    weighted = residual + total[:, None] * u  # sum_i W_ij f_i
    system, exact = np.zeros((8, 6)), np.zeros((8, 6))
    for rest, filled in ((residual, system), (0 * residual, exact)):
        q = np.vstack([rest.T, total])
        entry(normal_equations)(q, points, view.rotation, view.translation, filled)

    def value(step: torch.Tensor, sums: np.ndarray) -> torch.Tensor:
        r, t = retract(step, torch.as_tensor(view.rotation), torch.as_tensor(view.translation))
        camera = torch.as_tensor(view.points) @ r.T + t
        return (torch.as_tensor(sums) * torch.nn.functional.normalize(camera, dim=-1)).sum()

    def gradient(step: np.ndarray, sums: np.ndarray) -> np.ndarray:
        return torch.autograd.functional.jacobian(lambda s: value(s, sums), torch.as_tensor(step)).numpy()

    slope = gradient(np.zeros(6), weighted)
    np.testing.assert_allclose(system[6], slope, rtol=1e-6, atol=1e-8 * np.abs(slope).max())
    steps = 1e-4 * np.diag([1, 1, 1, *3 * [view.translation[2]]])
    ends = ([gradient(sign * step, total[:, None] * u) for step in steps] for sign in (1, -1))
    curvature = (np.subtract(*ends) / (-2 * np.diag(steps)[:, None])).T
    scale = np.sqrt(np.outer(np.diag(curvature), np.diag(curvature)))
    np.testing.assert_allclose(np.tril(exact[:6]) / scale, np.tril(curvature) / scale, atol=1e-5)
