"""The test pairs of a recipe, one at a time and in any order."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np
import yaml
from lightning import LightningDataModule

from bpnp.table.settings import build, checked
from bpnp.types import Batch

ORDER_SEED = 0  # of the order in which `--limit` takes pairs: the same for every method, and longer tables only add


def read_data(recipe: Path, overrides: Sequence[str]) -> dict[str, Any]:
    """`data` of a recipe's YAML with `--data.NAME=VALUE` overrides, as class_path and init_args.

    Raises ValueError for a file without it, or for what its class does not accept.
    """
    if not recipe.is_file():
        raise FileNotFoundError(f"expected a recipe with `data`, got no file {recipe}; try configs/psb.yaml")
    data = (yaml.safe_load(recipe.read_text(encoding="utf-8")) or {}).get("data")
    if not data:
        raise ValueError(f"expected `data` in {recipe}, got none; try configs/psb.yaml")
    return checked(LightningDataModule, "data", data if isinstance(data, dict) else {"class_path": data}, overrides)


def with_outlier_ratio(data: dict[str, Any], ratio: float) -> dict[str, Any]:
    """The same data with `ratio` uniform outliers a true pair on both sides, at test time.

    Raises ValueError for data that have no such option.
    """
    harder = data | {"init_args": data["init_args"] | {"test_outliers": {"ratio": ratio}}}
    return checked(LightningDataModule, "data", harder)


class TestPairs:
    """Test pairs in the fixed random order in which a limited table takes them."""

    __test__ = False  # no test case, whatever its name

    def __init__(self, data: dict[str, Any]) -> None:
        module = build(LightningDataModule, "data", data)
        module.setup("test")
        self._dataset = module.test_dataloader().dataset
        self.order = [int(i) for i in np.random.default_rng(ORDER_SEED).permutation(len(self._dataset))]

    def __getitem__(self, index: int) -> Batch:
        """A batch of the one pair at this position of the data set."""
        return cast(Batch, self._dataset[[(0, index)]])
