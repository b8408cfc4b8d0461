"""The test pairs of a recipe, one at a time and in any order."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np
import yaml
from jsonargparse import ArgumentParser
from lightning import LightningDataModule

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
    return _parsed(data if isinstance(data, dict) else {"class_path": data}, overrides)


def with_outlier_ratio(data: dict[str, Any], ratio: float) -> dict[str, Any]:
    """The same data with `ratio` uniform outliers a true pair on both sides, at test time (rho of the paper)."""
    return data | {"init_args": data["init_args"] | {"test_outliers": {"ratio": ratio}}}


class TestPairs:
    """Test pairs in the fixed random order in which a limited table takes them."""

    __test__ = False  # no test case, whatever its name

    def __init__(self, data: dict[str, Any]) -> None:
        parser = _parser()
        module = parser.instantiate_classes(parser.parse_object({"data": data})).data
        module.setup("test")
        self._dataset = module.test_dataloader().dataset
        self.order = [int(i) for i in np.random.default_rng(ORDER_SEED).permutation(len(self._dataset))]

    def __getitem__(self, index: int) -> Batch:
        """A batch of the one pair at this position of the data set."""
        return cast(Batch, self._dataset[[(0, index)]])


def _parser() -> ArgumentParser:
    parser = ArgumentParser(exit_on_error=False)
    parser.add_subclass_arguments(LightningDataModule, "data")
    return parser


def _parsed(data: dict[str, Any], overrides: Sequence[str]) -> dict[str, Any]:
    parser = _parser()
    try:
        chosen = parser.parse_args([f"--data={json.dumps(data)}", *overrides])
    except Exception as error:
        reason = str(error).strip().splitlines()[-1].strip()
        raise ValueError(f"expected settings of {data.get('class_path')}, got {reason}") from error
    content = yaml.safe_load(parser.dump(chosen, skip_none=True, skip_validation=True))["data"]
    return {"class_path": content["class_path"], "init_args": content.get("init_args") or {}}
