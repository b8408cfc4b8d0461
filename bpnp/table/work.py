"""Solving the pairs that a table still lacks, in one process or several, each with one thread."""

import multiprocessing
import os
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import nn

from bpnp.report.results import rows_from
from bpnp.table.finished import Finished
from bpnp.table.methods import Method
from bpnp.table.pairs import TestPairs

THREAD_VARIABLES = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")


@dataclass(frozen=True)
class Block:
    """One method on one data set: where its pairs are kept, and which are wanted."""

    method: Method
    data: dict[str, Any]
    folder: Path
    indices: tuple[int, ...]

    @property
    def finished(self) -> Finished:
        return Finished(self.folder)

    @property
    def missing(self) -> list[int]:
        done = self.finished.indices()
        return [index for index in self.indices if index not in done]


class Worker:
    """Solves pairs; keeps the data sets and solvers that it has opened."""

    def __init__(self) -> None:
        self._pairs: dict[str, TestPairs] = {}
        self._solvers: dict[str, nn.Module] = {}

    def solve(self, block: Block, index: int) -> None:
        """Solve one pair, alone in its batch, and keep its rows. The time is the solver's alone."""
        torch.manual_seed(index)
        batch = self._open(block.data)[index]
        solver = self._built(block.method)
        with torch.inference_mode():
            start = time.perf_counter()
            prediction = solver(batch)
            seconds = time.perf_counter() - start
        if not prediction.poses:
            raise ValueError(f"expected a pose from {block.method.label!r}, got a prediction without one")
        block.finished.add(index, rows_from(prediction, batch, seconds))

    def _open(self, data: dict[str, Any]) -> TestPairs:
        key = repr(data)
        if key not in self._pairs:
            self._pairs[key] = TestPairs(data)
        return self._pairs[key]

    def _built(self, method: Method) -> nn.Module:
        key = repr(method)
        if key not in self._solvers:
            self._solvers[key] = method.build()
        return self._solvers[key]


def run(blocks: list[Block], *, processes: int) -> Iterator[str]:
    """Solve all missing pairs; yields the label of the method of each as it is finished.

    Pair by pair through all methods, so that a table cut short has about as many pairs of each. An error of a solver
    ends the run; what is finished stays.
    """
    missing = {id(block): block.missing for block in blocks}
    longest = max((len(block.indices) for block in blocks), default=0)
    tasks = [
        (block, block.indices[i])
        for i in range(longest)
        for block in blocks
        if i < len(block.indices) and block.indices[i] in missing[id(block)]
    ]
    yield from _inline(tasks) if processes == 1 or len(tasks) < 2 else _parallel(tasks, processes)


def _inline(tasks: list[tuple[Block, int]]) -> Iterator[str]:
    worker, threads = Worker(), torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        for block, index in tasks:
            worker.solve(block, index)
            yield block.method.label
    finally:
        torch.set_num_threads(threads)


def _parallel(tasks: list[tuple[Block, int]], processes: int) -> Iterator[str]:
    kept = {name: os.environ.get(name) for name in THREAD_VARIABLES}
    os.environ.update(dict.fromkeys(THREAD_VARIABLES, "1"))  # read when a process starts, by libraries that never ask
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(min(processes, len(tasks)), mp_context=context, initializer=_start)
    try:
        futures = {pool.submit(_solve, block, index): block for block, index in tasks}
        for future in as_completed(futures):
            future.result()
            yield futures[future].method.label
    finally:
        pool.shutdown(cancel_futures=True)
        for name, value in kept.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


_workers: list[Worker] = []  # of this process; one, once it has started


def _start() -> None:
    torch.set_num_threads(1)
    _workers.append(Worker())


def _solve(block: Block, index: int) -> None:
    _workers[0].solve(block, index)
