"""Arguments that callers without a type checker can get wrong: one clear ValueError each."""

import functools
import inspect
import typing
from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor

Arrays = Any  # one array, or a sequence of arrays of different sizes; numpy or torch
_F = TypeVar("_F", bound=Callable[..., Any])


def check_shapes(function: _F) -> _F:
    """Raise ValueError if a tensor argument has not the shape or the kind of numbers that its annotation names, and
    within a transform of `torch.func`.

    An annotation such as `Float[Tensor, "b m 2"]` asks for three axes, none of them empty, the last of size 2, and
    floating-point numbers; an axis name stands for one size in all arguments. Annotations of other types, arguments
    that are None where the annotation allows it, and annotations with a variable number of axes are not looked at.

    >>> import torch
    >>> from jaxtyping import Float
    >>> @check_shapes
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
        refuse_transforms(function.__name__)
        sizes: dict[str, tuple[int, str]] = {}
        bound = signature.bind(*arguments, **options)
        for name, value in bound.arguments.items():
            if name in expected and not (value is None and signature.parameters[name].default is None):
                _check(name, value, expected[name], sizes)
        return function(*bound.args, **bound.kwargs)

    return run  # type: ignore[return-value]


class _Probe(torch.autograd.Function):
    """A function without `setup_context`, which torch refuses within its transforms."""

    @staticmethod
    def forward(ctx: Any, values: Tensor) -> Tensor:
        return values.view_as(values)


def refuse_transforms(name: str) -> None:
    """Raise ValueError within a transform of `torch.func`, or within `torch.vmap`."""
    if torch.compiler.is_compiling():
        return
    try:
        _Probe.apply(torch.zeros(()))
    except RuntimeError as error:
        raise ValueError(
            f"{name} does not support torch.func and torch.vmap; call it on a batch, and use backward() or "
            "torch.autograd.grad for its gradient"
        ) from error


def check_positive(**options: int | float) -> None:
    """Raise ValueError that names the first option that is not above zero, NaN included."""
    for name, value in options.items():
        if not value > 0:
            raise ValueError(f"expected `{name}` > 0, got {value}")


def check_within(least: float | int, most: float | int, **options: Any) -> None:
    """Raise ValueError that names the first option that is not a finite number from `least` to `most`, or two of them.

    >>> check_within(0, 1, share=(0.2, 0.5))
    >>> check_within(0, 1, share=(0.5, 0.2))
    Traceback (most recent call last):
    ValueError: expected `share` from 0 to 1 as (low, high), got (0.5, 0.2)
    """
    for name, value in options.items():
        several = isinstance(value, (tuple, list))
        low, high = value if several else (value, value)
        if not (least <= low <= high <= most and abs(low) < np.inf and high < np.inf):
            limits = f"of {least} or more" if most == np.inf else f"from {least} to {most}"
            raise ValueError(f"expected `{name}` {limits}{' as (low, high)' * several}, got {value}")


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


def as_tensor_list(name: str, values: Arrays, ndim: int) -> list[Tensor]:
    """One array of `ndim` axes, a stack of them, or a sequence of them, as a list of CPU tensors."""
    if isinstance(values, (list, tuple)) and values and np.ndim(values[0]) == ndim:
        return [as_tensor(name, v) for v in values]
    array = as_tensor(name, values)
    if array.numel() == 0 and array.ndim != ndim:
        raise ValueError(f"expected at least one problem, got an empty `{name}`")
    return list(array) if array.ndim == ndim + 1 else [array]


def as_tensor(name: str, values: Arrays) -> Tensor:
    if isinstance(values, Tensor):
        return values.cpu()
    try:
        array = np.asarray(values)
        return torch.as_tensor(np.array(array, array.dtype.newbyteorder("=")))
    except (TypeError, ValueError) as error:
        raise ValueError(f"expected `{name}` as an array of numbers or a list of them, got {values!r:.80}") from error


def check_points(name: str, i: int | str, points: Tensor, dim: int) -> Tensor:
    """The points of problem i, (k, dim). Raises ValueError for another shape, none of them, NaN or infinity."""
    if points.ndim != 2 or points.shape[1] != dim:
        hint = " (are points2d and points3d swapped?)" if points.ndim == 2 and points.shape[1] in (2, 3) else ""
        raise ValueError(f"expected `{name}` of shape (k, {dim}), got {tuple(points.shape)} in problem {i}{hint}")
    if len(points) == 0:
        raise ValueError(f"expected at least one point in `{name}`, got none in problem {i}")
    if not points.isfinite().all():
        bad = int((~points.isfinite().all(-1)).nonzero()[0, 0])
        raise ValueError(f"expected finite `{name}`, got {points[bad].tolist()} at point {bad} of problem {i}")
    return points


def check_match3d(i: int | str, match: Tensor, m: int, n: int) -> Tensor:
    """The match3d of problem i, (n,). Raises ValueError for another shape, no integers, or what is no 2D point."""
    if match.shape != (n,):
        raise ValueError(f"expected `match3d` of shape ({n},), one a 3D point, got {tuple(match.shape)} in problem {i}")
    if match.is_floating_point() or match.is_complex() or match.dtype == torch.bool:
        raise ValueError(
            f"expected `match3d` as integers, indices of 2D points, got {match.dtype} in problem {i}; try .astype(int)"
        )
    if int(match.min()) < -1 or int(match.max()) >= m:
        reach = f"{int(match.min())} to {int(match.max())}"
        raise ValueError(f"expected `match3d` between -1 and {m - 1}, got {reach} in problem {i}")
    return match.long()


def stack_values(name: str, values: list[Tensor], shape: tuple[int, ...], dtype: torch.dtype) -> Tensor:
    """One tensor of the values of all problems. Raises ValueError for another shape, NaN or infinity."""
    for i, value in enumerate(values):
        if value.shape != shape:
            raise ValueError(f"expected `{name}` of shape {shape}, got {tuple(value.shape)} in problem {i}")
        if not value.isfinite().all():
            raise ValueError(f"expected finite `{name}`, got {value.tolist()} in problem {i}")
    return torch.stack([v.to(dtype) for v in values])
