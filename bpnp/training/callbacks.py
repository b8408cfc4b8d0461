"""Callbacks of a training and of a test: the pose loss warm-up, progress, monitoring, and the results files."""

import json
import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
from lightning import LightningModule, Trainer
from lightning.pytorch import Callback
from lightning.pytorch.cli import SaveConfigCallback
from lightning.pytorch.utilities.rank_zero import rank_zero_info, rank_zero_warn
from torch import Tensor, nn

from bpnp.bounded_files import read_json
from bpnp.checks import check_within
from bpnp.models.nets import subtract_mean
from bpnp.models.refinement import refinement_enabled
from bpnp.report.points import ProblemPoints, points_from, write_points
from bpnp.report.results import SUMMARY, ProblemRow, rows_from, write_results
from bpnp.report.tables import read_runs, results_table
from bpnp.report.terminal import console, say
from bpnp.training.predictions import folder_of_loader, gather_objects
from bpnp.training.task import BlindPnPTask, number_globally
from bpnp.types import Batch, Prediction, map_tensors

WARMUP = "PoseLossWarmup"  # its state in a checkpoint, also of subclasses, so that one can continue another's
COLLAPSED = 0.05  # spread of unit features below which the assignment is nearly uniform
LINE = ("train/loss", "val/correspondence_loss", "val/pnp/rotation_q2_deg", "val/pnp/translation_q2")  # per epoch
RETURNED = 'a dictionary with "prediction", "seconds" and "losses", as BlindPnPTask\'s does'


class PoseLossWarmup(Callback):
    """Switch from L_c alone to L_c + weight * L_p at an epoch (paper section 3.5).

    Before the switch, training computes no pose, unless the solver has no `match` or the task's `loss` needs a pose. A
    run resumed after the switch stays switched.

    Args:
        start_epoch: First epoch with the pose loss, counted from 0; 120 in the paper.
        weight: gamma_p of Eq. 15. Default: None, the `pose_weight` of the task, or 1 if that is 0.
    """

    def __init__(self, start_epoch: int = 120, weight: float | None = None) -> None:
        check_within(0, math.inf, start_epoch=start_epoch)
        if weight is not None:
            check_within(0, math.inf, weight=weight)
        self.start_epoch, self.weight = start_epoch, weight
        self.switched_at: int | None = None
        self.configured: float | None = None  # `pose_weight` of the task

    @property
    def state_key(self) -> str:
        """Key of the state in a checkpoint."""
        return WARMUP

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Forget the switch and the weight of an earlier training."""
        if stage == "fit":
            self.switched_at = self.configured = None

    def on_fit_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Read the weight of the task.

        Raises:
            ValueError: The module has no `pose_weight`, or one that is neither 0 nor `weight`; or the solver does not
                return the pose "pnp" that the loss needs.
        """
        configured = getattr(pl_module, "pose_weight", None)
        if not isinstance(configured, float | int):
            raise ValueError(f"PoseLossWarmup sets `pose_weight`, which {type(pl_module).__name__} does not have.")
        self.configured = float(configured)
        if self.weight is not None and self.configured not in (0.0, self.weight):
            raise ValueError(
                f"model.pose_weight is {self.configured:g} and the weight of PoseLossWarmup is {self.weight:g}. "
                "Set one of them (--model.pose_weight or --pose_loss.weight)."
            )
        if isinstance(pl_module, BlindPnPTask) and (estimates := pl_module.estimates["test"]):
            pl_module.check_pose_loss(estimates)
        if self.switched_at is None and self._ends_before(trainer):
            rank_zero_warn(
                f"The pose loss joins at epoch {self.start_epoch}, and the training ends after {trainer.max_epochs} "
                "epochs without it."
            )

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Set the weight of the first epoch: Lightning does not start an epoch again that it resumes within."""
        self.on_train_epoch_start(trainer, pl_module)

    def on_train_epoch_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Set the weight of this epoch."""
        weight = self.weight if self.weight is not None else self.configured or 1.0
        if self.switched_at is None and trainer.current_epoch >= self.start_epoch:
            self.switched_at = trainer.current_epoch
            rank_zero_info(f"Epoch {trainer.current_epoch}: the pose loss joins with weight {weight:g}.")
        pl_module.pose_weight = 0.0 if self.switched_at is None else weight  # type: ignore[assignment]

    def on_fit_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Restore the weight of the task, for another `fit`; warn if the pose loss has not joined yet."""
        pl_module.pose_weight = self.configured  # type: ignore[assignment]
        if self.switched_at is None and not self._ends_before(trainer) and not trainer.fast_dev_run:  # type: ignore[attr-defined]
            rank_zero_warn(
                f"The training has ended before epoch {self.start_epoch}, at which the pose loss joins. Use a smaller "
                "start_epoch, or a later end (max_steps, max_time, early stopping)."
            )

    def on_exception(self, trainer: Trainer, pl_module: LightningModule, exception: BaseException) -> None:
        """Restore the weight of the task after a training that was stopped."""
        if trainer.state.fn == "fit" and self.configured is not None:
            pl_module.pose_weight = self.configured  # type: ignore[assignment]

    def _ends_before(self, trainer: Trainer) -> bool:
        """Return True if the last epoch of the trainer is before the switch."""
        return 0 <= (trainer.max_epochs or -1) <= self.start_epoch and not trainer.fast_dev_run  # type: ignore[attr-defined]

    def state_dict(self) -> dict[str, Any]:
        """Return the epoch of the switch and the options."""
        return {"switched_at": self.switched_at, "start_epoch": self.start_epoch, "weight": self.weight}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore the epoch of the switch, and print options that differ from the saved ones."""
        self.switched_at = state_dict["switched_at"]
        for name in ("start_epoch", "weight"):
            saved, own = state_dict[name], getattr(self, name)
            if saved != own:
                rank_zero_info(f"The pose loss has {name}={own} (saved: {saved}).")


