"""Problems shared among processes: much of a search is Python, which threads would run one after the other."""

import multiprocessing
import multiprocessing.process
import signal
import warnings
from collections.abc import Callable, Iterator, Sequence
from multiprocessing.connection import Connection, wait
from typing import Any, TypeVar

import torch
from threadpoolctl import threadpool_limits

Result = TypeVar("Result")
Progress = Callable[[int, int, float], None]  # problem, batches of starts so far, seconds


def in_processes(
    work: Callable[[int, Progress], Result], items: Sequence[int], count: int, tell: Progress
) -> Iterator[tuple[int, Result]]:
    """work(item, tell) of all items in `count` forks of this process, each with one thread; in the order they end.

    Each takes the next item when it is done with one. tell: called in this process with the arguments of each call in
    a worker. Raises what a worker raises, and RuntimeError if one is killed; all of them end with the iteration.
    """
    context = multiprocessing.get_context("fork")
    ticket = context.Value("q", 0)
    workers: dict[Any, multiprocessing.process.BaseProcess] = {}  # by the end of their pipe
    content: Any
    try:
        for _ in range(min(count, len(items))):
            here, there = context.Pipe(duplex=False)
            worker = context.Process(target=_run, args=(work, items, ticket, there), daemon=True)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", DeprecationWarning)  # other threads: none has a lock that workers take
                worker.start()
            there.close()  # else its end would not be seen
            workers[here] = worker
        missing = len(items)
        while missing:
            connections: list[Any] = wait(list(workers))
            for connection in connections:
                try:
                    kind, content = connection.recv()
                except EOFError:
                    ended = workers.pop(connection)
                    ended.join()
                    if ended.exitcode or not workers:
                        raise RuntimeError(
                            f"a process that solved problems ended with status {ended.exitcode}, possibly out of "
                            "memory; try fewer threads (torch.set_num_threads, OMP_NUM_THREADS)"
                        ) from None
                    continue
                if kind == "told":
                    tell(*content)
                elif kind == "failed":
                    raise content
                else:
                    missing -= 1
                    yield content
    finally:
        for each in workers.values():
            each.kill()  # a library may have replaced the handler of SIGTERM
            each.join()


def _run(work: Callable[..., Any], items: Sequence[int], ticket: Any, results: Connection) -> None:
    """Work on the next item until there is none."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent ends its workers
    torch.set_num_threads(1)
    threadpool_limits(1)  # numpy's BLAS has threads of its own, which would wait for each other's cores
    try:
        while True:
            with ticket.get_lock():
                place, ticket.value = ticket.value, ticket.value + 1
            if place >= len(items):
                return
            result = work(items[place], lambda *content: results.send(("told", content)))
            results.send(("done", (items[place], result)))
    except BrokenPipeError:  # the parent is gone
        return
    except Exception as error:  # noqa: BLE001, raised again by the parent
        results.send(("failed", error))
