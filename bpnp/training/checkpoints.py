"""Checkpoints of a training: how they are written, which are kept, and which one a run continues."""

import io
import signal
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from lightning import LightningModule, Trainer
from lightning.pytorch.callbacks import Callback, ModelCheckpoint
from lightning.pytorch.plugins.io import TorchCheckpointIO
from lightning.pytorch.utilities.rank_zero import rank_zero_info

from bpnp.files import write_atomically
from bpnp.models.weights import read_checkpoint, read_data

INTERRUPTED = "interrupted"
BEFORE_POSE_LOSS = "before_pose_loss.ckpt"
WEIGHTS_ALONE = "weights_alone"


def newest_checkpoint(folder: Path) -> Path:
    """Return the checkpoint that `--ckpt_path last` continues: the last one, or a newer one of an interruption."""
    files = [*folder.glob("last*.ckpt"), *folder.glob(f"{INTERRUPTED}.ckpt")]
    if not files:
        raise ValueError(f"{folder} has no last checkpoint. A new training has no --ckpt_path; a test needs a file.")
    return max(files, key=lambda file: file.stat().st_mtime_ns)


class SafeCheckpointIO(TorchCheckpointIO):
    """Write checkpoints atomically, and read them as data only, with one clear error for another file.

    A strategy that starts its processes itself (`ddp_spawn`, `ddp_notebook`) passes the trained weights to the main
    process in a file of weights only, which is written under `WEIGHTS_ALONE`.
    """

    def save_checkpoint(self, checkpoint: dict[str, Any], path: Any, storage_options: Any = None) -> None:
        """Write a checkpoint atomically."""
        content = io.BytesIO()
        torch.save(checkpoint if "state_dict" in checkpoint else {WEIGHTS_ALONE: dict(checkpoint)}, content)
        with write_atomically(Path(path)) as temporary:
            temporary.write_bytes(content.getbuffer())

    def load_checkpoint(
        self, path: Any, map_location: Any = lambda storage, loc: storage, weights_only: bool | None = None
    ) -> dict[str, Any]:
        """Read a checkpoint as data, in the form of this version."""
        content = read_data(path, map_location=map_location)
        if WEIGHTS_ALONE in content:
            return dict(content[WEIGHTS_ALONE])
        return read_checkpoint(path, map_location=map_location)


class InterruptedCheckpoint(Callback):
    """Save `interrupted.ckpt` when Ctrl-C or an error stops a training; remove it when a training ends.

    With Lightning's `OnExceptionCheckpoint` instead, every `fit` without a checkpoint would resume the last one.

    Args:
        folder: Folder of the file.
    """

    def __init__(self, folder: str | Path) -> None:
        self.path = Path(folder) / f"{INTERRUPTED}.ckpt"
        self._buffers: dict[str, torch.Tensor] = {}  # of the module before the batch, which changes batch statistics

    def on_train_batch_start(self, trainer: Trainer, pl_module: LightningModule, batch: Any, batch_idx: int) -> None:
        """Keep what a batch changes before its step."""
        self._buffers = {name: buffer.clone() for name, buffer in pl_module.named_buffers()}

    def on_save_checkpoint(self, trainer: Trainer, pl_module: LightningModule, checkpoint: dict[str, Any]) -> None:
        """Let a resumed run repeat the batch within which a training was stopped, which made no step."""
        loop = checkpoint["loops"]["fit_loop"]
        batches = loop["epoch_loop.batch_progress"]
        if batches["current"]["ready"] == batches["current"]["processed"]:
            return
        weights = checkpoint["state_dict"]
        weights.update((name, buffer) for name, buffer in self._buffers.items() if name in weights)
        for counts in (batches["current"], batches["total"]):
            counts["ready"] = counts["started"] = counts["processed"]
        for state in loop["state_dict"].get("combined_loader", []):
            if "served" in state:  # that of a `ProblemLoader`
                state["served"] -= 1

    def on_exception(self, trainer: Trainer, pl_module: LightningModule, exception: BaseException) -> None:
        """Save the checkpoint of an interrupted training."""
        if trainer.world_size > 1 and not isinstance(exception, KeyboardInterrupt):
            return  # saving needs all processes, and those without the error would not take part
        if trainer.state.fn == "fit" and trainer.global_step > 0 and not trainer.fast_dev_run:  # type: ignore[attr-defined]
            trainer.save_checkpoint(self.path, weights_only=False)
            rank_zero_info(
                f"stopped in epoch {trainer.current_epoch}, counted from 0; continue with --ckpt_path {self.path}"
            )

    def on_fit_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Remove the checkpoint of an earlier interruption."""
        if trainer.is_global_zero and not trainer.fast_dev_run:  # type: ignore[attr-defined]
            self.path.unlink(missing_ok=True)


class RunCheckpoint(ModelCheckpoint):
    """Checkpoints in the folder of a run, which may be moved.

    Arguments are those of Lightning's `ModelCheckpoint`.
    """

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore the state, with the paths of this folder if it holds the files that the state names."""
        super().load_state_dict(state_dict if self.dirpath is None else with_folder(state_dict, Path(self.dirpath)))


