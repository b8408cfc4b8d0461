"""Folder of a training: its configuration, and its W&B run."""

from pathlib import Path
from typing import Any

from bpnp.report.results import Results

METRICS = "metrics.csv"
WANDB = "wandb.yaml"  # id, project and entity of the W&B run of a training, in its numbered log folder


def training_folder(path: Path | str) -> Path | None:
    """Return the folder of a run with the logs of a training, given it or its test folder; None if there is none."""
    start = Path(path).absolute()
    for folder in (start, start.parent):
        if any((folder / "logs").glob(f"version_*/{METRICS}")):
            return folder
    return None


def training_of(folder: Path | str, results: Results) -> Path | None:
    """Return the folder of the training of the network that was tested.

    It is the run of the checkpoint, or, if that file has gone, the run with the results.

    Args:
        folder: Results folder.
        results: Its results.

    Returns:
        The folder, None if no checkpoint was tested or no training has logs.
    """
    checkpoint = results.settings.get("checkpoint", "")
    if checkpoint is None:
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
    """Read which W&B run the last training in a run folder was logged to.

    Args:
        run: Folder of the training.

    Returns:
        "id", "project" and, if it is known, "entity" of the W&B run; None if the training was not logged to W&B.
    """
    import yaml

    last = _last_training(run)
    if last is None or not (file := last[0] / WANDB).is_file():
        return None
    return dict(yaml.safe_load(file.read_text(encoding="utf-8")))


def _last_training(run: Path) -> tuple[Path, dict[str, Any]] | None:
    """Return the numbered log folder of the last training in a run folder and its configuration."""
    import yaml

    files = run.glob("logs/version_*/config.yaml")
    for file in sorted(files, key=lambda file: int(file.parent.name.split("_")[1]), reverse=True):
        config = yaml.safe_load(file.read_text(encoding="utf-8"))
        if not {"verbose", "return_predictions"} & config.keys():  # options of validate, test and predict
            return file.parent, dict(config)
    return None
