"""Threads, time limits and compiled loops on the CPU."""

import gc
import hashlib
import inspect
import logging
import math
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ContextDecorator, ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from functools import cache, lru_cache, update_wrapper, wraps
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import numba
import numpy as np
from threadpoolctl import ThreadpoolController

from bpnp.files import cache_folder, lock_folder


def thread_count() -> int:
    """Return the number of threads that the compiled loops use.

    It is torch's number if torch is loaded (`torch.set_num_threads`), else OMP_NUM_THREADS, else the number of CPUs
    that this process may use. Results do not depend on it.
    """
    of_torch = getattr(sys.modules.get("torch"), "get_num_threads", None)
    if of_torch is not None:
        return int(of_torch())
    wanted = os.environ.get("OMP_NUM_THREADS", "").split(",")[0].strip()
    if wanted.isdecimal() and int(wanted):
        return int(wanted)
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def in_threads(work: Callable[[int, int], object], count: int) -> None:
    """Call work(first, last) on at most `thread_count` consecutive parts of range(count), and wait for all of them.

    Only work that releases the GIL gains, such as numba's `nogil` functions. Each call reads numpy arrays and writes to
    its own part of one. A tensor is a TypeError, with one thread too: a thread starts without the inference mode, grad
    mode, autocast, default type and default device of its caller. Python's threads are used because numba's pool does
    not survive the fork of a data loader's workers.
    """
    if (name := _tensor_of(work)) is not None:
        raise TypeError(f"the tensor {name!r} is used in threads; pass its numpy array")
    shares = max(1, min(thread_count(), count))
    if shares == 1:
        work(0, count)
        return
    edges = [count * k // shares for k in range(shares + 1)]
    others = [_pool(os.getpid()).submit(work, *edge) for edge in zip(edges[1:-1], edges[2:], strict=True)]
    work(*edges[:2])
    for other in others:
        other.result()


def _tensor_of(work: Callable[..., object]) -> str | None:
    """Return the name of a tensor that a function, or a function that it calls by closure, refers to, or None."""
    torch, waiting, seen = sys.modules.get("torch"), [work], set[int]()
    while torch is not None and waiting:
        function = inspect.unwrap(waiting.pop())  # without a type checker's wrapper
        if id(function) in seen or not inspect.isfunction(function):
            continue
        seen.add(id(function))
        cells = zip(function.__code__.co_freevars, function.__closure__ or (), strict=True)
        values = [(name, value) for name, cell in cells for value in _members(cell)]
        values += [("a default", value) for value in function.__defaults__ or ()]
        waiting += [value for _, value in values if callable(value)]
        found = next((name for name, value in values if isinstance(value, torch.Tensor)), None)
        if found is not None:
            return found
    return None


def _members(cell: Any) -> tuple[Any, ...]:
    """Return the value of a closure's cell, or the members of a tuple or list in it; nothing for an empty cell."""
    try:
        value = cell.cell_contents
    except ValueError:
        return ()
    return tuple(value) if isinstance(value, tuple | list) else (value,)


@lru_cache(1)
def _pool(process: int) -> ThreadPoolExecutor:
    """Return the threads of a process; a fork does not inherit those of its parent."""
    return ThreadPoolExecutor(os.cpu_count(), f"bpnp-{process}")


class _OneBlasThread(ContextDecorator):
    """Context that limits BLAS to one thread, and restores the limit when its last concurrent user leaves.

    The products of a search are small: threads waiting for the next one would take several times as long as the search.
    """

    lock, users = threading.Lock(), 0
    limit: Any = None

    def __enter__(self) -> None:
        with self.lock:
            if not self.users:
                self.limit = _blas().limit(limits=1)
            self.users += 1

    def __exit__(self, *exception: object) -> None:
        with self.lock:
            self.users -= 1
            if not self.users:
                self.limit.restore_original_limits()


@lru_cache(1)
def _blas() -> ThreadpoolController:
    """Return the controller of the loaded BLAS libraries."""
    return ThreadpoolController().select(user_api="blas")


one_blas_thread = _OneBlasThread()
_P = ParamSpec("_P")
_R = TypeVar("_R")


def default_float_errors(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Decorate a function to run with numpy's default for floating-point errors, whatever the caller chose.

    With `numpy.seterr(all="raise")`, an underflow of exp(-x) would end a search.
    """

    @wraps(function)
    def run(*args: _P.args, **options: _P.kwargs) -> _R:
        with np.errstate(divide="warn", over="warn", invalid="warn", under="ignore"):
            return function(*args, **options)

    return run


class Clock:
    """Clock of `time.monotonic` without the seconds in which loops were compiled.

    Compilation happens once an installation and does not count towards a user's time limit. `bpnp.warm_up` compiles in
    advance.
    """

    compiling = 0.0

    @classmethod
    def now(cls) -> float:
        """Return the current time, seconds."""
        return time.monotonic() - cls.compiling


@dataclass(frozen=True)
class Deadline:
    """Time to stop: a stage that has begun completes its current item and drops the rest."""

    at: float = math.inf  # time at which a search stops, seconds of `Clock`; infinite for no deadline
    end: float | None = None  # time at which the verdict and the matching after it stop too; None for `at`
    unfinished: set[str] = field(default_factory=set, compare=False)  # as in `SolutionStats.unfinished`

    @classmethod
    def after(cls, seconds: float | None) -> "Deadline":
        """Return the deadline after a number of seconds; None for no deadline."""
        return cls() if seconds is None else cls(Clock.now() + seconds)

    def before(self, ending: float) -> "Deadline":
        """Return a copy that leaves some seconds, at most half of the time that is left, for the ending."""
        begun = Clock.now()
        at = max(self.at - ending, (begun + self.at) / 2) if self.at > begun else self.at
        return replace(self, at=at, end=self.final)

    def share(self, fraction: float) -> "Deadline":
        """Return a copy for the search that may take a fraction of the time that is left."""
        if math.isinf(self.at):
            return self
        begun = Clock.now()
        return replace(self, at=min(begun + fraction * (self.at - begun), self.at), end=self.final)

    @property
    def final(self) -> float:
        """The time `end`, or `at` without one."""
        return self.at if self.end is None else self.end

    def passed(self, stage: str | None = None) -> bool:
        """Return whether the search has to stop; the stage that this cuts short is noted."""
        return self._is_over(self.at, stage)

    def ended(self, stage: str | None = None) -> bool:
        """Return whether the verdict and the matching have to stop too; the stage that this cuts short is noted."""
        return self._is_over(self.final, stage)

    def _is_over(self, time_to_stop: float, stage: str | None) -> bool:
        is_over = Clock.now() >= time_to_stop
        if is_over and stage is not None:
            self.unfinished.add(stage)
        return is_over


def in_time(work: Callable[[int, int], None], count: int, deadline: Deadline, at_once: int) -> int:
    """Run `in_threads` on parts of range(count) until a deadline, and return the number of items done.

    The deadline is checked every `at_once` items; the first ones are always done.
    """
    step = count if math.isinf(deadline.at) else at_once
    done = 0
    while done < count and not (done and deadline.passed()):
        last = min(done + step, count)
        in_threads(lambda i, j, first=done: work(first + i, first + j), last - done)  # type: ignore[misc]
        done = last
    return done


NEVER = Deadline()


# Options of `fastmath`: sums in any order. NaN and infinity keep their meaning: they mark a lost pose or sample.
FAST = {"reassoc", "contract", "arcp", "nsz"}
_SETTINGS: Any = numba.config  # NUMBA_CACHE_DIR and others, as attributes


def compiler(*, part: bool = False, **options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Return a decorator that makes a `Loop` of a function, or numba's function of a `part`, with options of numba.

    A part is called by compiled functions only, and cached with them. Divisions by zero are infinite, as in C, and the
    GIL is released. A type checker's wrapper around the function is removed.
    """
    options |= {"nogil": True, "error_model": "numpy"}
    if part:
        return lambda function: numba.njit(inspect.unwrap(function), **options)
    return lambda function: Loop(inspect.unwrap(function), options)


class Loop:
    """Function that numba compiles at its first call, once an installation.

    The machine code is kept in ``loops`` in `cache_folder`, or in NUMBA_CACHE_DIR. Each version of the source has its
    own folder there: that of the function, of the parts that it calls and of the named tuples that it takes, and the
    numbers that its module imports. One process compiles; others that need the same loop wait for it. If the folder is
    not writable, or the disk is full, each process compiles.

    With numba's `cache=True` alone, old machine code gives wrong results after an update of a part, a named tuple or a
    number in another file, the import fails where nothing can be written, and a call where the disk is full.
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
            kept = True
            try:
                stack.enter_context(lock_folder(folder, wait=True))
                compiled = _njit_into(folder, self.function, self.options)
            except (OSError, ValueError, RuntimeError):  # not a folder, read-only, or too full for numba
                compiled, kept = numba.njit(self.function, **self.options), False
            if not any(folder.glob("*/*.nbc")):
                _announce(folder.parent, kept)
                stack.enter_context(_collection_paused())
            types = tuple(map(numba.typeof, arguments))
            try:
                compiled.compile(types)
            except OSError:  # a full disk or a quota: the machine code could not be written
                compiled = numba.njit(self.function, **self.options)
                compiled.compile(types)
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
    types = {type(value) for value in _flatten(arguments) if hasattr(value, "_fields")}
    files, numbers = _sources_of(function)
    content = hashlib.blake2b(repr((numba.__version__, sorted(numbers))).encode(), digest_size=8)
    for file in sorted({__file__, *files, *map(inspect.getfile, types)}):
        content.update(_digest(file))
    root = Path(_SETTINGS.CACHE_DIR) if _SETTINGS.CACHE_DIR else cache_folder() / "loops"
    return root / f"{function.__module__}.{function.__name__}-{content.hexdigest()}"


def _flatten(values: tuple[Any, ...]) -> Iterator[Any]:
    """Yield tuples within tuples, the outer ones first."""
    for value in values:
        if isinstance(value, tuple):
            yield value
            yield from _flatten(value)


@cache
def _sources_of(function: Callable[..., Any]) -> tuple[frozenset[str], frozenset[tuple[str, float | int]]]:
    """Return the files, and the numbers by name, of a function and, recursively, of the parts in its module."""
    files, modules, waiting, numbers = set[str](), set[str](), [function], set[tuple[str, float | int]]()
    while waiting:
        part = waiting.pop()
        files.add(inspect.getfile(part))
        if part.__module__ in modules:
            continue
        modules.add(part.__module__)
        for name, value in part.__globals__.items():
            if hasattr(value, "py_func"):  # numba's
                waiting.append(value.py_func)
            elif isinstance(value, tuple) and hasattr(value, "_fields"):
                files.add(inspect.getfile(type(value)))
            elif isinstance(value, int | float):
                numbers.add((f"{part.__module__}.{name}", value))
    return frozenset(files), frozenset(numbers)


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
def _announce(root: Path, kept: bool) -> None:
    """Log once a process that loops are compiled, which takes seconds, and whether the next process finds them."""
    if kept:
        message = "compiling bpnp's loops that are used for the first time (some seconds); they are kept in %s"
    else:
        message = "compiling bpnp's loops (some seconds) in every process, since %s cannot be written; set BPNP_CACHE"
    logging.getLogger(__name__).warning(message, root)
