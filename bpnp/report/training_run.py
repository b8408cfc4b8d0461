"""Folder of a training: its configuration, and the id of its W&B run."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from bpnp.report.results import Results

METRICS = "metrics.csv"


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
    if Path(checkpoint).is_file():
        return training_folder(Path(checkpoint).absolute().parent.parent)
    return training_folder(folder)


def training_config(run: Path) -> dict[str, Any] | None:
    """Read the configuration of the last training in a run folder; None if there is none."""
    import yaml

    files = run.glob("logs/version_*/config.yaml")
    for file in sorted(files, key=lambda file: int(file.parent.name.split("_")[1]), reverse=True):
        config = yaml.safe_load(file.read_text(encoding="utf-8"))
        if not {"verbose", "return_predictions"} & config.keys():  # options of validate, test and predict
            return dict(config)
    return None


def wandb_id(run: Path, config: Mapping[str, Any]) -> str | None:
    """Find the id of the W&B run of a training in its folder; None if the training was not logged to W&B."""
    if "WandbLogger" not in str(config.get("trainer", {}).get("logger")):
        return None
    folders = sorted((run / "wandb").glob("*run-*-*"), key=lambda folder: folder.name.split("-")[-2])
    return folders[0].name.rsplit("-", 1)[1] if folders else None
