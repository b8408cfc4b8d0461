"""Work on the CPU: how it is shared among threads or processes, and ended when its time is over."""

import math
import os
import signal
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import ContextDecorator
from dataclasses import dataclass
from functools import lru_cache
from multiprocessing.context import ForkContext, ForkProcess
from typing import Any, TypeVar

import torch
from threadpoolctl import ThreadpoolController, threadpool_limits

Result = TypeVar("Result")
_work: dict[str, Callable[[int], Any]] = {}  # of a worker process


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


def in_processes(work: Callable[[int], Result], items: Sequence[int], count: int) -> Iterator[tuple[int, Result]]:
    """Give items and work(item) from `count` forks of this process, each with one thread, in the order they end.

    For work that is mostly Python, which threads would run one after the other. The forks, and no other children of
    the process, end with the iteration.

    Raises:
        Exception: what a worker raises.
        RuntimeError: a worker was killed.
    """
    context = _Recording()
    pool = ProcessPoolExecutor(min(count, len(items)), context, initializer=_begin, initargs=(work,))
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)  # other threads: none has a lock that workers take
            running = {pool.submit(_run, item): item for item in items}
        for done in as_completed(running):
            yield running[done], done.result()
    except BrokenProcessPool as error:
        raise RuntimeError(
            "a process that solved problems was killed, possibly out of memory; try fewer threads "
            "(torch.set_num_threads, OMP_NUM_THREADS)"
        ) from error
    finally:
        for worker in context.started:
            worker.kill()  # what they work on is not waited for
        pool.shutdown(cancel_futures=True)


class _Recording(ForkContext):
    """A context that records the processes it starts."""

    def __init__(self) -> None:
        super().__init__()
        self.started: list[ForkProcess] = []

    def Process(self, *arguments: Any, **options: Any) -> ForkProcess:  # type: ignore[override]
        self.started.append(ForkProcess(*arguments, **options))
        return self.started[-1]


def _begin(work: Callable[[int], Any]) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent ends its workers
    torch.set_num_threads(1)
    threadpool_limits(1)  # numpy's BLAS has threads of its own, which would wait for each other's cores
    _work["work"] = work


def _run(item: int) -> Any:
    return _work["work"](item)


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
