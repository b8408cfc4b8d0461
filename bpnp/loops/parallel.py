"""Threads and time limits of work on the CPU."""

import math
import os
import sys
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import ContextDecorator
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

from threadpoolctl import ThreadpoolController


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
    """Call work(first, last) on consecutive parts of range(count), one a thread, and wait for all of them.

    Only work that releases the GIL gains, such as numba's `nogil` functions. Each call writes to its own part of an
    array. Python's threads are used because numba's pool does not survive the fork of a data loader's workers.

    Args:
        work: Called with the first index and the index after the last.
        count: Number of items; at most `thread_count` parts are formed, none of them empty.
    """
    shares = max(1, min(thread_count(), count))
    if shares == 1:
        work(0, count)
        return
    edges = [count * k // shares for k in range(shares + 1)]
    others = [_pool(os.getpid()).submit(work, *edge) for edge in zip(edges[1:-1], edges[2:], strict=True)]
    work(*edges[:2])
    for other in others:
        other.result()


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
    """Time to stop.

    A stage that has begun completes its current item and drops the rest.

    Attributes:
        at: Seconds of `Clock`; infinite for no deadline.
    """

    at: float = math.inf

    @classmethod
    def after(cls, seconds: float | None) -> "Deadline":
        """Return the deadline after a number of seconds; None for no deadline."""
        return cls() if seconds is None else cls(Clock.now() + seconds)

    def passed(self) -> bool:
        """Return whether the deadline is over."""
        return Clock.now() >= self.at


def in_time(work: Callable[[int, int], None], count: int, deadline: Deadline, at_once: int) -> int:
    """Run work(first, last) on parts of range(count) in threads until a deadline.

    Args:
        work: Called with the first index and the index after the last.
        count: Number of items.
        deadline: When to stop.
        at_once: Items between checks of the deadline; the first `at_once` are always done.

    Returns:
        The number of items done.
    """
    step = count if math.isinf(deadline.at) else at_once
    done = 0
    while done < count and not (done and deadline.passed()):
        last = min(done + step, count)
        in_threads(lambda i, j, first=done: work(first + i, first + j), last - done)  # type: ignore[misc]
        done = last
    return done


NEVER = Deadline()
