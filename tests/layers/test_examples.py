"""The examples in the docstrings of the layers run and give what they show."""

import doctest
import importlib

import pytest
import torch


@pytest.mark.parametrize("module", ["layers.assignment", "layers.implicit", "layers.pnp", "geometry"])
def test_examples_are_right(module: str) -> None:
    result = doctest.testmod(importlib.import_module(f"bpnp.{module}"), extraglobs={"torch": torch})
    assert result.attempted > 0
    assert result.failed == 0
