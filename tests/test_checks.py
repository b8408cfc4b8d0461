from typing import Any

import pytest
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from bpnp.checks import checked_shapes


@checked_shapes
def shape_of(
    cost: Float[Tensor, "b m n"],
    points2d: Float[Tensor, "b m 2"],
    *,
    mask2d: Bool[Tensor, "b m"] | None = None,
    index: Int[Tensor, " b"] | None = None,
    weights: Float[Tensor, "*b m"] | None = None,
    seed: int = 0,
) -> Float[Tensor, "b n"]:
    """Shape of `cost`."""
    return torch.tensor(cost.shape)


COST, POINTS = torch.zeros(3, 4, 5), torch.zeros(3, 4, 2)


def test_arguments_that_fit_their_annotations_pass_through() -> None:
    assert shape_of(COST, POINTS).tolist() == [3, 4, 5]
    mask2d, index = torch.ones(3, 4, dtype=torch.bool), torch.arange(3, dtype=torch.int32)
    assert shape_of(COST.half(), points2d=POINTS.double(), mask2d=mask2d, index=index, seed=1).tolist() == [3, 4, 5]
    assert shape_of(COST, POINTS, weights=torch.ones(7)).tolist() == [3, 4, 5]  # a variable number of axes
    assert shape_of.__doc__ == "Shape of `cost`."


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"cost": COST[0]}, r"expected `cost` of shape \(b, m, n\), got \(4, 5\); try .unsqueeze\(0\)"),
        ({"cost": COST[None]}, r"expected `cost` of shape \(b, m, n\), got \(1, 3, 4, 5\)$"),
        ({"points2d": torch.zeros(3, 4, 3)}, r"expected `points2d` of shape \(b, m, 2\), got \(3, 4, 3\)"),
        ({"points2d": torch.zeros(3, 9, 2)}, r"of shape \(b, m, 2\) with m = 4 as in `cost`, got \(3, 9, 2\)"),
        ({"points2d": torch.zeros(2, 4, 2)}, r"with b = 3 as in `cost`, got \(2, 4, 2\)"),
        ({"cost": COST[:0], "points2d": POINTS[:0]}, r"expected `cost` .* no empty axis, got \(0, 4, 5\)"),
        ({"cost": COST.long()}, r"expected `cost` of type float, got torch.int64; try .float\(\)"),
        ({"mask2d": torch.ones(3, 4)}, r"expected `mask2d` of type bool, got torch.float32; try .bool\(\)"),
        ({"index": torch.ones(3, 4)}, r"expected `index` of shape \(b,\), got \(3, 4\)"),
        ({"cost": COST.numpy()}, r"expected `cost` as a tensor of shape \(b, m, n\), got ndarray"),
        ({"cost": None}, r"expected `cost` as a tensor of shape \(b, m, n\), got NoneType"),
    ],
)
def test_what_does_not_fit_is_named(changed: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        shape_of(**{"cost": COST, "points2d": POINTS, **changed})
