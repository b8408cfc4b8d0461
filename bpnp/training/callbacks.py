"""What happens around training and testing: the switch to the pose loss, and the files that a run leaves."""

import csv
import io
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import roma
import torch
import torch.distributed as dist
from lightning import LightningModule, Trainer
from lightning.pytorch import Callback
from lightning.pytorch.cli import SaveConfigCallback
from lightning.pytorch.plugins.io import TorchCheckpointIO
from lightning.pytorch.utilities.rank_zero import rank_zero_info

from bpnp.files import written_whole
from bpnp.models.weights import read_checkpoint
from bpnp.report import report
from bpnp.report.folder import write_results
from bpnp.report.results import PairRow, rows_from
from bpnp.report.samples import PairView, select_views, thin, views_from, write_views
from bpnp.types import Batch, Prediction


class SafeCheckpointIO(TorchCheckpointIO):
    """Checkpoints read as data only, with one clear error for a file that is none."""

    def load_checkpoint(
        self, path: Any, map_location: Any = lambda storage, loc: storage, weights_only: bool | None = None
    ) -> dict[str, Any]:
        return read_checkpoint(path, map_location=map_location)


class PoseLossWarmup(Callback):
    """From the correspondence loss alone to L_c + weight * L_p (paper section 3.4).

    Before `start_epoch` no pose is solved in training. Once switched, a resumed run stays switched.

    Args:
        start_epoch: first epoch with the pose loss; the paper has 120.
        weight: gamma_p of Eq. 13.
    """

    def __init__(self, start_epoch: int = 120, weight: float = 1.0) -> None:
        if start_epoch < 0 or weight < 0:
            raise ValueError(f"expected start_epoch >= 0 and weight >= 0, got {start_epoch} and {weight}")
        self.start_epoch = start_epoch
        self.weight = weight
        self.switched_at: int | None = None

    def on_train_epoch_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if self.switched_at is None and trainer.current_epoch >= self.start_epoch:
            self.switched_at = trainer.current_epoch
            rank_zero_info(f"epoch {trainer.current_epoch}: the pose loss joins with weight {self.weight}")
        pl_module.pose_weight = 0.0 if self.switched_at is None else self.weight  # type: ignore[assignment]

    def state_dict(self) -> dict[str, Any]:
        return {"switched_at": self.switched_at}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.switched_at = state_dict["switched_at"]


class LearningRateSchedule(Callback):
    """Linear warm-up, then the model's learning rate, then a half cosine down to `final` of it.

    The rate depends on the step alone, so that a resumed run goes on where it was, or on another schedule.

    Args:
        warmup_steps: optimiser steps until the full rate.
        decay_start: step at which the rate begins to fall; null for never.
        decay_steps: steps of the fall.
        final: factor on the rate from then on.
    """

    def __init__(
        self, warmup_steps: int = 200, decay_start: int | None = None, decay_steps: int = 1000, final: float = 0.02
    ) -> None:
        if warmup_steps < 0 or (decay_start or 0) < 0 or decay_steps < 1 or not 0 <= final <= 1:
            raise ValueError(
                "expected warmup_steps, decay_start >= 0, decay_steps >= 1 and final in [0, 1], got "
                f"{warmup_steps}, {decay_start}, {decay_steps} and {final}"
            )
        self.warmup_steps = warmup_steps
        self.decay_start = decay_start
        self.decay_steps = decay_steps
        self.final = final

    def factor(self, step: int) -> float:
        """On the learning rate, at a step."""
        rise = min(1.0, (step + 1) / (self.warmup_steps + 1))
        if self.decay_start is None:
            return rise
        done = min(1.0, max(0.0, (step - self.decay_start) / self.decay_steps))
        return rise * (self.final + (1 - self.final) * (1 + math.cos(math.pi * done)) / 2)

    def on_train_batch_start(self, trainer: Trainer, pl_module: LightningModule, batch: Any, batch_idx: int) -> None:
        rate = float(pl_module.learning_rate) * self.factor(trainer.global_step)  # type: ignore[arg-type]
        for optimizer in trainer.optimizers:
            for group in optimizer.param_groups:
                group["lr"] = rate


class CompileNets(Callback):
    """torch.compile of the solver's nets for training: a minute or more to start with, then quicker steps.

    The layers stay as they are, and so do checkpoints: parameters keep their names. On a CPU it pays from about a
    thousand steps on.

    Args:
        names: attributes of the solver to compile.
        backend: of torch.compile.
    """

    def __init__(self, names: Sequence[str] = ("features2d", "features3d"), backend: str = "inductor") -> None:
        self.names = tuple(names)
        self.backend = backend

    def on_fit_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        solver = pl_module.get_submodule("solver")
        missing = [name for name in self.names if not isinstance(getattr(solver, name, None), torch.nn.Module)]
        if missing:
            raise ValueError(f"expected nets of {type(solver).__name__}, got {missing}; try others in `names`")
        for name in self.names:
            getattr(solver, name).compile(backend=self.backend)


