"""Arguments that a layer cannot mean end in one clear error."""

from typing import Any

import jaxtyping
import pytest
import torch
from planted import plant

from bpnp.layers import sinkhorn, weighted_pnp


@pytest.fixture(autouse=True)
def as_users_run_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without the type checker of the tests."""
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)


@pytest.mark.parametrize(
    ("cost", "options", "message"),
    [
        (torch.rand(4, 5), {}, r"expected `cost` of shape \(b, m, n\), got \(4, 5\); try .unsqueeze\(0\)"),
        (torch.ones(2, 4, 5).long(), {}, r"expected `cost` of type float, got torch.int64; try .float\(\)"),
        (torch.rand(0, 4, 5), {}, r"`cost` of shape \(b, m, n\) with no empty axis, got \(0, 4, 5\)"),
        (torch.rand(2, 0, 5), {}, r"no empty axis, got \(2, 0, 5\)"),
        (
            torch.rand(2, 4, 5),
            {"mask2d": torch.ones(2, 5).bool()},
            r"`mask2d` of shape \(b, m\) with m = 4 as in",
        ),
        (torch.rand(2, 4, 5), {"col_marginal": torch.ones(5) / 5}, r"expected `col_marginal` of shape \(b, n\)"),
        (
            torch.rand(2, 4, 5),
            {"mask3d": torch.ones(1, 5).bool()},
            r"`mask3d` of shape \(b, n\) with b = 2 as in",
        ),
        (torch.rand(2, 4, 5), {"mu": torch.ones(2)}, r"expected `mu` as a number or a scalar tensor, got shape \(2,\)"),
        (torch.rand(2, 4, 5), {"dustbin": torch.ones(2, 1)}, "expected `dustbin` as a number or a scalar tensor"),
    ],
)
def test_sinkhorn_says_what_is_wrong(cost: torch.Tensor, options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        sinkhorn(cost, **options)


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("bearings", lambda x: x[..., :2], r"expected `bearings` of shape \(b, m, 3\), got \(2, 8, 2\)"),
        (
            "bearings",
            lambda x: x[:, 1:],
            r"`bearings` of shape \(b, m, 3\) with m = 8 as in `assignment`",
        ),
        ("points3d", lambda x: x[..., :2], r"expected `points3d` of shape \(b, n, 3\), got \(2, 8, 2\)"),
        ("points3d", lambda x: x.long(), "expected `points3d` of type float, got torch.int64"),
        ("assignment", lambda x: x[0], r"expected `assignment` of shape \(b, m, n\).*try .unsqueeze\(0\)"),
        ("assignment", lambda x: x[:0], "no empty axis"),
        ("rotation", lambda x: x[0], r"expected `rotation` of shape \(b, 3, 3\)"),
        (
            "translation",
            lambda x: x.unsqueeze(-1),
            r"expected `translation` of shape \(b, 3\), got \(2, 3, 1\)",
        ),
    ],
)
def test_weighted_pnp_says_what_is_wrong(name: str, change: Any, message: str) -> None:
    planted = plant(2, 8)
    rotation, translation = planted.near(0.1)
    arguments = {
        "assignment": planted.permutation(), "bearings": planted.bearings, "points3d": planted.points3d,
        "rotation": rotation, "translation": translation,
    }  # fmt: skip
    arguments[name] = change(arguments[name])
    with pytest.raises(ValueError, match=message):
        weighted_pnp(*arguments.values())
