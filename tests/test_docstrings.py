"""Examples in docstrings: each runs when it is pasted, and gives the result that it shows."""

import doctest
import importlib
import inspect
import pydoc
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[1]
REFERENCE = re.findall(r"^::: (\S+)", (ROOT / "docs" / "api.md").read_text(encoding="utf-8"), re.MULTILINE)
MODULES = sorted(
    ".".join(file.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
    for file in (ROOT / "bpnp").rglob("*.py")
    if "    >>> " in file.read_text(encoding="utf-8")
)
PACKAGES = (
    "bpnp",
    *(f"bpnp.{name}" for name in ("datamodules", "layers", "models", "models.baselines", "report", "training")),
)
INTERNAL = "bpnp.search."  # modules whose names are imported from `bpnp`, or are not public


def is_pasted(example: doctest.DocTest, public: set[str]) -> bool:
    """Return True for an example that a reader copies: of a name in docs/api.md, or outside of the internals."""
    name = example.name
    return not name.startswith(INTERNAL) or any(name == each or name.startswith(f"{each}.") for each in public)


def public_objects() -> list[Any]:
    objects = [pydoc.locate(name) for name in REFERENCE]
    assert None not in objects
    return objects


def public_names() -> set[str]:
    """Return the names in docs/api.md as "module.name", where they are defined."""
    return {f"{each.__module__}.{each.__qualname__}" for each in public_objects()}


def public_callables() -> Iterator[tuple[str, Any, str]]:
    """Yield the name, the callable and the docstring of each public function, constructor and method.

    Constructors and methods that a base class of another package describes are left out, except `forward`.
    """
    for each in public_objects():
        foreign = [base for base in getattr(each, "__mro__", ()) if not base.__module__.startswith("bpnp.")]
        is_protocol = getattr(each, "_is_protocol", False)  # its constructor has no arguments
        if not is_protocol and all(getattr(each, "__init__", None) is not base.__init__ for base in foreign):
            yield each.__qualname__, each, inspect.getdoc(each) or ""
        if not inspect.isclass(each):
            continue
        for name, member in inspect.getmembers(each, lambda one: inspect.isfunction(one) or inspect.ismethod(one)):
            inherited = any(getattr(base, name, None) is not None for base in foreign)
            inherited = inherited and (name != "forward" or not member.__module__.startswith("bpnp."))
            if not name.startswith("_") and not inherited:
                yield f"{each.__qualname__}.{name}", member, inspect.getdoc(member) or ""


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


def test_the_reference_has_every_exported_name() -> None:
    """Under one of its names: BPnPNet is exported by two packages."""
    modules = [importlib.import_module(name) for name in PACKAGES]
    exported = [getattr(module, name) for module in modules for name in module.__all__]
    listed = public_objects()
    assert [each for each in exported if each not in listed] == []


def test_every_argument_of_a_public_name_is_described() -> None:
    """In a section `Args:`, among the attributes of a class, or by a reference to a method with the same arguments."""
    missing = []
    for name, function, text in public_callables():
        if "arguments as for `" in text.lower():
            continue
        parameters = [
            each for each in inspect.signature(function).parameters.values() if each.name not in ("self", "cls", "_")
        ]
        missing += [f"{name}: no docstring"] if not text else []
        missing += [f"{name}: {each.name}" for each in parameters if not re.search(rf"^ +\**{each.name}: ", text, re.M)]
    assert missing == []
