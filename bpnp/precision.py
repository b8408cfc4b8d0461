"""Full float32 precision for functions that need every digit, whatever precision the user chose for the networks.

Autocast would compute their products in 16 bits. `torch.set_float32_matmul_precision("high")` would use TF32, with 11
significant bits: a distance near zero is then wrong by 0.03, and the transport kernel exp(-distance / mu) by 30 %.
"""

import functools
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

import torch
from torch import Tensor

_F = TypeVar("_F", bound=Callable[..., Any])
HALF = (torch.float16, torch.bfloat16)
_LOCK = threading.Lock()
_RESTORE: list[Callable[[], None]] = []  # one for each open block; the first restores the user's setting


def full_precision(function: _F) -> _F:
    """Decorate a function of tensors to run within `exact_products`, with half-precision arguments cast to float32.

    The first argument has to be a tensor. Autocast is switched off for its device.
    """

    def widen(value: Any) -> Any:
        return value.float() if isinstance(value, Tensor) and value.dtype in HALF else value

    @functools.wraps(function)
    def run(first: Tensor, *rest: Any, **options: Any) -> Any:
        with exact_products(first.device):
            return function(widen(first), *map(widen, rest), **{k: widen(v) for k, v in options.items()})

    return run  # type: ignore[return-value]


@contextmanager
def exact_products(device: torch.device) -> Iterator[None]:
    """Switch autocast off, and compute float32 matrix products exactly, until the block ends.

    Autocast is a setting of the thread. The precision of products is one of the process, so other threads compute exact
    products meanwhile. The user's setting returns when the last of nested or concurrent blocks ends.
    """
    with _LOCK:
        _RESTORE.append(_raise_precision())
    try:
        with torch.autocast(device.type, enabled=False):
            yield
    finally:
        with _LOCK:
            restore = _RESTORE.pop()
            if not _RESTORE:
                restore()


def _raise_precision() -> Callable[[], None]:
    """Make float32 products exact, and return a function that restores the setting."""
    try:
        before = torch.get_float32_matmul_precision()
    except RuntimeError:  # the user has set a single backend, for which torch has no common value
        switches: list[Any] = [getattr(torch.backends, name).matmul for name in ("cuda", "mkldnn")]
        values = [switch.fp32_precision for switch in switches]
        _set_switches(switches, "ieee")
        return functools.partial(_restore_switches, switches, values)
    if before == "highest":
        return lambda: None
    torch.set_float32_matmul_precision("highest")
    return functools.partial(torch.set_float32_matmul_precision, before)


def _set_switches(switches: list[Any], value: str) -> None:
    for switch in switches:
        switch.fp32_precision = value


def _restore_switches(switches: list[Any], values: list[str]) -> None:
    """Set the switches back to values that were read from them.

    "none" follows the general switch, `torch.backends.fp32_precision`, and reads as its value. A switch that reads as
    it did stays so; it then follows later changes of the general switch.
    """
    _set_switches(switches, "none")
    for switch, value in zip(switches, values, strict=True):
        if switch.fp32_precision != value:
            switch.fp32_precision = value
