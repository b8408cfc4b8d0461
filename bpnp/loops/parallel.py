"""Work on the CPU: how it is shared among threads, and ended when its time is over."""

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
    """Return how many threads the compiled loops use.

    torch's own number where torch is loaded (`torch.set_num_threads`); else OMP_NUM_THREADS, else the CPUs that this
    process may use. Results do not depend on it.
    """
    of_torch = getattr(sys.modules.get("torch"), "get_num_threads", None)
    if of_torch is not None:
        return int(of_torch())
    wanted = os.environ.get("OMP_NUM_THREADS", "").split(",")[0].strip()
    if wanted.isdecimal() and int(wanted):
        return int(wanted)
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def in_threads(work: Callable[[int, int], object], count: int) -> None:
    """Call work(first, last) on consecutive shares of range(count), one a thread, and wait for all of them.

    Uses `thread_count` threads, and no empty share. Only work that releases the GIL gains, as numba's `nogil` functions
    do; it writes to its own share of an array. Python's threads and not a pool of numba's: that one does not survive
    the fork of a data loader's workers.
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
    """The threads of a process; a fork inherits none of its parent's, so each has its own."""
    return ThreadPoolExecutor(os.cpu_count(), f"bpnp-{process}")


class _OneBlasThread(ContextDecorator):
    """numpy's and scipy's products on one thread meanwhile, then on as many as before, whoever of several ends last.

    Those of a search are small: threads that wait for the next one would take several times as long as the search.
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
    return ThreadpoolController().select(user_api="blas")


one_blas_thread = _OneBlasThread()


class Clock:
    """Seconds of `time.monotonic`, without those in which loops were compiled: that happens once an installation, and a
    limit that a user sets is for what comes after. `bpnp.warm_up` compiles before."""

    compiling = 0.0

    @classmethod
    def now(cls) -> float:
        return time.monotonic() - cls.compiling


@dataclass(frozen=True)
class Deadline:
    """When to stop, in seconds of `Clock`. A stage that has begun ends what it is at and drops the rest."""

    at: float = math.inf

    @classmethod
    def after(cls, seconds: float | None) -> "Deadline":
        """Return the deadline after a number of seconds; None for no deadline."""
        return cls() if seconds is None else cls(Clock.now() + seconds)

    def passed(self) -> bool:
        return Clock.now() >= self.at


def in_time(work: Callable[[int, int], None], count: int, deadline: Deadline, at_once: int) -> int:
    """Run work(first, last) on shares of range(count) in threads; how many were done when the deadline passed.

    The first `at_once` are always done.
    """
    step = count if math.isinf(deadline.at) else at_once
    done = 0
    while done < count and not (done and deadline.passed()):
        last = min(done + step, count)
        in_threads(lambda i, j, first=done: work(first + i, first + j), last - done)  # type: ignore[misc]
        done = last
    return done


NEVER = Deadline()
