from collections.abc import Iterator

import pytest
import torch
from torch import Tensor

from bpnp.layers import laplacian
from bpnp.layers.compiled import conjugate_gradients
from bpnp.layers.laplacian import solve_multipliers
from bpnp.layers.plan import Plan

LIMIT = 200


@pytest.fixture(params=[1, 3])
def threads(request: pytest.FixtureRequest) -> Iterator[int]:
    before = torch.get_num_threads()
    torch.set_num_threads(request.param)
    yield request.param
    torch.set_num_threads(before)


def plan(b: int, m: int, n: int, *, seed: int = 0) -> Tensor:
    p = torch.rand(b, m, n, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) ** 6
    return p / p.sum((-2, -1), keepdim=True)


def noise(*shape: int) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)


def laplacian_matrix(p: Tensor) -> Tensor:
    """S of every sample, formed."""
    return torch.diag_embed(p.sum(-2)) - p.mT @ (p / p.sum(-1, keepdim=True))


def solve(p: Tensor, rhs: Tensor, *, tolerance: float | Tensor = 1e-12) -> tuple[Tensor, Tensor, Tensor]:
    """S x = rhs with P = diag(alpha) K diag(beta) for some scalings."""
    alpha, beta = (0.5 + noise(*shape).abs() for shape in (p.shape[:2], (p.shape[0], p.shape[2])))
    alpha, beta = alpha.to(p), beta.to(p)
    kernel = p / alpha.unsqueeze(-1) / beta.unsqueeze(-2)
    degree = laplacian_matrix(p.double()).diagonal(dim1=-2, dim2=-1).to(p)
    bound = torch.zeros_like(rhs[:, 0]) + tolerance
    return conjugate_gradients(Plan(kernel, alpha, beta), p.sum(-1), p.sum(-2), degree, rhs, bound, LIMIT)


@pytest.mark.parametrize("shape", [(5, 30, 20), (3, 7, 9), (1, 3, 2)])
def test_solves_the_laplacian(shape: tuple[int, int, int], threads: int) -> None:
    p = plan(*shape)
    system = laplacian_matrix(p)
    rhs = (system @ noise(shape[0], shape[2], 1)).squeeze(-1)
    x, mean, solved = solve(p, rhs)
    assert solved.all()
    torch.testing.assert_close((system @ x.unsqueeze(-1)).squeeze(-1), rhs, atol=1e-12, rtol=1e-9)
    torch.testing.assert_close(mean, (p @ x.unsqueeze(-1)).squeeze(-1) / p.sum(-1), atol=1e-9, rtol=1e-9)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_iterations_in_torch_give_the_same(dtype: torch.dtype, monkeypatch: pytest.MonkeyPatch) -> None:
    """What other devices run."""
    p, v = plan(4, 40, 30).to(dtype), noise(4, 40, 30).to(dtype)
    v[1] = 0  # nothing to solve
    expected = solve_multipliers(p, v)
    monkeypatch.setattr("bpnp.layers.compiled.applies_to", lambda _tensor: False)
    called: list[bool] = []
    in_torch = laplacian.conjugate_gradients
    monkeypatch.setattr(laplacian, "conjugate_gradients", lambda *x: called.append(True) or in_torch(*x))
    digits = {"rtol": 1e-4, "atol": 1e-4} if dtype == torch.float32 else {"rtol": 1e-9, "atol": 1e-9}
    for found, value in zip(solve_multipliers(p, v), expected, strict=True):
        torch.testing.assert_close(found, value, **digits)
    assert expected[2].all()
    assert called
