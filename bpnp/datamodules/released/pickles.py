"""Pickles of numpy arrays, plain containers and numbers; nothing else in a pickle is ever imported or called.

Only the names in `ALLOWED` can be called, and numpy makes an array only after its shape, type and bytes were compared:
it would take a made-up type or a wrong size for pointers to objects.
"""

import math
import pickle
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

NUMBER = re.compile(r"[biuf][1248]|O8?")


class PickleError(ValueError):
    """A pickle that is broken or holds more than arrays, plain containers and numbers. The message names the file."""


def load_pickle(path: Path) -> Any:
    """The dict, list, tuple or array in a pickle of Python 2 or 3; its arrays may be subclasses of numpy's.

    Raises PickleError that names the file and what was refused; OSError if it cannot be opened.
    """
    with path.open("rb") as file:
        try:
            content = _Unpickler(file, encoding="latin1").load()
            if not isinstance(content, (dict, list, tuple, np.ndarray)):
                _refuse(f"a bare {type(content).__name__}")
        except Exception as error:
            raise PickleError(
                f"expected a pickle of numpy arrays, plain containers and numbers, got {path}: "
                f"{error or type(error).__name__}; try the authors' file as it was downloaded"
            ) from error
    return content


class _Unpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        full = f"{module.replace('numpy._core', 'numpy.core').replace('__builtin__', 'builtins')}.{name}"
        if full not in ALLOWED:
            _refuse(f"{module}.{name}")
        return _Call(ALLOWED[full])

    def persistent_load(self, pid: Any) -> Any:
        _refuse("a persistent reference")


class _Call:
    """A function that a pickle may call and cannot change."""

    __slots__ = ("_function",)

    def __init__(self, function: Callable[..., Any]) -> None:
        self._function = function

    def __call__(self, *args: Any) -> Any:
        return self._function(*args)

    def __setstate__(self, state: Any) -> None:
        _refuse("a changed function")


class _Type:
    """A type of array: numbers or objects, in a byte order."""

    __slots__ = ("order", "text")

    def __init__(self, text: Any, *_: Any) -> None:
        if not isinstance(text, str) or not NUMBER.fullmatch(text):
            _refuse(f"the array type {text!r}")
        self.text, self.order = text, "="

    def __setstate__(self, state: Any) -> None:
        if state[1] not in ("<", ">", "=", "|") or any(part is not None for part in state[2:5]):
            _refuse(f"the array type {state}")
        self.order = state[1]


class _Array(np.ndarray[Any, Any]):
    def __setstate__(self, state: Any) -> None:
        _, shape, kind, fortran, content = state
        super().__setstate__(_checked(shape, kind, content, fortran))


def _checked(shape: Any, kind: Any, content: Any, fortran: Any = False) -> tuple[Any, ...]:
    """The state of an array, if its content is of its type and as long as shape and type say."""
    content = content.encode("latin1") if type(content) is str else content  # of Python 2
    content = bytes(content) if type(content) is bytearray else content
    if not isinstance(kind, _Type) or type(shape) is not tuple or not all(type(n) is int and n >= 0 for n in shape):
        _refuse(f"an array of shape {shape}")
    objects, dtype = kind.text[0] == "O", np.dtype(kind.text).newbyteorder(kind.order)
    if type(content) is not (list if objects else bytes):
        _refuse(f"an array type of {kind.text} made of a {type(content).__name__}")
    if len(content) != math.prod(shape) * (1 if objects else dtype.itemsize):
        _refuse(f"an array of shape {shape} made of {len(content)} bytes or objects")
    return 1, shape, dtype, bool(fortran), content


def _array(*state: Any) -> Any:
    array = np.ndarray.__new__(_Array, (0,))
    np.ndarray.__setstate__(array, _checked(*state))
    return array


def _refuse(what: Any) -> Any:
    raise pickle.UnpicklingError(f"{what} is refused")


ALLOWED: dict[str, Callable[..., Any]] = {
    "numpy.ndarray": lambda *_: _refuse("a bare numpy.ndarray"),
    "numpy.dtype": _Type,
    "numpy.core.multiarray._reconstruct": lambda *_: np.ndarray.__new__(_Array, (0,)),
    "numpy.core.multiarray.scalar": lambda kind, content: _array((), kind, content).item(),
    "numpy.core.numeric._frombuffer": lambda content, kind, shape, order: _array(shape, kind, content, order == "F"),
    "_codecs.encode": lambda text, encoding: text.encode("latin1") if encoding == "latin1" else _refuse(encoding),
    "builtins.bytes": lambda *args: b"" if not args else _refuse("bytes of something"),
    "builtins.set": set,
    "builtins.frozenset": frozenset,
    "collections.OrderedDict": dict,
}
