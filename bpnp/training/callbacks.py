"""What a trainer is given beside the task: the pose loss that joins later, and checkpoints read as data."""

import io
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
