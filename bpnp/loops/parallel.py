"""Loops on the CPU: how they are shared among threads, and ended when their time is over."""

import math
import os
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import ContextDecorator
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import torch
from threadpoolctl import ThreadpoolController


def in_threads(work: Callable[[int, int], object], count: int) -> None:
    """Call work(first, last) on consecutive shares of range(count), one a thread, and wait for all of them.

    As many threads as torch has (`torch.set_num_threads`, OMP_NUM_THREADS), and no empty share. Only
    work that gives the GIL back gains, as numba's `nogil` functions do; it writes to its own share of an array.
    Python's threads and not a pool of numba's: that one does not survive the fork of a loader's workers.
    """
    shares = max(1, min(torch.get_num_threads(), count))
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
        """So many seconds from now; None: never."""
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
