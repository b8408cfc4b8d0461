"""Pickles of numpy arrays, plain containers and numbers; nothing else in a pickle is ever imported or called.

numpy itself is not trusted with a stranger's pickle either: a made-up dtype may pass bytes off as object pointers. So
arrays are recorded here as their shape, type and bytes, checked, and only then made.
"""

import math
import pickle
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

PLAIN = (bool, int, float, str, bytes, type(None))
NUMERIC = re.compile(r"[biuf][1248]|O[48]?")


class PickleError(ValueError):
    """A pickle that is broken or holds more than arrays, plain containers and numbers. The message names the file."""


def load_pickle(path: Path) -> Any:
    """What is in a pickle, of Python 2 or 3: dicts, lists, tuples, sets, strings, numbers and numpy arrays of numbers.

    Arrays of objects are admitted if their elements are. Nothing in the file is imported or called.
    Raises PickleError that names the file and what was refused; OSError if it cannot be opened.
    """
    try:
        with path.open("rb") as file:
            return _resolve(_Unpickler(file, encoding="latin1").load())
    except OSError:
        raise
    except Exception as error:
        raise PickleError(
            f"expected a pickle of numpy arrays, plain containers and numbers, got {path}: "
            f"{error or type(error).__name__}; try the authors' file as it was downloaded"
        ) from error


class _Unpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        full = f"{module.replace('numpy._core', 'numpy.core').replace('__builtin__', 'builtins')}.{name}"
        if full == "numpy.ndarray":
            return _NDARRAY
        if full not in _ADMITTED:
            raise pickle.UnpicklingError(f"{module}.{name} is refused")
        return _Admitted(_ADMITTED[full])

    def persistent_load(self, pid: Any) -> Any:
        raise pickle.UnpicklingError("a persistent reference is refused")


class _Admitted:
    """A function that a pickle may call, and can neither change nor look into."""

    __slots__ = ("_function",)

    def __init__(self, function: Callable[..., Any]) -> None:
        self._function = function

    def __call__(self, *args: Any) -> Any:
        return self._function(*args)

    def __setstate__(self, state: Any) -> None:
        raise pickle.UnpicklingError("a changed function is refused")


@dataclass
class _Type:
    """A dtype to be: one of a number, or of objects."""

    text: str
    order: Any = "="

    def __setstate__(self, state: Any) -> None:
        order, parts = state[1], state[2:5]
        if order not in ("<", ">", "=", "|") or any(part is not None for part in parts):
            raise pickle.UnpicklingError(f"the array type {state} is refused")
        self.order = order

    @property
    def dtype(self) -> np.dtype:
        return np.dtype(self.text).newbyteorder(self.order)


@dataclass
class _Array:
    """An array to be. content: its bytes, or the list of its objects."""

    shape: Any = (0,)
    kind: Any = None
    fortran: Any = False
    content: Any = b""

    def __setstate__(self, state: Any) -> None:
        _, self.shape, self.kind, self.fortran, self.content = state
        self.check()

    def check(self) -> None:
        """Whether everything is of its kind and as long as it says."""
        if isinstance(self.content, str):  # Python 2
            self.content = self.content.encode("latin1")
        if not isinstance(self.kind, _Type) or not isinstance(self.shape, tuple):
            raise pickle.UnpicklingError("an array without shape and type is refused")
        if not all(type(size) is int and size >= 0 for size in self.shape):
            raise pickle.UnpicklingError(f"an array of shape {self.shape} is refused")
        count, objects = math.prod(self.shape), self.kind.text.startswith("O")
        if not isinstance(self.content, list if objects else (bytes, bytearray)):
            raise pickle.UnpicklingError(f"an array of {self.kind.text} made of a {type(self.content).__name__}")
        if len(self.content) != count * (1 if objects else self.kind.dtype.itemsize):
            raise pickle.UnpicklingError(f"an array of shape {self.shape} made of {len(self.content)} bytes or objects")

    def array(self) -> NDArray[Any]:
        order: Literal["C", "F"] = "F" if self.fortran else "C"
        if isinstance(self.content, list):
            flat = np.empty(len(self.content), object)
            for i, value in enumerate(self.content):
                flat[i] = _resolve(value)
            return flat.reshape(self.shape, order=order)
        return np.frombuffer(self.content, self.kind.dtype).reshape(self.shape, order=order)


_NDARRAY = object()


def _dtype(text: Any, *_: Any) -> _Type:
    if not isinstance(text, str) or not NUMERIC.fullmatch(text):
        raise pickle.UnpicklingError(f"the array type {text!r} is refused")
    return _Type(text)


def _reconstruct(subtype: Any, *_: Any) -> _Array:
    if subtype is not _NDARRAY:
        raise pickle.UnpicklingError("a subclass of numpy.ndarray is refused")
    return _Array()


def _frombuffer(buffer: Any, kind: Any, shape: Any, order: Any) -> _Array:
    array = _Array(shape, kind, order == "F", buffer)
    array.check()
    return array


def _scalar(kind: Any, content: Any) -> Any:
    array = _Array((), kind, False, content)
    array.check()
    return array.array().item()


def _no_bytes(*args: Any) -> bytes:
    if args:
        raise pickle.UnpicklingError("bytes of something are refused")
    return b""


def _encode(text: Any, encoding: Any) -> bytes:
    if not isinstance(text, str) or encoding != "latin1":
        raise pickle.UnpicklingError(f"encoding as {encoding!r} is refused")
    return text.encode("latin1")


_ADMITTED: Mapping[str, Callable[..., Any]] = {
    "numpy.dtype": _dtype,
    "numpy.core.multiarray._reconstruct": _reconstruct,
    "numpy.core.multiarray.scalar": _scalar,
    "numpy.core.numeric._frombuffer": _frombuffer,
    "_codecs.encode": _encode,
    "builtins.bytes": _no_bytes,
    "builtins.set": set,
    "builtins.frozenset": frozenset,
    "collections.OrderedDict": dict,
}


def _resolve(value: Any) -> Any:
    """The value with its arrays made."""
    if type(value) in PLAIN:
        return value
    if isinstance(value, _Array):
        value.check()
        return value.array()
    if type(value) is dict:
        return {_resolve(k): _resolve(v) for k, v in value.items()}
    if type(value) in (list, tuple, set, frozenset):
        return type(value)(_resolve(v) for v in value)
    raise pickle.UnpicklingError(f"a bare {type(value).__name__.strip('_')} is refused")
