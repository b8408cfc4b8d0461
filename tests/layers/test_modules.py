"""A layer's module is its function: each option and each mask is passed on, and changes the result."""

from typing import Any

import pytest
import torch
from planted import plant
from torch import Tensor, nn

from bpnp.layers import RansacPnP, Sinkhorn, WeightedPnP, ransac_pnp, sinkhorn, weighted_pnp

PLANTED = plant(2, 30, noise=0.005, outliers2d=4, outliers3d=6, seed=6)
MASK2D, MASK3D = (torch.arange(size) < torch.tensor([[size], [size - 5]]) for size in (34, 36))
COST = torch.rand(2, 34, 36, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
MASKS = {"mask2d": MASK2D, "mask3d": MASK3D}
POINTS = {"points2d": PLANTED.points2d, "points3d": PLANTED.points3d}
# RANSAC gets matches that are wrong, so that many poses are equally good and each option decides.
LAYERS: dict[type[nn.Module], tuple[Any, dict[str, Tensor]]] = {
    Sinkhorn: (sinkhorn, {"cost": COST, **MASKS}),
    WeightedPnP: (
        weighted_pnp,
        {
            "assignment": PLANTED.diffuse(0.2),
            "bearings": PLANTED.bearings,
            "points3d": PLANTED.points3d,
            **dict(zip(("rotation", "translation"), PLANTED.near(0.2), strict=True)),
        },
    ),
    RansacPnP: (ransac_pnp, {"assignment": COST, **POINTS, **MASKS}),
}


def values(result: tuple[Any, ...]) -> Tensor:
    *tensors, stats = result
    return torch.cat([value.flatten().double() for value in (*tensors, stats.iterations, stats.residual)])


@pytest.mark.parametrize(
    ("layer", "options"),
    [
        *((layer, {}) for layer in LAYERS),
        *((Sinkhorn, {name: value}) for name, value in {"mu": 0.3, "dustbin": 0.5, "tolerance": 0.1}.items()),
        (Sinkhorn, {"max_iterations": 1}),
        *((WeightedPnP, {name: value}) for name, value in {"solver": "lbfgs", "tolerance": 0.1}.items()),
        (WeightedPnP, {"max_iterations": 1}),
        *((RansacPnP, {"backend": name}) for name in ("opencv", "torch")),
        (RansacPnP, {"threshold": 0.1, "max_iterations": 5}),
        (RansacPnP, {"backend": "torch", "threshold": 0.1, "max_iterations": 5, "seed": 3}),
        *((RansacPnP, {name: value}) for name, value in {"matches_factor": 4.0, "threshold": 0.1}.items()),
    ],
    ids=lambda value: value.__name__ if isinstance(value, type) else " ".join(value) or "defaults",
)
def test_a_module_is_its_function_with_its_options(layer: type[nn.Module], options: dict[str, Any]) -> None:
    """Without its last option, a module returns something else."""
    function, arguments = LAYERS[layer]
    found = values(layer(**options)(**arguments))
    assert torch.equal(found.nan_to_num(), values(function(**arguments, **options)).nan_to_num())
    without = dict(list(options.items())[:-1])
    assert bool(options) != torch.equal(found.nan_to_num(), values(layer(**without)(**arguments)).nan_to_num())
    for mask in arguments.keys() & MASKS.keys():
        unmasked = {name: value for name, value in arguments.items() if name != mask}
        assert not torch.equal(found.nan_to_num(), values(layer(**options)(**unmasked)).nan_to_num())


def test_a_learned_entropy_weight_begins_at_mu_and_has_the_derivative_of_its_logarithm() -> None:
    layer, weights = Sinkhorn(mu=0.2, learn_mu=True).double(), COST.flip(1)
    exact = {"tolerance": 1e-13}
    (layer(COST)[0] * weights).sum().backward()
    (log_mu,) = layer.parameters()
    high, low = ((sinkhorn(COST, mu=0.2 + step, **exact)[0] * weights).sum() for step in (1e-5, -1e-5))
    assert layer.entropy.item() == pytest.approx(0.2)
    assert log_mu.grad is not None
    assert float(log_mu.grad) == pytest.approx(0.2 * float(high - low) / 2e-5, rel=1e-4)
