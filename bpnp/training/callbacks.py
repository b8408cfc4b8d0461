"""What a trainer is given beside the task: schedules, compiled nets, and checkpoints read as data."""

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
from lightning.pytorch.utilities.rank_zero import rank_zero_info
from torch import nn

from bpnp.files import written_whole
from bpnp.models.weights import read_checkpoint


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
        self.warmup_steps, self.decay_start = warmup_steps, decay_start
        self.decay_steps, self.final = decay_steps, final

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


class CompileNets(Callback):
    """torch.compile of `features2d` and `features3d` for training: a minute or more to start, then quicker steps.

    The layers stay as they are, and so do checkpoints: parameters keep their names. On a CPU it pays from about a
    thousand steps on.

    Args:
        backend: of torch.compile.
    """

    def __init__(self, backend: str = "inductor") -> None:
        self.backend = backend

    def on_fit_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        solver = pl_module.get_submodule("solver")
        nets = [getattr(solver, f"features{side}", None) for side in ("2d", "3d")]
        if not all(isinstance(net, nn.Module) for net in nets):
            raise ValueError(f"expected a solver with `features2d` and `features3d`, got {type(solver).__name__}")
        for net in nets:
            net.compile(backend=self.backend)  # type: ignore[union-attr]


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
