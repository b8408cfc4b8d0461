"""Checks of arguments, with one clear ValueError for each mistake."""

import functools
import inspect
import typing
from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor

from bpnp.argument_types import ManyArrays, check_unmasked, short_repr

_F = TypeVar("_F", bound=Callable[..., Any])


def check_shapes(function: _F) -> _F:
    """Decorate a function so that it checks the shape and dtype of its tensor arguments.

    An annotation such as `Float[Tensor, "b m 2"]` requires three non-empty axes, the last of size 2, and floating-point
    numbers. An axis name stands for one size in all arguments. Not checked are other annotations, those with a variable
    number of axes, and None where it is the default. The decorated function raises ValueError for an argument that does
    not fit, and within a transform of `torch.func`.

    >>> import torch
    >>> from jaxtyping import Float
    >>> from torch import Tensor
    >>> from bpnp.checks import check_shapes
    >>> @check_shapes
    ... def mean(points2d: Float[Tensor, "b m 2"]) -> Float[Tensor, "b 2"]:
    ...     return points2d.mean(1)
    >>> mean(torch.zeros(5, 2))
    Traceback (most recent call last):
    ValueError: `points2d` has the shape (5, 2), not (b, m, 2); use .unsqueeze(0) for a batch of one
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
    """Function without `setup_context`, which torch rejects within its transforms."""

    @staticmethod
    def forward(ctx: Any, values: Tensor) -> Tensor:
        return values.view_as(values)


def refuse_transforms(name: str) -> None:
    """Raise ValueError, which names the calling function, within a transform of `torch.func`, such as `torch.vmap`."""
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
    """Raise ValueError for the first option that is not above zero (NaN included)."""
    for name, value in options.items():
        if not value > 0:
            raise ValueError(f"`{name}` is {value}; it must be above 0")


def check_within(least: float | int, most: float | int, **options: Any) -> None:
    """Raise ValueError for the first option that is not finite or not within limits, which are included.

    An option is a number, or a pair (low, high) with low <= high.

    >>> from bpnp.checks import check_within
    >>> check_within(0, 1, share=(0.2, 0.5))
    >>> check_within(0, 1, share=(0.5, 0.2))
    Traceback (most recent call last):
    ValueError: `share` is (0.5, 0.2); it must be (low, high) with low <= high, from 0 to 1
    """
    for name, value in options.items():
        several = isinstance(value, (tuple, list))
        low, high = value if several else (value, value)
        if not (least <= low <= high <= most and abs(low) < np.inf and high < np.inf):
            limits = f"{least} or more" if most == np.inf else f"from {least} to {most}"
            pair = "(low, high) with low <= high, " if several else ""
            raise ValueError(f"`{name}` is {value}; it must be {pair}{limits}")


def _tensor_type(hint: Any) -> Any:
    """Return the jaxtyping annotation in `hint` or in `hint | None`; None unless it has a fixed number of axes."""
    for part in (hint, *typing.get_args(hint)):
        if hasattr(part, "dim_str") and not set(part.dim_str) & set("*.#"):
            return part
    return None


def _check(name: str, value: Any, kind: Any, sizes: dict[str, tuple[int, str]]) -> None:
    """Check one argument against its jaxtyping annotation.

    `sizes`, of each axis name found so far with the argument that set it, is extended.
    """
    axes = kind.dim_str.split()
    shape = f"({', '.join(axes)}{',' * (len(axes) == 1)})"
    if not isinstance(value, Tensor):
        raise ValueError(f"`{name}` is a {type(value).__name__}; a tensor of shape {shape} is needed")
    actual = tuple(value.shape)
    if len(actual) != len(axes):
        hint = "; use .unsqueeze(0) for a batch of one" if len(actual) == len(axes) - 1 else ""
        raise ValueError(f"`{name}` has the shape {actual}, not {shape}{hint}")
    if 0 in actual:
        raise ValueError(f"`{name}` has the shape {actual}; no axis of {shape} may be empty")
    for axis, size in zip(axes, actual, strict=True):
        required, source = (int(axis), "") if axis.isdigit() else sizes.setdefault(axis, (size, name))
        if size != required:
            reason = f" with {axis} = {required} as in `{source}`" if source else ""
            raise ValueError(f"`{name}` has the shape {actual}, not {shape}{reason}")
    if str(value.dtype).removeprefix("torch.") not in kind.dtypes:
        numbers = kind.__name__.split("[")[0].lower()
        raise ValueError(f"`{name}` has the type {value.dtype}, not {numbers}; use .{numbers}()")


def as_tensor_list(name: str, values: ManyArrays | float, ndim: int) -> list[Tensor]:
    """Convert one array, a stack of arrays, or a sequence of arrays to a list of CPU tensors, one for each problem."""
    if isinstance(values, (list, tuple)) and values and np.ndim(values[0]) == ndim:
        return [as_tensor(name, v) for v in values]
    array = as_tensor(name, values)
    if array.numel() == 0 and array.ndim != ndim:
        raise ValueError(f"`{name}` is empty; at least one problem is needed")
    return list(array) if array.ndim == ndim + 1 else [array]


def as_tensor(name: str, values: ManyArrays | float) -> Tensor:
    """Convert an array to a CPU tensor, in this machine's byte order."""
    check_unmasked(name, values)
    if isinstance(values, Tensor):
        if values.layout != torch.strided:
            raise ValueError(f"`{name}` is a sparse tensor; use .to_dense()")
        return values.cpu()
    try:
        array = np.asarray(values)
        return torch.as_tensor(np.array(array, array.dtype.newbyteorder("=")), device="cpu")
    except (TypeError, ValueError) as error:
        raise ValueError(f"`{name}` is {short_repr(values)}; give an array of numbers, or a list of them") from error


