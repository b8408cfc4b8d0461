"""Loops on the CPU: how they are compiled, and how they are shared among threads."""

import inspect
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from typing import Any

import numba
import torch


def compiler(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """A decorator: compile at the first call, keep the result on disk, and hold no lock while it runs.

    A function is compiled without the wrappers that a type checker puts around it when it is imported.
    options: of `numba.njit`.
    """
    return lambda function: numba.njit(inspect.unwrap(function), nogil=True, cache=True, **options)


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
