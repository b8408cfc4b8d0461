"""Folder of a training: its configuration, and its W&B run."""

from pathlib import Path
from typing import Any

from bpnp.files import config_content
from bpnp.report.results import Results

METRICS = "metrics.csv"
WANDB = "wandb.yaml"  # id, project and entity of the W&B run of a training, in its numbered log folder


def training_logs(run: Path | str) -> list[Path]:
    """Return the files with the metrics of each training in a run folder, in their order.

    Only a training logs "train/..."; `bpnp validate` and `bpnp test` log to files of their own.
    """
    files = sorted(Path(run).glob(f"logs/version_*/{METRICS}"), key=lambda file: int(file.parent.name.split("_")[1]))
    return [file for file in files if any(name.startswith("train/") for name in _columns(file))]


def _columns(file: Path) -> list[str]:
    with file.open(encoding="utf-8") as lines:
        return lines.readline().strip().split(",")


def training_folder(path: Path | str) -> Path | None:
    """Return the folder of a run with the logs of a training, given it or its test folder; None if there is none."""
    start = Path(path).absolute()
    for folder in (start, start.parent):
        if training_logs(folder):
            return folder
    return None


def training_of(folder: Path | str, results: Results) -> Path | None:
    """Return the folder of the training of the network that was tested; None without a checkpoint, or without logs.

    It is the run of the checkpoint, or, if that file has gone, the run with the results. The training of packaged
    weights is not recorded.
    """
    if "checkpoint" not in results.settings:
        return training_folder(folder)
    checkpoint = results.settings["checkpoint"]
    if checkpoint is None or not Path(checkpoint).suffix:  # the name of packaged weights has no suffix
        return None
    return training_of_checkpoint(checkpoint) if Path(checkpoint).is_file() else training_folder(folder)


def training_of_checkpoint(checkpoint: Path | str) -> Path | None:
    """Return the folder of the training that wrote a checkpoint file; None if it has no logs of a training."""
    return training_folder(Path(checkpoint).absolute().parent.parent)


def training_config(run: Path) -> dict[str, Any] | None:
    """Read the configuration of the last training in a run folder; None if there is none."""
    last = _last_training(run)
    return None if last is None else last[1]


def wandb_run(run: Path) -> dict[str, str] | None:
    """Read the "id", "project" and, if known, "entity" of the W&B run that the last training in a folder has.

    The result is None if it was not logged to W&B.
    """
    last = _last_training(run)
    if last is None or not (file := last[0] / WANDB).is_file():
        return None
    return config_content(file)


def _last_training(run: Path) -> tuple[Path, dict[str, Any]] | None:
    """Return the numbered log folder of the last training in a run folder and its configuration."""
    for log in reversed(training_logs(run)):
        config = log.with_name("config.yaml")
        if config.is_file():
            return log.parent, config_content(config)
    return None
