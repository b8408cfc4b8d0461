"""A table is a loop over `test`: methods in turns, some pairs at a time, in one process or several of one thread.

Finished pairs are in the results folders at once, so that a run that is stopped or killed loses none of them.
"""

import logging
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from lightning import LightningModule, Trainer
from lightning.pytorch import Callback
from torch.utils.data import DataLoader

from bpnp.files import keep_settings
from bpnp.report.folder import append_rows, finished_rows, write_results
from bpnp.report.results import Results, rows_from, summarise
from bpnp.report.samples import PairView, read_views, select_views, thin, views_from, write_views
from bpnp.solving.processes import in_processes
from bpnp.table.methods import Method
from bpnp.table.pairs import TestPairs
from bpnp.training.callbacks import interruptible
from bpnp.training.task import BlindPnPTask

IDENTITY = "method.json"
ROUNDS = 50  # turns in which a method is given its pairs, so that a table cut short has about as many of each
LEAST = 4  # pairs of a turn, unless fewer are left


@dataclass(frozen=True)
class Block:
    """A test of one method on one data set: the folder of its results, and which pairs are wanted."""

    method: Method
    data: dict[str, Any]
    folder: Path
    indices: tuple[int, ...]

    def claim(self) -> None:
        """Start or resume. Raises ValueError if the folder holds results of another method or of other data."""
        keep_settings(self.folder / IDENTITY, {"method": self.method.identity, "data": self.data})

    def missing(self) -> list[int]:
        """The wanted pairs that are not finished: those that lack an estimate of the others."""
        rows = finished_rows(self.folder)
        estimates = {row.estimate for row in rows}
        known = {(row.index, row.estimate) for row in rows}
        return [i for i in self.indices if not estimates or any((i, name) not in known for name in estimates)]

    def keep(self, views: Sequence[PairView]) -> None:
        """Add views to those of the folder; the worst pairs and some others have many points, as after a test."""
        every = [*views, *read_views(self.folder)]
        write_views(self.folder, [*select_views(every), *map(thin, every)])

    def summarise(self) -> Results:
        """Write the results of all finished pairs into the folder and return those of the wanted ones."""
        rows = finished_rows(self.folder)
        settings: dict[str, Any] = {
            "solver": {"class_path": self.method.class_path, "init_args": self.method.init_args}
        }
        settings |= {"data": self.data, "checkpoint": self.method.checkpoint, "method": self.method.label}
        write_results(self.folder, rows, settings=settings)
        wanted = tuple(row for row in rows if row.index in set(self.indices))
        return Results(wanted, summarise(wanted), None, settings, "", "")


Job = tuple[Block, list[int]]


def run(blocks: Sequence[Block], *, processes: int) -> Iterator[int]:
    """Test all missing pairs; yields how many were tested, again and again.

    The methods take turns. An error of a solver ends the run; what is finished stays.
    """
    turns: list[list[Job]] = [[] for _ in range(ROUNDS)]
    for block in blocks:
        missing = block.missing()
        size = max(LEAST, -(-len(missing) // ROUNDS))
        for k in range(0, len(missing), size):
            turns[k // size].append((block, missing[k : k + size]))
    jobs = [job for turn in turns for job in turn]
    tester, threads = Tester(), torch.get_num_threads()

    def test(place: int, _: Any) -> list[PairView]:
        return tester.test(*jobs[place])

    torch.set_num_threads(1)
    places = range(len(jobs))
    alone = ((place, test(place, None)) for place in places)
    try:
        for place, views in in_processes(test, places, processes, tell=_ignored) if processes > 1 else alone:
            block, indices = jobs[place]
            block.keep(views)
            yield len(indices)
    finally:
        torch.set_num_threads(threads)


def _ignored(*_: Any) -> None:
    """Workers say nothing while they test."""


class PairKeeper(Callback):
    """Adds the rows of each tested pair to the results folder before the next pair is solved."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.views: list[PairView] = []

    def on_test_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, *_: Any
    ) -> None:  # fmt: skip
        if not outputs["prediction"].poses:
            raise ValueError(f"expected a pose from {self.folder.name!r}, got a prediction without one")
        append_rows(self.folder, rows_from(outputs["prediction"], batch, outputs["seconds"]))
        self.views += views_from(outputs["prediction"], batch)


class Tester:
    """Tests pairs; keeps the data sets and solvers that it has opened."""

    def __init__(self) -> None:
        self._pairs: dict[str, TestPairs] = {}
        self._tasks: dict[str, BlindPnPTask] = {}

    def test(self, block: Block, indices: Sequence[int]) -> list[PairView]:
        """`test` some pairs, each alone in its batch, so that its time is its own; their rows go into the folder."""
        keeper, pairs = PairKeeper(block.folder), self._opened(block.data)
        loader = DataLoader(pairs.dataset, sampler=[[(0, i)] for i in indices], batch_size=None)
        with quiet():
            trainer = Trainer(
                accelerator="cpu", devices=1, callbacks=[keeper], logger=False, enable_checkpointing=False,
                enable_progress_bar=False, enable_model_summary=False,
            )  # fmt: skip
            with interruptible(trainer):
                trainer.test(self._built(block.method), loader, verbose=False)
        return keeper.views

    def _opened(self, data: dict[str, Any]) -> TestPairs:
        if (key := repr(data)) not in self._pairs:
            self._pairs[key] = TestPairs(data)
        return self._pairs[key]

    def _built(self, method: Method) -> BlindPnPTask:
        if (key := repr(method)) not in self._tasks:
            torch.manual_seed(0)  # of a network without a checkpoint: its weights are the same in every process
            self._tasks[key] = BlindPnPTask(method.build())
        return self._tasks[key]


@contextmanager
def quiet() -> Iterator[None]:
    """No messages of the trainer's, which would repeat for every turn, nor its advice."""
    logger = logging.getLogger("lightning.pytorch")
    before = logger.level
    logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            for advice in (".*does not have many workers.*", ".*LeafSpec.*"):
                warnings.filterwarnings("ignore", message=advice)
            yield
    finally:
        logger.setLevel(before)
