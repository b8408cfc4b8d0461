"""Testing methods pair by pair, in one process or several of one thread each; what is finished stays."""

import json
import multiprocessing
import os
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import torch
from torch import nn

from bpnp.files import written_whole
from bpnp.report.folder import append_rows, finished_rows, write_results
from bpnp.report.results import PairRow, Results, rows_from, summarise
from bpnp.table.methods import Method
from bpnp.table.pairs import TestPairs

IDENTITY = "method.json"
THREAD_VARIABLES = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")


@dataclass(frozen=True)
class Block:
    """A test of one method on one data set: the folder of its results, and which pairs are wanted."""

    method: Method
    data: dict[str, Any]
    folder: Path
    indices: tuple[int, ...]

    def claim(self) -> None:
        """Start or resume. Raises ValueError if the folder holds results of another method or of other data."""
        path = self.folder / IDENTITY
        identity = json.loads(json.dumps({"method": self.method.identity, "data": self.data}, default=str))
        if not path.is_file():
            with written_whole(path) as temporary:
                temporary.write_text(json.dumps(identity, indent=2) + "\n", encoding="utf-8")
            return
        kept = json.loads(path.read_text(encoding="utf-8"))
        differing = sorted(key for key in identity.keys() | kept.keys() if identity.get(key) != kept.get(key))
        if differing:
            raise ValueError(
                f"expected {self.folder} of the same method and data, got other {', '.join(differing)}; "
                "try another --output"
            )

    def missing(self) -> list[int]:
        """The wanted pairs that are not finished: those that lack an estimate of the others."""
        rows = finished_rows(self.folder)
        estimates = {row.estimate for row in rows}
        known = {(row.index, row.estimate) for row in rows}
        return [i for i in self.indices if not estimates or any((i, name) not in known for name in estimates)]

    def summarise(self) -> Results:
        """Write the results of all finished pairs into the folder and return those of the wanted ones."""
        rows = finished_rows(self.folder)
        write_results(self.folder, rows, settings={"method": self.method.label, "data": self.data})
        wanted = set(self.indices)
        return subset([row for row in rows if row.index in wanted])


def subset(rows: Sequence[PairRow]) -> Results:
    """Results of some rows, not kept on disk."""
    return Results(tuple(rows), summarise(rows), None, {}, "", "")


def run(blocks: Sequence[Block], *, processes: int) -> Iterator[str]:
    """Solve all missing pairs; yields the label of the method of each as it is finished.

    Pair by pair through all methods, so that a table cut short has about as many pairs of each. An error of a solver
    ends the run; what is finished stays.
    """
    missing = {id(block): set(block.missing()) for block in blocks}
    longest = max((len(block.indices) for block in blocks), default=0)
    tasks = [
        (block, block.indices[i])
        for i in range(longest)
        for block in blocks
        if i < len(block.indices) and block.indices[i] in missing[id(block)]
    ]
    alone = processes == 1 or len(tasks) < 2
    for block, rows in _inline(tasks) if alone else _parallel(tasks, processes):
        append_rows(block.folder, rows)
        yield block.method.label


class Worker:
    """Solves pairs; keeps the data sets and solvers that it has opened."""

    def __init__(self) -> None:
        self._pairs: dict[str, TestPairs] = {}
        self._solvers: dict[str, nn.Module] = {}

    def solve(self, block: Block, index: int) -> list[PairRow]:
        """The rows of one pair, alone in its batch. The time is the solver's alone."""
        torch.manual_seed(index)
        batch = self._opened(block.data)[index]
        solver = self._built(block.method)
        with torch.inference_mode():
            start = time.perf_counter()
            prediction = solver(batch)
            seconds = time.perf_counter() - start
        if not prediction.poses:
            raise ValueError(f"expected a pose from {block.method.label!r}, got a prediction without one")
        return rows_from(prediction, batch, seconds)

    def _opened(self, data: dict[str, Any]) -> TestPairs:
        key = repr(data)
        if key not in self._pairs:
            self._pairs[key] = TestPairs(data)
        return self._pairs[key]

    def _built(self, method: Method) -> nn.Module:
        key = repr(method)
        if key not in self._solvers:
            self._solvers[key] = method.build()
        return self._solvers[key]


def _inline(tasks: Sequence[tuple[Block, int]]) -> Iterator[tuple[Block, list[PairRow]]]:
    worker, threads = Worker(), torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        for block, index in tasks:
            yield block, worker.solve(block, index)
    finally:
        torch.set_num_threads(threads)


def _parallel(tasks: Sequence[tuple[Block, int]], processes: int) -> Iterator[tuple[Block, list[PairRow]]]:
    kept = {name: os.environ.get(name) for name in THREAD_VARIABLES}
    os.environ.update(dict.fromkeys(THREAD_VARIABLES, "1"))  # read when a process starts, by libraries that never ask
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(min(processes, len(tasks)), mp_context=context, initializer=_process_worker)
    try:
        futures = {pool.submit(_solve, block, index): block for block, index in tasks}
        for future in as_completed(futures):
            yield futures[future], future.result()
    finally:
        pool.shutdown(cancel_futures=True)
        for name, value in kept.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


@cache
def _process_worker() -> Worker:
    torch.set_num_threads(1)
    return Worker()


def _solve(block: Block, index: int) -> list[PairRow]:
    return _process_worker().solve(block, index)
