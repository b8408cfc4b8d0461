"""The test pairs of a recipe in the order of a limited table; objects from class paths and settings."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from jsonargparse import ArgumentParser
from lightning import LightningDataModule

ORDER_SEED = 0  # of the order in which `--limit` takes pairs: the same for every method, and longer tables only add


def read_data(recipe: Path, overrides: Sequence[str]) -> dict[str, Any]:
    """`data` of a recipe's YAML with `--data.NAME=VALUE` overrides, as class_path and init_args.

    Raises ValueError for a file without it, or for what its class does not accept.
    """
    if not recipe.is_file():
        raise FileNotFoundError(f"expected a recipe with `data`, got no file {recipe}; try --data psb")
    data = (yaml.safe_load(recipe.read_text(encoding="utf-8")) or {}).get("data")
    if not data:
        raise ValueError(f"expected `data` in {recipe}, got none; try --data psb")
    return checked(LightningDataModule, "data", data if isinstance(data, dict) else {"class_path": data}, overrides)


def with_outlier_ratio(data: dict[str, Any], ratio: float) -> dict[str, Any]:
    """The same data with `ratio` uniform outliers a true pair on both sides, at test time. Raises as `with_setting`."""
    return with_setting(data, "test_outliers", {"ratio": ratio})


def with_setting(data: dict[str, Any], name: str, value: Any) -> dict[str, Any]:
    """The same data with another value of a setting. Raises ValueError for data that have no such setting."""
    return checked(LightningDataModule, "data", data | {"init_args": data["init_args"] | {name: value}})


class TestPairs:
    """Test pairs in the fixed random order in which a limited table takes them."""

    __test__ = False  # no test case, whatever its name

    def __init__(self, data: dict[str, Any]) -> None:
        module = build(LightningDataModule, "data", data)
        module.setup("test")
        self.dataset = module.test_dataloader().dataset
        self.order = [int(i) for i in np.random.default_rng(ORDER_SEED).permutation(len(self.dataset))]


def checked(base: type, name: str, settings: Mapping[str, Any], overrides: Sequence[str] = ()) -> dict[str, Any]:
    """`class_path` and all `init_args` of a subclass of `base`, after `--NAME.SETTING=VALUE` overrides.

    Raises ValueError, naming the class, for one that cannot be imported and for settings that it does not accept.
    """
    try:
        chosen = _parser(base, name).parse_args([f"--{name}={json.dumps(settings)}", *overrides])
    except Exception as error:
        reason = str(error).strip().splitlines()[-1].strip()
        raise ValueError(f"expected settings of {settings.get('class_path')}, got {reason}") from error
    return dict(chosen.as_dict()[name])


def build(base: type, name: str, settings: Mapping[str, Any]) -> Any:
    """The object; raises as `checked` does, and as its constructor."""
    known = checked(base, name, settings)
    parser = _parser(base, name)
    instantiate = parser.instantiate if hasattr(parser, "instantiate") else parser.instantiate_classes  # by release
    return instantiate(parser.parse_object({name: known}))[name]


def _parser(base: type, name: str) -> ArgumentParser:
    parser = ArgumentParser(exit_on_error=False)
    parser.add_subclass_arguments(base, name)
    return parser
