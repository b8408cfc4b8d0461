"""How the trainer reads checkpoints and runs the nets."""

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from lightning import LightningModule, Trainer
from lightning.pytorch import Callback
from lightning.pytorch.plugins.io import TorchCheckpointIO
from lightning.pytorch.utilities.rank_zero import rank_zero_info
from torch import nn

from bpnp.models.weights import read_checkpoint


class SafeCheckpointIO(TorchCheckpointIO):
    """Checkpoints read as data only, with one clear error for a file that is none."""

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
        for net in feature_nets(pl_module).values():
            net.compile(backend=self.backend)


class InterruptedCheckpoint(Callback):
    """Saves `checkpoints/interrupted.ckpt` in the trainer's default_root_dir when a training is stopped by Ctrl-C."""

    def on_exception(self, trainer: Trainer, pl_module: LightningModule, exception: BaseException) -> None:
        if isinstance(exception, KeyboardInterrupt) and trainer.state.fn == "fit" and trainer.global_step > 0:
            path = Path(trainer.default_root_dir) / "checkpoints" / "interrupted.ckpt"
            trainer.save_checkpoint(path)
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


def feature_nets(task: LightningModule) -> dict[str, nn.Module]:
    """The nets "2d" and "3d" of the task's solver. Raises ValueError if it has none."""
    solver = task.get_submodule("solver")
    nets = {side: getattr(solver, f"features{side}", None) for side in ("2d", "3d")}
    if not all(isinstance(net, nn.Module) for net in nets.values()):
        raise ValueError(f"expected a solver with `features2d` and `features3d`, got {type(solver).__name__}")
    return nets  # type: ignore[return-value]