class ProgressLines(Callback):
    """Print a line after each epoch of a training and after each tenth of a test or prediction.

    It replaces the progress bar where output is not a terminal.
    """

    validated = False  # True if the current epoch has a validation

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Note that the metrics are of this epoch."""
        self.validated = True

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Print the epoch, the step and the main metrics, those of a validation only if the epoch had one."""
        known = [name for name in trainer.callback_metrics if self.validated or not name.startswith("val/")]
        self.validated = False
        names = [name for name in LINE if name in known] or known[:4]
        values = ", ".join(f"{name} {float(trainer.callback_metrics[name]):.4g}" for name in names)
        last = f"/{trainer.max_epochs}" if (trainer.max_epochs or 0) > 0 else ""
        self._print(trainer, f"epoch {trainer.current_epoch + 1}{last}, step {trainer.global_step}: {values}")

    def on_test_batch_end(
        self,
        trainer: Trainer,
        pl_module: LightningModule,
        outputs: Any,
        batch: Any,
        batch_idx: int,
        dataloader_idx: int = 0,
    ) -> None:
        """Print the number of finished batches after each tenth."""
        self._print_tenth(trainer, batch_idx, dataloader_idx, trainer.num_test_batches)

    def on_predict_batch_end(
        self,
        trainer: Trainer,
        pl_module: LightningModule,
        outputs: Any,
        batch: Any,
        batch_idx: int,
        dataloader_idx: int = 0,
    ) -> None:
        """Print the number of finished batches after each tenth."""
        self._print_tenth(trainer, batch_idx, dataloader_idx, trainer.num_predict_batches)

    def _print_tenth(self, trainer: Trainer, batch_idx: int, loader: int, counts: Sequence[int | float]) -> None:
        """Print the number of finished batches of all loaders, if it has reached a tenth of their `counts`."""
        done, total = sum(counts[:loader]) + batch_idx + 1, sum(counts)
        if done * 10 // total > (done - 1) * 10 // total:
            self._print(trainer, f"{done} of {total} batches")

    def _print(self, trainer: Trainer, line: str) -> None:
        if trainer.is_global_zero:
            say(line)
            sys.stdout.flush()


