"""Results as a run of Weights & Biases.

Runs are offline unless WANDB_MODE says otherwise. An offline run is a folder; `wandb sync FOLDER` uploads it. This is
the only module that imports `wandb`, and only when it is used.
"""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from bpnp.report.charts import RECALLS, recall_chart
from bpnp.report.figures import plot_problem, recall_curve
from bpnp.report.points import ProblemPoints, read_points, utf8
from bpnp.report.results import Results, cause_fractions, read_results
from bpnp.report.training_curves import training_folder

MOST_PICTURES = 12  # largest number of pictures of problems


def log_results(folder: Path | str, *, name: str, project: str = "bpnp", directory: Path | str | None = None) -> Path:
    """Log a results folder to W&B.

    The run has scalars "test/<estimate>/rotation_q1_deg" and so on; tables "quartiles", "causes" and "problems"; recall
    curves as plotly charts and as a picture; and pictures of the worst problems. If the folder is in that of a
    training, the run has the configuration of the training, and both are in one group.

    Args:
        folder: Folder that `bpnp test` wrote.
        name: Name of the W&B run.
        project: W&B project.
        directory: Parent of the folder `wandb` for the run. Default: the parent of `folder`.

    Returns:
        The folder of the W&B run.

    Raises:
        ValueError: The folder cannot be read.
    """
    import wandb

    results, problems = read_results(folder), read_points(folder)
    directory = Path(folder).absolute().parent if directory is None else Path(directory)
    directory.mkdir(parents=True, exist_ok=True)
    run_folder = training_folder(folder)
    training = None if run_folder is None else training_config(run_folder)
    config = {"settings": results.settings, "bpnp_version": results.bpnp_version, "written": results.written}
    group = None
    if run_folder is not None and training is not None:
        group = training_run_id(run_folder, training) or run_folder.name
        config |= {key: training[key] for key in ("model", "data", "trainer") if key in training} | {"training": group}
    mode: Any = os.environ.get("WANDB_MODE") or "offline"
    run = wandb.init(
        project=project,
        name=name,
        dir=str(directory),
        job_type="test",
        group=group,
        config=config,
        mode=mode,
        reinit="create_new",  # an open run continues
        settings=wandb.Settings(silent=True, console="off", disable_git=True, save_code=False),
    )
    try:
        run.log(scalars(results) | _media(results, problems))
        return Path(run.settings.sync_dir)
    finally:
        run.finish()


def training_config(run: Path) -> dict[str, Any] | None:
    """Read the configuration of the last training in a run folder; None if there is none."""
    import yaml

    files = run.glob("logs/version_*/config.yaml")
    for file in sorted(files, key=lambda file: int(file.parent.name.split("_")[1]), reverse=True):
        config = yaml.safe_load(file.read_text(encoding="utf-8"))
        if not {"verbose", "return_predictions"} & config.keys():  # options of validate, test and predict
            return dict(config)
    return None


def training_run_id(run: Path, config: Mapping[str, Any]) -> str | None:
    """Find the id of the W&B run of a training in its folder; None if the training was not logged to W&B."""
    if "WandbLogger" not in str(config.get("trainer", {}).get("logger")):
        return None
    folders = sorted((run / "wandb").glob("*run-*-*"), key=lambda folder: folder.name.split("-")[-2])
    return folders[0].name.rsplit("-", 1)[1] if folders else None


def scalars(results: Results) -> dict[str, float]:
    """Return the numbers of `summary.json`, under the names that a test logs."""
    estimates = results.estimates.items()
    values = {f"test/{estimate}/{key}": value for estimate, numbers in estimates for key, value in numbers.items()}
    loss = results.correspondence_loss
    return values if loss is None else values | {"test/correspondence_loss": loss}


def _media(results: Results, problems: Sequence[ProblemPoints]) -> dict[str, Any]:
    """Return tables, recall curves and pictures of the worst problems."""
    import wandb
    from pandas import DataFrame

    causes = {name: cause_fractions(results.of(name)) for name in results.estimates}
    tables = {
        "quartiles": DataFrame.from_dict(results.estimates, orient="index").reset_index(names="estimate"),
        "causes": DataFrame.from_dict(causes, orient="index").reset_index(names="estimate"),
        "problems": results.frame().map(lambda value: utf8(value) if isinstance(value, str) else value),
    }
    media: dict[str, Any] = {f"test/{name}": wandb.Table(dataframe=frame) for name, frame in tables.items()}
    for error in RECALLS:
        if (chart := recall_chart({"test": results}, error)) is not None:
            media[f"test/recall_curve/{error}"] = chart
    media["test/recall"] = wandb.Image(recall_curve({"test": results}))
    worst = sorted(problems, key=lambda problem: -problem.error)[:MOST_PICTURES]
    if drawn := [wandb.Image(plot_problem(problem), caption=utf8(problem.id)) for problem in worst]:
        media["test/worst_problems"] = drawn
    return media
