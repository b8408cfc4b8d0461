"""Examples in docstrings: each runs when it is pasted, and gives the result that it shows."""

import doctest
import importlib
import pydoc
import re
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[1]
REFERENCE = re.findall(r"^::: (\S+)", (ROOT / "docs" / "api.md").read_text(encoding="utf-8"), re.MULTILINE)
MODULES = sorted(
    ".".join(file.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
    for file in (ROOT / "bpnp").rglob("*.py")
    if "    >>> " in file.read_text(encoding="utf-8")
)
INTERNAL = "bpnp.search."  # modules whose names are imported from `bpnp`, or are not public


def is_pasted(example: doctest.DocTest, public: set[str]) -> bool:
    """Return True for an example that a reader copies: of a name in docs/api.md, or outside of the internals."""
    name = example.name
    return not name.startswith(INTERNAL) or any(name == each or name.startswith(f"{each}.") for each in public)


def public_names() -> set[str]:
    """Return the names in docs/api.md as "module.name", where they are defined."""
    objects = [pydoc.locate(name) for name in REFERENCE]
    assert None not in objects
    return {f"{each.__module__}.{each.__qualname__}" for each in objects}  # type: ignore[union-attr]


@pytest.mark.parametrize("name", MODULES)
def test_examples_are_right(name: str) -> None:
    """In an empty namespace, except those of the internals, whose namespace is the module."""
    runner, public = doctest.DocTestRunner(), public_names()
    for example in doctest.DocTestFinder(exclude_empty=True).find(importlib.import_module(name)):
        if is_pasted(example, public):
            example.globs = {"__name__": "__main__"}
        runner.run(example, clear_globs=False)
    assert runner.tries > 0
    assert runner.failures == 0


def test_the_reference_has_names_of_the_internals() -> None:
    """Otherwise no example of `solve` would run in an empty namespace."""
    assert {"bpnp.search.api.solve", "bpnp.search.verify.verify"} <= public_names()