class ParameterCount(Callback):
    """Print how many parameters each part of the solver has when a training starts."""

    def on_fit_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Print the numbers of parameters: all, trained, and of each part with any."""
        if not trainer.is_global_zero:
            return
        solver = getattr(pl_module, "solver", pl_module)
        parts = {name: sum(p.numel() for p in part.parameters()) for name, part in solver.named_children()}
        total, trained = (
            sum(p.numel() for p in pl_module.parameters() if p.requires_grad or not only) for only in (False, True)
        )
        listed = ", ".join(f"{name} {count:,}" for name, count in parts.items() if count)
        say(f"{type(solver).__name__}: {total:,} parameters, {trained:,} trained ({listed})")


class TrainingMonitor(Callback):
    """Log values of the first few validation problems that show the progress of a training.

    "val/true_match_mass" is the sum of the probabilities P of the true matches, at most 1. "val/<estimate>_iterations"
    is the number of iterations of a pose. "val/feature_spread_2d" and "val/feature_spread_3d" are `feature_spreads`.
    Each is a mean over the problems. A spread below 0.05 causes a warning: if all points of a set have the same
    feature, the assignment is uniform and the loss does not change.

    Args:
        problems: Number of validation problems, default 4. They come from the first validation batch, so its size is
            the largest number.
    """

    def __init__(self, problems: int = 4) -> None:
        check_within(1, math.inf, problems=problems)
        self.problems = problems
        self.watched: Batch | None = None

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Forget the problems of an earlier run, which may have had other data."""
        self.watched = None

    def on_validation_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int, *_: int
    ) -> None:
        """Keep the first validation problems."""
        if batch_idx == 0 and self.watched is None:
            some = map_tensors(batch, lambda values: values[: self.problems].cpu())
            self.watched = replace(some, ids=batch.ids[: self.problems])

    def on_validation_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Log the values, and warn if the features have collapsed."""
        if self.watched is None or trainer.sanity_checking:
            return
        batch = self.watched.to(pl_module.device)
        with torch.no_grad(), refinement_enabled(pl_module, False):
            prediction = pl_module(batch)
            spreads = feature_spreads(getattr(pl_module, "solver", pl_module), batch)
        values = {f"val/{key}": value for key, value in (watched_values(prediction, batch) | spreads).items()}
        pl_module.log_dict(values, batch_size=len(batch), sync_dist=True)
        if any(spread < COLLAPSED for spread in spreads.values()):
            rank_zero_warn(
                f"The features of all points are nearly the same (spreads {min(spreads.values()):.2g} and "
                f"{max(spreads.values()):.2g} at step {trainer.global_step}): the features have collapsed. Use a lower "
                "model.learning_rate, model.warmup_steps, or `centre` of the solver's features."
            )


def feature_spreads(solver: nn.Module, batch: Batch) -> dict[str, Tensor]:
    """Return the mean distance of the unit features of each set, from the solver's `features(batch)`, from their mean.

    "feature_spread_2d" and "feature_spread_3d" are 1 for vectors in all directions, 0 for equal vectors. They are
    absent for a solver without a method `features`.
    """
    features = solver.features(batch) if hasattr(solver, "features") else ()  # type: ignore[operator]
    spreads = {}
    for side, z, mask in zip(("2d", "3d"), features, (batch.mask2d, batch.mask3d), strict=False):
        away = torch.linalg.vector_norm(subtract_mean(nn.functional.normalize(z, dim=-1), mask), dim=-1) * mask
        spreads[f"feature_spread_{side}"] = (away.sum(1) / mask.sum(1)).mean()
    return spreads


def watched_values(prediction: Prediction, batch: Batch) -> dict[str, Tensor]:
    """Return means over the problems: the probability of the true matches, and the iterations of each pose.

    They are "<estimate>_iterations" of each pose; "true_match_mass", the sum of P over the true matches, if there are
    an assignment and true matches.
    """
    values = {f"{name}_iterations": pose.stats.iterations.float().mean() for name, pose in prediction.poses.items()}
    if prediction.assignment is not None and batch.match3d is not None:
        matched = batch.match3d >= 0
        mass = prediction.assignment.gather(1, batch.match3d.clamp(min=0)[:, None]).squeeze(1)
        values["true_match_mass"] = mass.where(matched, 0).sum(-1).mean()
    return values


@dataclass
class TestedProblems:
    """Problems of one test loader."""

    rows: list[ProblemRow] = field(default_factory=list)
    losses: dict[int, float] = field(default_factory=dict)
    points: list[ProblemPoints] = field(default_factory=list)
    numbers: set[int] = field(default_factory=set)  # indices of the problems so far


class ResultsWriter(Callback):
    """Write `problems.csv`, `summary.json` and the points of every problem after a test.

    Of several test loaders, each has a folder of its own there, such as `dataloader_idx_0`.

    Args:
        folder: Folder of the files. Default: None, the folder `test` in the default_root_dir of the trainer.
    """

    tested: list[TestedProblems]  # by loader
    note = ""  # line above the table

    settings: Mapping[str, Any] | None = None  # recorded instead of those of the command; if set, no table is printed

    def __init__(self, folder: str | None = None) -> None:
        self.folder = folder

    def on_test_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Start with no rows, and check which results will be replaced."""
        self.tested = [TestedProblems() for _ in trainer.num_test_batches]
        self._check_replaced(trainer)

    def on_test_batch_start(
        self, trainer: Trainer, pl_module: LightningModule, batch: Any, batch_idx: int, dataloader_idx: int = 0
    ) -> None:
        """Number the problems over all batches of a loader."""
        if isinstance(batch, Batch):  # a user's own task may have other batches
            number_globally(batch, self.tested[dataloader_idx].numbers, processes=trainer.world_size)

    def on_test_batch_end(
        self,
        trainer: Trainer,
        pl_module: LightningModule,
        outputs: Any,
        batch: Any,
        batch_idx: int,
        dataloader_idx: int = 0,
    ) -> None:
        """Keep the rows and the points of the batch."""
        if not isinstance(outputs, dict) or not {"prediction", "seconds", "losses"} <= outputs.keys():
            return  # a user's own task
        errors = outputs.get("errors")  # absent in some users' own tasks
        tested = self.tested[dataloader_idx]
        tested.rows += rows_from(outputs["prediction"], batch, outputs["seconds"], errors)
        tested.points += points_from(outputs["prediction"], batch, errors)
        if outputs["losses"] is not None:
            tested.losses |= dict(zip(batch.index.tolist(), outputs["losses"].tolist(), strict=True))

    def on_test_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Gather the rows of all processes, write the files, and print other logged metrics."""
        gathered = gather_objects(self.tested)
        table_metrics = getattr(pl_module, "table_metrics", ())
        others = {name: value for name, value in trainer.callback_metrics.items() if name not in table_metrics}
        logged = ", ".join(f"{name} {float(value):.6g}" for name, value in others.items())
        if any(tested.rows for process in gathered for tested in process):
            self._write_test(trainer, gathered, complete=True)
            if logged:
                rank_zero_info(f"logged: {logged}")
        else:
            rank_zero_info(f"logged: {logged or 'nothing'}; no results folder: `test_step` does not return {RETURNED}")

    def on_exception(self, trainer: Trainer, pl_module: LightningModule, exception: BaseException) -> None:
        """Write the finished problems of an interrupted test; with several processes, those of the first."""
        if (
            isinstance(exception, KeyboardInterrupt)
            and trainer.state.fn == "test"
            and any(tested.rows for tested in self.tested)
        ):
            self._write_test(trainer, [self.tested], complete=False)

    def _write_test(self, trainer: Trainer, gathered: Sequence[list[TestedProblems]], *, complete: bool) -> None:
        """Write the files of each loader from the parts of all processes, and print their table."""
        if not trainer.is_global_zero or trainer.fast_dev_run:  # type: ignore[attr-defined]
            return
        top, folders, count = self._folder(trainer), list[Path](), 0
        settings = _settings(trainer) if self.settings is None else self.settings
        for loader, parts in enumerate(zip(*gathered, strict=True)):
            rows = [row for part in parts for row in part.rows]
            losses = {index: loss for part in parts for index, loss in part.losses.items()}
            mean = sum(losses[i] for i in sorted(losses)) / len(losses) if losses else None
            if rows:
                folders.append(folder_of_loader(top, loader, len(self.tested)))
                count += len({row.index for row in rows})
                write_results(folders[-1], rows, correspondence_loss=mean, settings={**settings, "complete": complete})
                write_points(folders[-1], (problem for part in parts for problem in part.points))
        if self.settings is None:
            if self.note:
                say(self.note)
            console().print(results_table(read_runs(folders)))
        rank_zero_info(f"{'' if complete else 'interrupted: '}results of {count} problems in {top}")

    def _check_replaced(self, trainer: Trainer) -> None:
        """Raise ValueError if a test without a checkpoint would replace the results of a checkpoint.

        If the results of another network or of other data will be replaced, print which.
        """
        summary = self._folder(trainer) / SUMMARY
        if self.settings is not None or trainer.fast_dev_run or not summary.is_file():  # type: ignore[attr-defined]
            return
        before = read_json(summary).get("settings", {})
        checkpoint = before.get("checkpoint")
        if checkpoint is not None and trainer.ckpt_path is None:
            raise ValueError(
                f"{summary.parent} has the results of {checkpoint}, which a test without --ckpt_path would replace; "
                "use --ckpt_path last, or --results.folder for another folder"
            )
        now = json.loads(json.dumps(_settings(trainer), default=str))
        changed = [name for name, value in now.items() if name in before and value != before[name]]
        if changed:
            what = checkpoint or before.get("weights") or "a test without a checkpoint"
            others = " and ".join(changed) if {"data", "solver"}.issuperset(changed) else ""
            rank_zero_info(
                f"the results of {what}{f' with other options of the {others}' if others else ''} in {summary.parent} "
                "are replaced"
            )

    def _folder(self, trainer: Trainer) -> Path:
        return Path(self.folder) if self.folder else Path(trainer.default_root_dir) / "test"


def _settings(trainer: Trainer) -> dict[str, Any]:
    """Return the checkpoint and, for a test of the command line, the initial weights, the data and the solver."""
    saved = next((each.config for each in trainer.callbacks if isinstance(each, SaveConfigCallback)), None)  # type: ignore[attr-defined]
    config = {} if saved is None else saved.as_dict()
    model = config.get("model", {})
    options = model.get("init_args", model)
    checkpoint = str(trainer.ckpt_path) if trainer.ckpt_path else None
    weights, solver = options.get("weights"), options.get("solver")
    return {"checkpoint": checkpoint, "weights": weights, "data": config.get("data"), "solver": solver}
