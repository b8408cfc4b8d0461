"""Deprecated place of `bpnp.search.solution` and of the pictures of `bpnp.report.solutions`."""

import warnings
from typing import Any

MOVED = {  # name here: module and name
    "Solution": ("bpnp.search.solution", "Solution"),
    "Candidate": ("bpnp.search.solution", "Candidate"),
    "SolutionStats": ("bpnp.search.solution", "SolutionStats"),
    "solution_points": ("bpnp.report.solutions", "solution_points"),
    "solution_picture": ("bpnp.report.solutions", "draw_solution"),
}


def __getattr__(name: str) -> Any:
    """Return an object from its present module, with a DeprecationWarning."""
    if name not in MOVED:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module

    module, present = MOVED[name]
    text = f"`{__name__}.{name}` is now `{module}.{present}`; the next minor version removes the old name"
    warnings.warn(text, DeprecationWarning, stacklevel=2)
    return getattr(import_module(module), present)
