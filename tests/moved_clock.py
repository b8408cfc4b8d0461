"""A clock that a test moves, so that a time limit passes at a certain function and the work after it is counted."""

from collections.abc import Callable
from functools import partial
from importlib import import_module
from typing import Any

import pytest

from bpnp.runtime import Clock

LATER = 1e6  # seconds, beyond all limits of the tests


class MovedClock:
    """Clock that stands still until a function is called, and is then beyond every limit."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.monkeypatch, self.time = monkeypatch, 0.0
        monkeypatch.setattr(Clock, "now", classmethod(lambda cls: self.time))

    def stop_at(self, function: str, *, after: bool = False) -> None:
        """Let the limit pass when this function is called, or after that."""

        def call(original: Callable[..., Any], *arguments: Any, **options: Any) -> Any:
            if not after:
                self.time = LATER
            result = original(*arguments, **options)
            self.time = LATER
            return result

        self.wrap(function, call)

    def count_late(self, function: str) -> list[Any]:
        """Return a list that gets the first argument of every call of this function after the limit."""
        calls = list[Any]()

        def call(original: Callable[..., Any], *arguments: Any, **options: Any) -> Any:
            if self.time:
                calls.append(arguments[0] if arguments else None)
            return original(*arguments, **options)

        self.wrap(function, call)
        return calls

    def wrap(self, function: str, call: Callable[..., Any]) -> None:
        module, name = function.rsplit(".", 1)
        owner = import_module(f"bpnp.{module}")
        self.monkeypatch.setattr(owner, name, partial(call, getattr(owner, name)))
