"""Callbacks of a training and its log: the pose loss that joins later, safe checkpoints, and what is watched."""

import io
import math
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from lightning import LightningModule, Trainer
from lightning.pytorch import Callback
from lightning.pytorch.plugins.io import TorchCheckpointIO
from lightning.pytorch.utilities.rank_zero import rank_zero_info, rank_zero_warn
from torch import Tensor, nn

from bpnp.checks import check_within
from bpnp.files import written_whole
from bpnp.models.evaluation import refinement_enabled
from bpnp.models.nets.normalisation import centred
from bpnp.models.weights import read_checkpoint
from bpnp.types import Batch, Prediction

COLLAPSED = 0.05  # spread of unit features below which an assignment is all but uniform


class PoseLossWarmup(Callback):
    """From the correspondence loss alone to L_c + weight * L_p (paper section 3.4).

    Before `start_epoch` no pose is solved in training. Once switched, a resumed run stays switched.

    Args:
        start_epoch: first epoch with the pose loss; the paper has 120.
        weight: gamma_p of Eq. 13.
    """

    def __init__(self, start_epoch: int = 120, weight: float = 1.0) -> None:
        check_within(0, math.inf, start_epoch=start_epoch, weight=weight)
        self.start_epoch, self.weight = start_epoch, weight
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


class SafeCheckpointIO(TorchCheckpointIO):
    """Checkpoints written whole or not at all, and read as data only, with one clear error for a file that is none."""

    def save_checkpoint(self, checkpoint: dict[str, Any], path: Any, storage_options: Any = None) -> None:
        content = io.BytesIO()
        torch.save(checkpoint, content)
        with written_whole(Path(path)) as temporary:
            temporary.write_bytes(content.getbuffer())

    def load_checkpoint(
        self, path: Any, map_location: Any = lambda storage, loc: storage, weights_only: bool | None = None
    ) -> dict[str, Any]:
        return read_checkpoint(path, map_location=map_location)


class InterruptedCheckpoint(Callback):
    """Saves `checkpoints/interrupted.ckpt` in the trainer's default_root_dir when a training is stopped by Ctrl-C."""

    def on_exception(self, trainer: Trainer, pl_module: LightningModule, exception: BaseException) -> None:
        if isinstance(exception, KeyboardInterrupt) and trainer.state.fn == "fit" and trainer.global_step > 0:
            path = Path(trainer.default_root_dir) / "checkpoints" / "interrupted.ckpt"
            trainer.save_checkpoint(path, weights_only=False)
            rank_zero_info(f"interrupted in epoch {trainer.current_epoch}; go on with --ckpt_path {path}")


@contextmanager
def interruptible(trainer: Trainer) -> Iterator[None]:
    """Raises KeyboardInterrupt after Ctrl-C in a run of the trainer, where Lightning ends the process with status 1."""
    try:
        yield
    except SystemExit:
        if trainer.interrupted:
            signal.signal(signal.SIGINT, signal.default_int_handler)
            raise KeyboardInterrupt from None
        raise


class TrainingMonitor(Callback):
    """Logs, of the first few validation problems, "val/true_match_mass", the probability that the assignment gives to
    their true matches, "val/<estimate>_iterations" of each pose, and "val/feature_spread_2d" and "_3d"
    (`feature_spreads`). A spread below 0.05 brings a warning: where all points of a set have the same feature the
    assignment is uniform, and the loss stays where it is.

    Args:
        problems: how many validation problems are watched.
    """

    def __init__(self, problems: int = 4) -> None:
        check_within(1, math.inf, problems=problems)
        self.problems = problems
        self.watched: Batch | None = None

    def on_validation_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int, *_: int
    ) -> None:
        if batch_idx == 0 and self.watched is None:
            self.watched = first_problems(batch, self.problems)

    def on_validation_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
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
                f"expected features that differ from point to point, got spreads of {min(spreads.values()):.2g} and "
                f"{max(spreads.values()):.2g} at step {trainer.global_step}: the features have collapsed; try a lower "
                "model.learning_rate, a warm-up, or `centre` of the solver's features"
            )


def first_problems(batch: Batch, count: int) -> Batch:
    """The first problems of a batch, on the CPU."""
    parts: dict[str, Any] = {
        name: value[:count].cpu() if isinstance(value, Tensor) else value and value[:count]
        for name, value in vars(batch).items()
    }
    return Batch(**parts)


def feature_spreads(solver: nn.Module, batch: Batch) -> dict[str, Tensor]:
    """Mean distance of the unit features of each set from their mean: 1 for vectors in all directions, 0 for one
    vector; empty for a solver without a method `features`."""
    features = solver.features(batch) if hasattr(solver, "features") else ()  # type: ignore[operator]
    spreads = {}
    for side, z, mask in zip(("2d", "3d"), features, (batch.mask2d, batch.mask3d), strict=False):
        away = torch.linalg.vector_norm(centred(nn.functional.normalize(z, dim=-1), mask), dim=-1) * mask
        spreads[f"feature_spread_{side}"] = (away.sum(1) / mask.sum(1)).mean()
    return spreads


def watched_values(prediction: Prediction, batch: Batch) -> dict[str, Tensor]:
    """Mean over the problems of the probability on true matches, and of the iterations of each pose."""
    values = {f"{name}_iterations": pose.stats.iterations.float().mean() for name, pose in prediction.poses.items()}
    if prediction.assignment is not None and batch.match3d is not None:
        matched = batch.match3d >= 0
        mass = prediction.assignment.gather(1, batch.match3d.clamp(min=0)[:, None]).squeeze(1)
        values["true_match_mass"] = mass.where(matched, 0).sum(-1).mean()
    return values
