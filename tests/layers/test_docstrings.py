"""The examples in the docstrings of the layers and below run and give what they show."""

import doctest
import importlib

import pytest
import torch


@pytest.mark.parametrize(
    "module",
    [
        "layers.assignment",
        "layers.implicit",
        "layers.pnp",
        "layers.ransac",
        "robust.consensus",
        "robust.p3p",
        "geometry",
    ],
)
def test_examples_are_right(module: str) -> None:
    result = doctest.testmod(importlib.import_module(f"bpnp.{module}"), extraglobs={"torch": torch})
    assert result.attempted > 0
    assert result.failed == 0