def with_folder(state: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """Return the state of a `ModelCheckpoint` whose files are in another folder than before.

    It is unchanged unless the folder has all files that the state names.
    """
    names = {key: Path(str(path)).name for key, path in state.items() if key.endswith("_path") and path}
    scores = {str(folder / Path(path).name): score for path, score in state.get("best_k_models", {}).items()}
    paths = {key: str(folder / name) for key, name in names.items()}
    if not all(Path(path).is_file() for path in (*scores, *paths.values())):
        return dict(state)
    return {**state, **paths, "best_k_models": scores, "dirpath": str(folder)}


class LastCheckpoint(RunCheckpoint):
    """Keep the newest checkpoint, also that of the last step, which Lightning leaves out between two validations.

    Arguments are those of Lightning's `ModelCheckpoint`.
    """

    def on_save_checkpoint(self, trainer: Trainer, pl_module: LightningModule, checkpoint: dict[str, Any]) -> None:
        """Let a resumed run finish an epoch that `max_steps` ended, which Lightning counts as a whole epoch."""
        loop = checkpoint["loops"]["fit_loop"]
        batches, epochs = loop["epoch_loop.batch_progress"], loop["epoch_progress"]
        counted = epochs["current"]["processed"] == epochs["current"]["ready"]
        if counted and batches["current"]["ready"] > 0 and not batches["is_last_batch"]:
            for counts in (epochs["current"], epochs["total"]):
                counts["processed"] = counts["completed"] = counts["ready"] - 1
            checkpoint["epoch"] = epochs["current"]["completed"]

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Save the steps since the last checkpoint."""
        super().on_train_end(trainer, pl_module)
        if self._last_global_step_saved != trainer.global_step and not trainer.fast_dev_run:  # type: ignore[attr-defined]
            counts = {"epoch": torch.tensor(trainer.current_epoch), "step": torch.tensor(trainer.global_step)}
            trainer.save_checkpoint(self.format_checkpoint_name(trainer.callback_metrics | counts), weights_only=False)


class BestCheckpoint(RunCheckpoint):
    """Keep the checkpoint with the best `monitor` among epochs of one objective.

    When the pose loss joins the correspondence loss, the choice starts again, because earlier values are of another
    objective. The network at the switch is kept as `before_pose_loss.ckpt`. Arguments are those of Lightning's
    `ModelCheckpoint`.
    """

    has_pose_loss: bool | None = None  # True if the last epoch had the pose loss

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Prepare the folder.

        Raises:
            ValueError: Several checkpoints would have the same name.
        """
        if self.save_top_k not in (0, 1) and "{" not in (self.filename or "{") and not self._enable_version_counter:
            raise ValueError(
                f"save_top_k is {self.save_top_k} and each checkpoint would be {self.filename}.ckpt. Give a name with "
                f"the epoch, such as --best_checkpoint.filename '{self.filename}-{{epoch}}'."
            )
        super().setup(trainer, pl_module, stage)

    def on_train_epoch_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Restart the choice when the pose loss joins, and keep the network before it."""
        has_pose_loss = float(getattr(pl_module, "pose_weight", 0)) > 0
        if has_pose_loss and self.has_pose_loss is False:
            if self.dirpath is not None and not trainer.fast_dev_run:  # type: ignore[attr-defined]
                # The loop does this after the hook; otherwise a resumed run would end its first epoch at once.
                trainer.fit_loop.epoch_loop.batch_progress.reset_on_run()
                trainer.save_checkpoint(Path(self.dirpath) / BEFORE_POSE_LOSS, weights_only=False)
            self.best_k_models = {}
            self.best_model_path = self.kth_best_model_path = ""
            self.best_model_score = None
        self.has_pose_loss = has_pose_loss

    def state_dict(self) -> dict[str, Any]:
        """Return Lightning's state, and whether the last epoch had the pose loss."""
        return super().state_dict() | {"has_pose_loss": self.has_pose_loss}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore the state."""
        super().load_state_dict(state_dict)
        self.has_pose_loss = state_dict["has_pose_loss"]


@contextmanager
def raise_on_interrupt(trainer: Trainer) -> Iterator[None]:
    """Raise KeyboardInterrupt after Ctrl-C in a run of the trainer, where Lightning ends the process with status 1."""
    try:
        yield
    except SystemExit:
        if trainer.interrupted:
            signal.signal(signal.SIGINT, signal.default_int_handler)
            raise KeyboardInterrupt from None
        raise
