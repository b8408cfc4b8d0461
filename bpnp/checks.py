"""Arguments that callers without a type checker can get wrong: one clear ValueError each."""

import functools
import inspect
import typing
from collections.abc import Callable
from typing import Any, TypeVar

from torch import Tensor

_F = TypeVar("_F", bound=Callable[..., Any])


def checked_shapes(function: _F) -> _F:
    """Raise ValueError if a tensor argument has not the shape or the kind of numbers that its annotation names.

    An annotation such as `Float[Tensor, "b m 2"]` asks for three axes, none of them empty, the last of size 2, and
    floating-point numbers; an axis name stands for one size in all arguments. Annotations of other types, arguments
    that are None where the annotation allows it, and annotations with a variable number of axes are not looked at.

    >>> import torch
    >>> from jaxtyping import Float
    >>> @checked_shapes
    ... def mean(points2d: Float[Tensor, "b m 2"]) -> Float[Tensor, "b 2"]:
    ...     return points2d.mean(1)
    >>> mean(torch.zeros(5, 2))
    Traceback (most recent call last):
    ValueError: expected `points2d` of shape (b, m, 2), got (5, 2); try .unsqueeze(0) for a batch of one
    """
    signature = inspect.signature(function)
    expected = {name: kind for name, hint in typing.get_type_hints(function).items() if (kind := _tensor_type(hint))}
    expected.pop("return", None)

    @functools.wraps(function)
    def run(*arguments: Any, **options: Any) -> Any:
        sizes: dict[str, tuple[int, str]] = {}
        bound = signature.bind(*arguments, **options)
        for name, value in bound.arguments.items():
            if name in expected and not (value is None and signature.parameters[name].default is None):
                _check(name, value, expected[name], sizes)
        return function(*bound.args, **bound.kwargs)

    return run  # type: ignore[return-value]


def check_positive(**options: int | float) -> None:
    """Raise ValueError that names the first option that is not above zero, NaN included."""
    for name, value in options.items():
        if not value > 0:
            raise ValueError(f"expected `{name}` > 0, got {value}")


def _tensor_type(hint: Any) -> Any:
    """The jaxtyping annotation in `hint` or in `hint | None`; None if there is none of a fixed number of axes."""
    for part in (hint, *typing.get_args(hint)):
        if hasattr(part, "dim_str") and not set(part.dim_str) & set("*.#"):
            return part
    return None


def _check(name: str, value: Any, kind: Any, sizes: dict[str, tuple[int, str]]) -> None:
    """Check one argument; `sizes` holds the size of each axis name met so far and the argument that set it."""
    axes = kind.dim_str.split()
    shape = f"({', '.join(axes)}{',' * (len(axes) == 1)})"
    if not isinstance(value, Tensor):
        raise ValueError(f"expected `{name}` as a tensor of shape {shape}, got {type(value).__name__}")
    got = tuple(value.shape)
    if len(got) != len(axes):
        hint = "; try .unsqueeze(0) for a batch of one" if len(got) == len(axes) - 1 else ""
        raise ValueError(f"expected `{name}` of shape {shape}, got {got}{hint}")
    if 0 in got:
        raise ValueError(f"expected `{name}` of shape {shape} with no empty axis, got {got}")
    for axis, size in zip(axes, got, strict=True):
        wanted, source = (int(axis), "") if axis.isdigit() else sizes.setdefault(axis, (size, name))
        if size != wanted:
            reason = f" with {axis} = {wanted} as in `{source}`" if source else ""
            raise ValueError(f"expected `{name}` of shape {shape}{reason}, got {got}")
    if str(value.dtype).removeprefix("torch.") not in kind.dtypes:
        numbers = kind.__name__.split("[")[0].lower()
        raise ValueError(f"expected `{name}` of type {numbers}, got {value.dtype}; try .{numbers}()")
