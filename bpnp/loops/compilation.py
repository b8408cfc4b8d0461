"""Compilation of loops with numba, and the folder that keeps the machine code."""

import gc
import hashlib
import inspect
import logging
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import cache, update_wrapper
from pathlib import Path
from typing import Any

import numba

from bpnp.files import cache_folder, lock_folder
from bpnp.loops.parallel import Clock

# Options of `fastmath`: sums in any order. NaN and infinity keep their meaning: they mark a lost pose or sample.
FAST = {"reassoc", "contract", "arcp", "nsz"}
_SETTINGS: Any = numba.config  # NUMBA_CACHE_DIR and others, as attributes


def compiler(*, part: bool = False, **options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Return a decorator that compiles a function with `numba.njit`.

    Divisions by zero are infinite, as in C, and the GIL is released. A type checker's wrapper around the function is
    removed.

    Args:
        part: True for a function that only compiled functions call, and that is cached with them.
        options: Options of `numba.njit`.

    Returns:
        A decorator that returns a `Loop`, or for a part numba's function.
    """
    options |= {"nogil": True, "error_model": "numpy"}
    if part:
        return lambda function: numba.njit(inspect.unwrap(function), **options)
    return lambda function: Loop(inspect.unwrap(function), options)


class Loop:
    """Function that numba compiles at its first call, once an installation.

    The machine code is kept in ``loops`` in `cache_folder`, or in NUMBA_CACHE_DIR. Each version of the source has its
    own folder there. The source includes the files of the parts that the function calls and of the named tuples that it
    takes; numba itself only checks the function's file. One process compiles; others that need the same loop wait for
    it. If the folder is not writable, each process compiles.
    """

    def __init__(self, function: Callable[..., Any], options: dict[str, Any]) -> None:
        self.function, self.options = function, options
        self.compiled: Any = None
        update_wrapper(self, function)

    def __call__(self, *arguments: Any) -> Any:
        if self.compiled is None:
            self._compile(arguments)
        return self.compiled(*arguments)

    def _compile(self, arguments: tuple[Any, ...]) -> None:
        """Compile the function for the types of the arguments, or load it from the cache."""
        with _ONE_AT_A_TIME, ExitStack() as stack:
            if self.compiled is not None:  # by another thread
                return
            stack.enter_context(_clock_stopped())
            folder = _folder_of(self.function, arguments)
            try:
                stack.enter_context(lock_folder(folder, wait=True))
                compiled = _njit_into(folder, self.function, self.options)
            except (OSError, ValueError, RuntimeError):  # not a folder, read-only, or too full for numba
                compiled = numba.njit(self.function, **self.options)
            if not any(folder.glob("*/*.nbc")):
                _announce(folder.parent)
                stack.enter_context(_collection_paused())
            compiled.compile(tuple(map(numba.typeof, arguments)))
            self.compiled = compiled


_ONE_AT_A_TIME = threading.RLock()


def _njit_into(folder: Path, function: Callable[..., Any], options: dict[str, Any]) -> Any:
    """Return a function that numba caches in a folder; numba reads the setting while it creates the function."""
    before = _SETTINGS.CACHE_DIR
    _SETTINGS.CACHE_DIR = str(folder)
    try:
        return numba.njit(function, cache=True, **options)
    finally:
        _SETTINGS.CACHE_DIR = before


def _folder_of(function: Callable[..., Any], arguments: tuple[Any, ...]) -> Path:
    """Return the folder for this version of a function's source."""
    types = {type(value) for value in _flattened(arguments) if hasattr(value, "_fields")}
    files = sorted({__file__, *_files_of(function), *map(inspect.getfile, types)})
    content = hashlib.blake2b(numba.__version__.encode(), digest_size=8)
    for file in files:
        content.update(_digest(file))
    root = Path(_SETTINGS.CACHE_DIR) if _SETTINGS.CACHE_DIR else cache_folder() / "loops"
    return root / f"{function.__module__}.{function.__name__}-{content.hexdigest()}"


def _flattened(values: tuple[Any, ...]) -> Iterator[Any]:
    """Yield tuples within tuples, the outer ones first."""
    for value in values:
        if isinstance(value, tuple):
            yield value
            yield from _flattened(value)


@cache
def _files_of(function: Callable[..., Any]) -> frozenset[str]:
    """Return the files of a function and, recursively, of the parts and named tuples in its module."""
    files, modules, waiting = set[str](), set[str](), [function]
    while waiting:
        part = waiting.pop()
        files.add(inspect.getfile(part))
        if part.__module__ in modules:
            continue
        modules.add(part.__module__)
        for value in part.__globals__.values():
            if hasattr(value, "py_func"):  # numba's
                waiting.append(value.py_func)
            elif isinstance(value, tuple) and hasattr(value, "_fields"):
                files.add(inspect.getfile(type(value)))
    return frozenset(files)


@cache
def _digest(file: str) -> bytes:
    """Return the hash of a file's content."""
    return hashlib.blake2b(Path(file).read_bytes(), digest_size=8).digest()


@contextmanager
def _clock_stopped() -> Iterator[None]:
    """Exclude the time within the context from time limits."""
    begun = time.monotonic()
    try:
        yield
    finally:
        Clock.compiling += time.monotonic() - begun


@contextmanager
def _collection_paused() -> Iterator[None]:
    """Pause the garbage collector, which would find nothing and take a tenth of the time."""
    collected = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if collected:
            gc.enable()


@cache
def _announce(root: Path) -> None:
    """Log once a process that a loop is compiled: that takes seconds."""
    logging.getLogger(__name__).warning(
        "compiling bpnp's loops, which takes some seconds once an installation; they are kept in %s", root
    )