def check_points(name: str, i: int | str, points: Tensor, dim: int) -> Tensor:
    """Return the points (k, dim) of one problem; raise ValueError for another shape, no points, NaN or infinity."""
    if points.ndim != 2 or points.shape[1] != dim:
        hint = " (are points2d and points3d swapped?)" if points.ndim == 2 and points.shape[1] in (2, 3) else ""
        raise ValueError(f"`{name}` has the shape {tuple(points.shape)} in problem {i}, not (k, {dim}){hint}")
    _check_numbers(name, i, points)
    if len(points) == 0:
        raise ValueError(f"`{name}` has no points in problem {i}; at least one is needed")
    if not points.isfinite().all():
        bad = int((~points.isfinite().all(-1)).nonzero()[0, 0])
        raise ValueError(
            f"`{name}` is {points[bad].tolist()} at point {bad} of problem {i}; all numbers must be finite"
        )
    return points


def _check_numbers(name: str, i: int | str, values: Tensor) -> None:
    """Raise ValueError for truth values and complex numbers."""
    if values.dtype == torch.bool or values.is_complex():
        raise ValueError(f"`{name}` has the type {values.dtype} in problem {i}; real numbers are needed")


def check_match3d(i: int | str, match: Tensor, m: int, n: int) -> Tensor:
    """Return the `match3d` of one problem as int64: the index of the 2D point of each 3D point (n,), -1 for none.

    Raise ValueError for another shape, no integers, or an index that is not one of the m 2D points.
    """
    if match.shape != (n,):
        raise ValueError(
            f"`match3d` has the shape {tuple(match.shape)} in problem {i}, not ({n},), one index per 3D point"
        )
    if match.is_floating_point() or match.is_complex() or match.dtype == torch.bool:
        raise ValueError(
            f"`match3d` has the type {match.dtype} in problem {i}; indices of 2D points are integers: use .astype(int)"
        )
    if int(match.min()) < -1 or int(match.max()) >= m:
        reach = f"{int(match.min())} to {int(match.max())}"
        raise ValueError(
            f"`match3d` goes from {reach} in problem {i}; its indices of 2D points go from -1 (none) to {m - 1}"
        )
    return match.long()


def stack_values(name: str, values: list[Tensor], shape: tuple[int, ...], dtype: torch.dtype) -> Tensor:
    """Stack the values of all problems; raise ValueError for another shape, NaN or infinity."""
    for i, value in enumerate(values):
        if value.shape != shape:
            raise ValueError(f"`{name}` has the shape {tuple(value.shape)} in problem {i}, not {shape}")
        _check_numbers(name, i, value)
        if not value.isfinite().all():
            raise ValueError(f"`{name}` is {value.tolist()} in problem {i}; all numbers must be finite")
    return torch.stack([v.to(dtype) for v in values])
