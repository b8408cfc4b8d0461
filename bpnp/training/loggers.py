"""W&B run of a training: recorded in its log folder, and continued by tests of its checkpoints."""

from argparse import Namespace
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml
from lightning.pytorch.loggers import WandbLogger

from bpnp.files import write_text
from bpnp.report.training_run import WANDB

SETTINGS = ("data", "ckpt_path")  # settings of a test that the run of its training gets


def record_wandb_run(logger: WandbLogger, folder: Path) -> None:
    """Write id, project and entity of a W&B run to `wandb.yaml` in the log folder, which `wandb_run` reads."""
    run = logger.experiment
    if run.disabled:  # WANDB_MODE=disabled
        return
    names = {"id": run.id, "project": run.project, "entity": run.entity}
    write_text(folder / WANDB, yaml.safe_dump({key: value for key, value in names.items() if value}))


class TrainingRunLogger(WandbLogger):
    """Logger of a test in the W&B run of its training.

    The run keeps the hyperparameters of the training; the data and the checkpoint of the test are under "test". The
    metrics of the test are at the step of the checkpoint, since a test itself counts from 0.

    Args:
        *args: Arguments of Lightning's `WandbLogger`.
        step: Step of the checkpoint.
        **kwargs: Arguments of Lightning's `WandbLogger`.
    """

    def __init__(self, *args: Any, step: int = 0, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.step = step

    def log_hyperparams(self, params: dict[str, Any] | Namespace) -> None:
        """Log the data and the checkpoint of the test; leave out all other settings."""
        given = params if isinstance(params, dict) else vars(params)
        if kept := {key: given[key] for key in SETTINGS if key in given}:
            super().log_hyperparams({"test": kept})

    def log_metrics(self, metrics: Mapping[str, float], step: int | None = None) -> None:
        """Log the metrics of the test at the step of the checkpoint, without its epoch."""
        super().log_metrics({key: value for key, value in metrics.items() if key != "epoch"}, self.step)
