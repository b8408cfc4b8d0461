"""A callback of `bpnp fit` that times its steps, saves often, and ends the training after some seconds."""

import time
from pathlib import Path
from typing import Any

import torch
from lightning import LightningModule, Trainer
from lightning.pytorch import Callback
from record import write_json

WARM_UP = 1  # first step, which does not count
SAVED_EVERY = 20.0  # seconds between checkpoints, which a run that is killed loses at most


class Clock(Callback):
    """Mean seconds of a step, without the saves; the training ends `seconds` after its first step.

    The steps and their seconds are written to the JSON `file`; with `save`, last.ckpt is saved in the run's folder.
    """

    def __init__(self, seconds: float, file: str, *, save: bool = True) -> None:
        self.seconds, self.file, self.save = seconds, Path(file), save
        self.steps, self.began, self.counted, self.saved = 0, 0.0, 0.0, 0.0

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Start the time."""
        self.began = self.saved = self.counted = _now()

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Count the step; save or end when it is time."""
        self.steps += 1
        if self.steps == WARM_UP:
            self.counted = _now()
        elapsed = time.perf_counter() - self.began
        trainer.should_stop = trainer.should_stop or (elapsed > self.seconds and self.steps > WARM_UP)
        if self.save and (trainer.should_stop or time.perf_counter() - self.saved > SAVED_EVERY):
            start = _now()
            trainer.save_checkpoint(Path(trainer.default_root_dir) / "checkpoints" / "last.ckpt", weights_only=False)
            self.saved = _now()
            self.counted += self.saved - start

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Write the file."""
        measured = self.steps - WARM_UP
        each = (_now() - self.counted) / measured if measured > 0 else None
        write_json(self.file, {"steps": self.steps, "seconds": each})


def _now() -> float:
    """Return the time when all that was asked of the GPU is done."""
    if torch.cuda.is_available():
        torch.cuda.synchronize()
    return time.perf_counter()
