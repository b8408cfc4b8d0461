"""How the CPU's loops are compiled."""

import inspect
from collections.abc import Callable
from typing import Any

import numba


def compiler(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """A decorator: compile at the first call, keep the result on disk, and hold no lock while it runs.

    A function is compiled without the wrappers that a type checker puts around it when it is imported.
    options: of `numba.njit`.
    """

    def compiled(function: Callable[..., Any]) -> Any:
        return numba.njit(inspect.unwrap(function), nogil=True, cache=True, **options)

    return compiled
