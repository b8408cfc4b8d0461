"""Layers keep their digits under autocast, which would solve them with the 8 bits of bfloat16."""

import functools
from collections.abc import Callable
from typing import Any, TypeVar

import torch
from torch import Tensor

_F = TypeVar("_F", bound=Callable[..., Any])
HALF = (torch.float16, torch.bfloat16)


def full_precision(layer: _F) -> _F:
    """Run a function of tensors with autocast off and its half-precision arguments in float32."""

    @functools.wraps(layer)
    def run(first: Tensor, *rest: Any, **options: Any) -> Any:
        with torch.autocast(first.device.type, enabled=False):
            return layer(_widened(first), *map(_widened, rest), **{k: _widened(v) for k, v in options.items()})

    return run  # type: ignore[return-value]


def _widened(value: Any) -> Any:
    return value.float() if isinstance(value, Tensor) and value.dtype in HALF else value
