"""Packages whose names are imported at their first use, so that `import bpnp.report` loads what is asked for alone."""

import sys
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from typing import Any


def lazy_names(
    package: str, modules: Mapping[str, Sequence[str]]
) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """The `__getattr__` and `__dir__` of a package.

    modules: the names that each module defines, by the module's own name.

    >>> find, names = lazy_names("bpnp", {"bpnp.geometry": ("MIN_POINTS",)})
    >>> find("MIN_POINTS"), "MIN_POINTS" in names()
    (4, True)
    """
    module_of = {name: module for module, names in modules.items() for name in names}

    def find(name: str) -> Any:
        if name not in module_of:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        value = getattr(import_module(module_of[name]), name)
        setattr(sys.modules[package], name, value)
        return value

    def names() -> list[str]:
        return sorted({*vars(sys.modules[package]), *module_of})

    return find, names