class ResultsWriter(Callback):
    """Writes `pairs.csv`, `summary.json`, the points of some pairs and a few points of every pair after a test, and
    `poses.csv` after a prediction.

    Args:
        folder: where; null for `test` and `predict` in the trainer's default_root_dir.
        inlier_threshold: of the counted inliers, normalised image coordinates.
    """

    def __init__(self, folder: str | None = None, inlier_threshold: float = 0.01) -> None:
        self.folder = folder
        self.inlier_threshold = inlier_threshold
        self.rows: list[PairRow] = []
        self.losses: dict[int, float] = {}
        self.chosen: Sequence[PairView] = ()
        self.views: list[PairView] = []
        self.poses: dict[tuple[int, str], list[Any]] = {}

    def on_test_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self.rows, self.losses, self.chosen, self.views = [], {}, (), []

    def on_test_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int, *_: int
    ) -> None:
        rows = rows_from(
            outputs["prediction"], batch, outputs["seconds"], inlier_threshold=self.inlier_threshold
        )  # fmt: skip
        self.rows += rows
        views = views_from(outputs["prediction"], batch)
        self.chosen = select_views([*self.chosen, *views])
        self.views += map(thin, views)
        if outputs["losses"] is not None:
            self.losses |= dict(zip(batch.index.tolist(), outputs["losses"].tolist(), strict=True))

    def on_test_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        gathered = _gather((self.rows, self.losses, self.chosen, self.views))
        if trainer.is_global_zero:
            rows = [row for part, _, _, _ in gathered for row in part]
            losses = {index: loss for _, part, _, _ in gathered for index, loss in part.items()}
            mean = sum(losses[i] for i in sorted(losses)) / len(losses) if losses else None
            folder = self._folder(trainer, "test")
            write_results(folder, rows, correspondence_loss=mean, settings=_settings(trainer))
            chosen = select_views([view for _, _, part, _ in gathered for view in part])
            write_views(folder, [*chosen, *(view for *_, part in gathered for view in part)])
            report([folder])
            rank_zero_info(f"results of {len({row.index for row in rows})} pairs in {folder}")

    def on_predict_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self.poses = {}

    def on_predict_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int, *_: int
    ) -> None:
        self.poses |= _pose_rows(outputs, batch)

    def on_predict_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        gathered = _gather(self.poses)
        if trainer.is_global_zero:
            merged = {key: row for part in gathered for key, row in part.items()}
            path = self._folder(trainer, "predict") / "poses.csv"
            _write_poses(path, [merged[key] for key in sorted(merged)])
            rank_zero_info(f"{len(merged)} poses in {path}")

    def _folder(self, trainer: Trainer, stage: str) -> Path:
        return Path(self.folder) if self.folder else Path(trainer.default_root_dir) / stage


POSE_COLUMNS = ("id", "estimate", "qw", "qx", "qy", "qz", "tx", "ty", "tz", "found", "converged")


def _pose_rows(prediction: Prediction, batch: Batch) -> dict[tuple[int, str], list[Any]]:
    """World-to-camera quaternion and translation in COLMAP's order, in the scene's own coordinates; empty if none."""
    rows: dict[tuple[int, str], list[Any]] = {}
    for name, pose in prediction.poses.items():
        found = pose.found
        rotation = pose.rotation.double().where(found[:, None, None], torch.eye(3, device=found.device).double())
        xyzw = roma.rotmat_to_unitquat(rotation)
        translation = pose.translation.double()
        if batch.origin is not None:
            translation = translation - (rotation @ batch.origin.double().unsqueeze(-1)).squeeze(-1)
        numbers = torch.cat([xyzw[:, 3:], xyzw[:, :3], translation], -1).tolist()
        for i, (is_found, converged) in enumerate(zip(found.tolist(), pose.stats.converged.tolist(), strict=True)):
            values = numbers[i] if is_found else [""] * 7
            rows[int(batch.index[i]), name] = [batch.ids[i], name, *values, is_found, converged]
    return rows


def _write_poses(path: Path, rows: Sequence[Sequence[Any]]) -> None:
    table = io.StringIO(newline="")
    writer = csv.writer(table)
    writer.writerow(POSE_COLUMNS)
    writer.writerows(rows)
    with written_whole(path) as temporary:
        temporary.write_text(table.getvalue(), encoding="utf-8")


def _settings(trainer: Trainer) -> dict[str, Any]:
    """The checkpoint, and of a test from the command line the data and the solver of its configuration."""
    saved = next((own.config for own in trainer.callbacks if isinstance(own, SaveConfigCallback)), None)  # type: ignore[attr-defined]
    config = {} if saved is None else saved.as_dict()
    settings = {"checkpoint": str(trainer.ckpt_path) if trainer.ckpt_path else None}
    return settings | {"data": config.get("data"), "solver": config.get("model", {}).get("solver")}


def _gather(value: Any) -> list[Any]:
    """The value of every process, in the order of their ranks."""
    if not dist.is_initialized():
        return [value]
    values = [None] * dist.get_world_size()
    dist.all_gather_object(values, value)
    return values
