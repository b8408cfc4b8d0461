"""Pickles of numpy arrays, plain containers and numbers; nothing else in a pickle is ever imported or called."""

import math
import pickle
from pathlib import Path
from typing import Any

import numpy as np


class PickleError(ValueError):
    """A pickle that is broken or holds more than arrays, plain containers and numbers. The message names the file."""


def load_pickle(path: Path) -> Any:
    """The dict, list, tuple or array in a pickle of Python 2 or 3. Raises PickleError; OSError if it cannot be read."""
    with path.open("rb") as file:
        try:
            content = _Unpickler(file, encoding="bytes").load()
            if not isinstance(content, (dict, list, tuple, np.ndarray)):
                raise pickle.UnpicklingError(f"a bare {type(content).__name__} is refused")
        except Exception as error:
            got = f"{path}: {error!r}; try the authors' file as it was downloaded"
            raise PickleError(f"expected a pickle of numpy arrays, plain containers and numbers, got {got}") from error
    return content


class _Unpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        full = f"{module}.{name}".replace("_core.", "").replace("core.", "").replace("__builtin__", "builtins")
        if full not in ALLOWED:
            raise pickle.UnpicklingError(f"{full} is refused")
        return ALLOWED[full].__call__  # a bound slot: can be called, not changed


class _Type:
    def __init__(self, text: Any, *_: Any) -> None:
        if type(text) not in (str, bytes) or np.dtype(text).kind not in "biufO":
            raise pickle.UnpicklingError(f"the array type {text!r} is refused")
        self.dtype = np.dtype(text)

    def __setstate__(self, state: Any) -> None:
        self.dtype = self.dtype.newbyteorder(state[1])  # not the fields: they could lay pointers over numbers


class _Array(np.ndarray[Any, Any]):
    def __setstate__(self, state: Any) -> None:
        _, shape, kind, fortran, content = state
        form, size = (list, 1) if kind.dtype.hasobject else (bytes, kind.dtype.itemsize)
        if min(shape, default=0) < 0 or not isinstance(content, form) or len(content) != math.prod(shape) * size:
            raise pickle.UnpicklingError(f"an array of shape {shape} made of a {type(content).__name__} is refused")
        super().__setstate__((1, shape, kind.dtype, fortran, content))


ALLOWED: dict[str, Any] = {
    "numpy.ndarray": lambda: None,  # what the next one is asked for
    "numpy.multiarray._reconstruct": lambda *_: np.ndarray.__new__(_Array, (0,)),
    "numpy.multiarray.scalar": lambda kind, content: np.frombuffer(content, kind.dtype).item(),
    "numpy.numeric._frombuffer": lambda a, kind, shape, order: np.frombuffer(a, kind.dtype).reshape(shape, order=order),
    "numpy.dtype": _Type,
    "_codecs.encode": lambda text, encoding: text.encode({"latin1": "latin1"}[encoding]),
    "builtins.bytes": lambda: b"",
    "builtins.set": set,
    "collections.OrderedDict": dict,
}
