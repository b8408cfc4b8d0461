"""Problems shared among processes: much of a search is Python, which threads would run one after the other."""

import multiprocessing
import signal
import warnings
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from typing import Any, TypeVar

import torch
from threadpoolctl import threadpool_limits

Result = TypeVar("Result")
_work: dict[str, Callable[[int], Any]] = {}  # of a worker


def in_processes(work: Callable[[int], Result], items: Sequence[int], count: int) -> Iterator[tuple[int, Result]]:
    """Items and work(item) in `count` forks of this process, each with one thread; in the order they end.

    Raises what a worker raises, and RuntimeError if one is killed; all of them end with the iteration.
    """
    others, context = multiprocessing.active_children(), multiprocessing.get_context("fork")
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
        for worker in set(multiprocessing.active_children()) - set(others):
            worker.kill()  # what they work on is not waited for
        pool.shutdown(cancel_futures=True)


def _begin(work: Callable[[int], Any]) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent ends its workers
    torch.set_num_threads(1)
    threadpool_limits(1)  # numpy's BLAS has threads of its own, which would wait for each other's cores
    _work["work"] = work


def _run(item: int) -> Any:
    return _work["work"](item)
