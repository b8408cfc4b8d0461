"""The layers keep their digits whatever precision the user chose for products, and do not change that choice."""

from collections.abc import Iterator
from typing import Any

import pytest
import torch
from planted import plant
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from bpnp.layers import sinkhorn, weighted_pnp
from bpnp.models.bpnpnet import pairwise_distance
from bpnp.precision import exact_products

pytestmark = pytest.mark.slow

PRODUCTS = {torch.ops.aten.mm, torch.ops.aten.bmm, torch.ops.aten.addmm, torch.ops.aten.baddbmm}


class TensorFloat32(TorchDispatchMode):
    """Round the factors of float32 products to TF32's 10 bits of mantissa, as such a GPU does at "high"."""

    def __init__(self) -> None:
        super().__init__()
        self.rounded = 0

    def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if function.overloadpacket in PRODUCTS and torch.get_float32_matmul_precision() != "highest":
            self.rounded += any(isinstance(x, Tensor) and x.dtype == torch.float32 for x in args)
            args = tuple(self.round(x) if isinstance(x, Tensor) else x for x in args)
        return function(*args, **(kwargs or {}))

    @staticmethod
    def round(x: Tensor) -> Tensor:
        if x.dtype != torch.float32:
            return x
        bits = x.contiguous().view(torch.int32)
        return ((bits + (1 << 12)) & ~((1 << 13) - 1)).view(torch.float32)


@pytest.fixture
def high() -> Iterator[None]:
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision("high")
    yield
    torch.set_float32_matmul_precision(before)


def features() -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(0)
    a = torch.nn.functional.normalize(torch.randn(2, 40, 64, generator=generator), dim=-1)
    return a, torch.nn.functional.normalize(a + 0.002 * torch.randn(2, 40, 64, generator=generator), dim=-1)


@pytest.mark.usefixtures("high")
def test_layers_keep_their_digits() -> None:
    a, b = (x.requires_grad_() for x in features())
    planted = plant(2, 40, noise=0.002, dtype=torch.float32)
    start = planted.near(0.1)

    def results() -> list[Tensor]:
        cost = pairwise_distance(a, b)
        plan, _ = sinkhorn(cost, mu=0.05)
        rotation, translation, _ = weighted_pnp(plan, planted.bearings, planted.points3d, *start)
        gradients = torch.autograd.grad(plan.square().sum() + translation.sum(), (cost, a, b))
        return [*(x.detach() for x in (cost, plan, rotation, translation)), *gradients]

    expected = results()
    with TensorFloat32() as emulated:
        found = results()
        assert emulated.rounded == 0
        _ = a.detach() @ b.detach().mT
        assert emulated.rounded == 1
    for value, exact in zip(found, expected, strict=True):
        assert (value - exact).abs().max() < 1e-6 * exact.abs().max()
    assert torch.get_float32_matmul_precision() == "high"


@pytest.fixture
def switches() -> Iterator[tuple[Any, Any, Any]]:
    """The switches of all products, of those on CUDA and of those on the CPU; the last two follow the first."""
    every, cuda, cpu = torch.backends, torch.backends.cuda.matmul, torch.backends.mkldnn.matmul
    for one in (cuda, cpu):
        one.fp32_precision = "none"
    yield every, cuda, cpu
    for one in (every, cuda, cpu):
        one.fp32_precision = "none"


def test_a_switch_that_followed_the_general_one_still_does(switches: tuple[Any, Any, Any]) -> None:
    every, *each = switches
    every.fp32_precision = "tf32"
    with exact_products(torch.device("cpu")):
        assert [one.fp32_precision for one in each] == ["ieee", "ieee"]
    assert [one.fp32_precision for one in each] == ["tf32", "tf32"]
    every.fp32_precision = "ieee"
    assert [one.fp32_precision for one in each] == ["ieee", "ieee"]


def test_a_switch_of_its_own_is_restored(switches: tuple[Any, Any, Any]) -> None:
    every, cuda, cpu = switches
    every.fp32_precision, cpu.fp32_precision = "tf32", "bf16"
    with exact_products(torch.device("cpu")):
        assert (cuda.fp32_precision, cpu.fp32_precision) == ("ieee", "ieee")
    assert (cuda.fp32_precision, cpu.fp32_precision) == ("tf32", "bf16")
