"""The files that a test leaves."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch.distributed as dist
from lightning import LightningModule, Trainer
from lightning.pytorch import Callback
from lightning.pytorch.cli import SaveConfigCallback
from lightning.pytorch.utilities.rank_zero import rank_zero_info

from bpnp.report.points import ProblemPoints, points_from, write_points
from bpnp.report.results import SUMMARY, ProblemRow, rows_from, write_results
from bpnp.report.tables import report
from bpnp.training.task import number_globally
from bpnp.types import Batch

RETURNED = 'a dictionary with "prediction", "seconds" and "losses", as BlindPnPTask\'s does'


class ResultsWriter(Callback):
    """Writes `problems.csv`, `summary.json` and points of every problem after a test.

    Args:
        folder: where; null for `test` in the trainer's default_root_dir.
    """

    rows: list[ProblemRow]
    losses: dict[int, float]
    points: list[ProblemPoints]
    numbers: set[int]  # of the problems so far

    settings: Mapping[str, Any] | None = None  # what is recorded in place of the command line's; no table is printed

    def __init__(self, folder: str | None = None) -> None:
        self.folder = folder

    def on_test_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self.rows, self.losses, self.points, self.numbers = [], {}, [], set()
        self._check_replaced(trainer)

    def on_test_batch_start(
        self, trainer: Trainer, pl_module: LightningModule, batch: Any, batch_idx: int, *_: int
    ) -> None:
        if isinstance(batch, Batch):  # else of a task of the user's own
            number_globally(batch, self.numbers, processes=trainer.world_size)

    def on_test_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int, *_: int
    ) -> None:
        if not isinstance(outputs, dict) or not {"prediction", "seconds", "losses"} <= outputs.keys():
            return  # of a task of the user's own
        self.rows += rows_from(outputs["prediction"], batch, outputs["seconds"])
        self.points += points_from(outputs["prediction"], batch)
        if outputs["losses"] is not None:
            self.losses |= dict(zip(batch.index.tolist(), outputs["losses"].tolist(), strict=True))

    def on_test_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        gathered = _gather((self.rows, self.losses, self.points))
        tabled = getattr(pl_module, "tabled", ())
        others = {name: value for name, value in trainer.callback_metrics.items() if name not in tabled}
        logged = ", ".join(f"{name} {float(value):.6g}" for name, value in others.items())
        if any(rows for rows, *_ in gathered):
            self._write_test(trainer, gathered, complete=True)
            if logged:
                rank_zero_info(f"logged: {logged}")
        else:
            rank_zero_info(f"logged: {logged or 'nothing'}; no results folder: `test_step` does not return {RETURNED}")

    def on_exception(self, trainer: Trainer, pl_module: LightningModule, exception: BaseException) -> None:
        """Of an interrupted test the problems that are finished; of several processes those of the first."""
        if isinstance(exception, KeyboardInterrupt) and trainer.state.fn == "test" and self.rows:
            self._write_test(trainer, [(self.rows, self.losses, self.points)], complete=False)

    def _write_test(self, trainer: Trainer, gathered: Sequence[Any], *, complete: bool) -> None:
        if trainer.is_global_zero:
            rows = [row for part, _, _ in gathered for row in part]
            losses = {index: loss for _, part, _ in gathered for index, loss in part.items()}
            mean = sum(losses[i] for i in sorted(losses)) / len(losses) if losses else None
            folder = self._folder(trainer)
            settings = _settings(trainer) if self.settings is None else self.settings
            write_results(folder, rows, correspondence_loss=mean, settings={**settings, "complete": complete})
            write_points(folder, (problem for *_, part in gathered for problem in part))
            if self.settings is None:
                report([folder])
            count = len({row.index for row in rows})
            rank_zero_info(f"{'' if complete else 'interrupted: '}results of {count} problems in {folder}")

    def _check_replaced(self, trainer: Trainer) -> None:
        """Raises ValueError if results of a checkpoint would be replaced by those of a test without one."""
        summary = self._folder(trainer) / SUMMARY
        if self.settings is None and trainer.ckpt_path is None and summary.is_file():
            checkpoint = json.loads(summary.read_bytes()).get("settings", {}).get("checkpoint")
            if checkpoint is not None:
                raise ValueError(
                    f"expected --ckpt_path, since {summary.parent} has the results of {checkpoint}, got none, which "
                    "would replace them; try --ckpt_path last, or --results.folder for another folder"
                )

    def _folder(self, trainer: Trainer) -> Path:
        return Path(self.folder) if self.folder else Path(trainer.default_root_dir) / "test"


def _settings(trainer: Trainer) -> dict[str, Any]:
    """The checkpoint; of a test from the command line also its data and solver."""
    saved = next((each.config for each in trainer.callbacks if isinstance(each, SaveConfigCallback)), None)  # type: ignore[attr-defined]
    config = {} if saved is None else saved.as_dict()
    checkpoint = str(trainer.ckpt_path) if trainer.ckpt_path else None
    return {"checkpoint": checkpoint, "data": config.get("data"), "solver": config.get("model", {}).get("solver")}


def _gather(value: Any) -> list[Any]:
    """The value of every process, in the order of their ranks."""
    if not dist.is_initialized():
        return [value]
    values = [None] * dist.get_world_size()
    dist.all_gather_object(values, value)
    return values
