"""Arguments that a layer cannot mean end in one clear error (`bpnp.checks` has the rules), whoever calls it and how."""

from collections.abc import Callable
from typing import Any

import jaxtyping
import pytest
import torch
from planted import plant

from bpnp.geometry import rotation_angle
from bpnp.layers import Sinkhorn, ransac_pnp, sinkhorn, weighted_pnp

PLANTED = plant(2, 8)
PAIRS = {"assignment": PLANTED.permutation(), "points3d": PLANTED.points3d}
START = dict(zip(("rotation", "translation"), PLANTED.near(0.1), strict=True))
ARGUMENTS: dict[Callable[..., Any], dict[str, Any]] = {
    sinkhorn: {"cost": torch.rand(2, 4, 5)},
    weighted_pnp: {**PAIRS, "bearings": PLANTED.bearings, **START},
    ransac_pnp: {**PAIRS, "points2d": PLANTED.points2d},
}


@pytest.fixture(autouse=True)
def as_users_run_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without the type checker of the tests."""
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)


@pytest.mark.parametrize(
    ("layer", "changed", "message"),
    [
        (sinkhorn, {"cost": torch.rand(4, 5)}, r"`cost` has the shape \(4, 5\), not \(b, m, n\); use .unsqueeze"),
        (sinkhorn, {"cost": torch.ones(2, 4, 5).long()}, r"`cost` has the type torch.int64, not float; use .float"),
        (
            sinkhorn,
            {"mask2d": torch.ones(2, 5).bool()},
            r"`mask2d` has the shape \(2, 5\), not \(b, m\) with m = 4 as in `cost`",
        ),
        (sinkhorn, {"col_marginal": torch.ones(5) / 5}, r"`col_marginal` has the shape \(5,\), not \(b, n\)"),
        (sinkhorn, {"mu": torch.ones(2)}, r"`mu` has the shape \(2,\); a number or a scalar tensor is needed"),
        (
            sinkhorn,
            {"dustbin": torch.ones(2, 1)},
            r"`dustbin` has the shape \(2, 1\); a number or a scalar tensor is needed",
        ),
        (sinkhorn, {"mu": 0.0}, "`mu` is 0.0; it must be above 0"),
        (
            sinkhorn,
            {"mask3d": torch.tensor([[True] * 5, [False] * 5])},
            "a sample has no real point in `mask3d`; every sample needs one on each side",
        ),
        (weighted_pnp, {"solver": "adam"}, "`solver` is 'adam'; it is one of newton, lbfgs"),
        (weighted_pnp, {"bearings": PLANTED.points2d}, r"`bearings` has the shape \(2, 8, 2\), not \(b, m, 3\)"),
        (weighted_pnp, {"bearings": PLANTED.bearings[:, 1:]}, r"`bearings` .* with m = 8 as in `assignment`"),
        (weighted_pnp, {"translation": torch.zeros(2, 3, 1)}, r"`translation` has the shape \(2, 3, 1\), not \(b, 3\)"),
        (ransac_pnp, {"points2d": PLANTED.bearings}, r"`points2d` has the shape \(2, 8, 3\), not \(b, m, 2\)"),
        (ransac_pnp, {"assignment": PAIRS["assignment"][:0]}, "no axis of \\(b, m, n\\) may be empty"),
        (ransac_pnp, {"points3d": PLANTED.points3d.numpy()}, "`points3d` is a ndarray; a tensor of shape"),
        (ransac_pnp, {"backend": "magsac"}, "`backend` is 'magsac'; it is one of auto, poselib, opencv, torch"),
        (ransac_pnp, {"matches_factor": 0.0}, "`matches_factor` is 0.0; it must be above 0"),
        (ransac_pnp, {"threshold": 0.0}, "`threshold` is 0.0; it must be above 0"),
        (ransac_pnp, {"max_iterations": 0}, "`max_iterations` is 0; it must be above 0"),
    ],
)
def test_wrong_arguments_of_a_layer_are_named(layer: Callable[..., Any], changed: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        layer(**ARGUMENTS[layer] | changed)


def test_a_module_refuses_an_entropy_weight_of_zero() -> None:
    with pytest.raises(ValueError, match="`mu` is 0.0; it must be above 0"):
        Sinkhorn(mu=0.0)


@pytest.mark.parametrize(("dtype", "found"), [(torch.float32, torch.float32), (torch.bfloat16, torch.float32)])
def test_half_precision_is_widened_and_ransac_has_no_gradient(dtype: torch.dtype, found: torch.dtype) -> None:
    assignment = PAIRS["assignment"].to(dtype).requires_grad_()
    rotation, translation, stats = ransac_pnp(assignment, points2d=PLANTED.points2d, points3d=PLANTED.points3d)
    assert rotation.dtype == translation.dtype == found
    assert not rotation.requires_grad
    assert stats.converged.all()
    assert rotation_angle(rotation.double(), PLANTED.rotation).max() < 1e-3


@pytest.mark.parametrize(
    ("layer", "options"),
    [
        *((layer, {}) for layer in ARGUMENTS),
        (weighted_pnp, {"clip_columns": 1.0}),
        (weighted_pnp, {"solver": "lbfgs"}),
        (ransac_pnp, {"backend": "torch"}),
    ],
    ids=lambda value: getattr(value, "__name__", str(value)),
)
def test_a_default_device_is_not_that_of_the_arguments(layer: Callable[..., Any], options: dict[str, Any]) -> None:
    """As after `torch.set_default_device("cuda")`, with arguments on the CPU."""
    arguments = {name: value.clone() for name, value in ARGUMENTS[layer].items()}
    if layer is not ransac_pnp:
        next(iter(arguments.values())).requires_grad_()
    expected = layer(**arguments, **options)
    with torch.device("meta"):
        found = layer(**arguments, **options)
        if layer is not ransac_pnp:
            found[0].sum().backward()
    assert found[0].equal(expected[0])
    assert found[-1].converged.equal(expected[-1].converged)


@pytest.mark.parametrize("transform", ["vmap", "grad", "jacrev", "jvp"])
@pytest.mark.parametrize("layer", list(ARGUMENTS), ids=lambda layer: layer.__name__)
def test_a_transform_of_torch_func_is_refused_in_one_line(layer: Callable[..., Any], transform: str) -> None:
    (name, first), *others = ARGUMENTS[layer].items()

    def run(values: torch.Tensor) -> torch.Tensor:
        values = values.unsqueeze(0) if transform == "vmap" else values
        rest = {key: value[:1] if transform == "vmap" else value for key, value in others}
        return layer(**{name: values, **rest})[0].sum()

    apply = {
        "vmap": lambda: torch.vmap(run)(first),
        "grad": lambda: torch.func.grad(run)(first),
        "jacrev": lambda: torch.func.jacrev(run)(first),
        "jvp": lambda: torch.func.jvp(run, (first,), (first,)),
    }
    with pytest.raises(ValueError, match=f"^{layer.__name__} does not support torch.func and torch.vmap; call it"):
        apply[transform]()


def test_layers_run_after_a_torch_func_transform() -> None:
    assert torch.vmap(lambda x: x + 1)(torch.zeros(2)).tolist() == [1, 1]
    assert sinkhorn(torch.rand(1, 4, 5))[1].converged.all()
