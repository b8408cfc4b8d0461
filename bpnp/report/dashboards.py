"""Results as a run of Weights & Biases.

Runs are offline unless WANDB_MODE says otherwise. An offline run is a folder; `wandb sync FOLDER` uploads it. This is
the only module that imports `wandb`, and only when it is used.
"""

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bpnp.report.charts import RECALLS, recall_chart
from bpnp.report.figures import plot_photo, plot_problem, recall_curve
from bpnp.report.photos import PhotoFinder, PhotoSource
from bpnp.report.points import ProblemPoints, read_points, utf8
from bpnp.report.results import Results, cause_fractions, read_results
from bpnp.report.tables import paper_of
from bpnp.report.training_run import training_config, training_of, wandb_run

if TYPE_CHECKING:
    from matplotlib.figure import Figure

TRAINING = ("model", "data", "trainer", "optimizer", "lr_scheduler", "seed_everything")  # settings of a training
MOST_PICTURES = 12  # largest number of pictures of problems


def log_results(
    folder: Path | str,
    *,
    name: str,
    project: str = "bpnp",
    directory: Path | str | None = None,
    photos: PhotoFinder | None = None,
) -> Path:
    """Log a results folder to W&B.

    The run has scalars "test/<estimate>/rotation_q1_deg" and so on; tables "quartiles", "causes" and "problems"; recall
    curves as plotly charts and as a picture; and pictures of the worst problems. It has the configuration of the
    training. If the training was logged to W&B, the results are added to its run, under the name of the folder in place
    of "test".

    Args:
        folder: Folder that `bpnp test` wrote.
        name: Name of the W&B run; that of a training keeps its own.
        project: W&B project; the run of a training keeps its own.
        directory: Parent of the folder `wandb` for the run. Default: the parent of `folder`.
        photos: Function that finds the photos under the points of the pictures. Default: None, no photos.

    Returns:
        The folder of the W&B run.

    Raises:
        ValueError: The folder cannot be read.
    """
    import wandb

    results, problems = read_results(folder), read_points(folder)
    source = None if photos is None else photos(results, problems)
    directory = Path(folder).absolute().parent if directory is None else Path(directory)
    directory.mkdir(parents=True, exist_ok=True)
    run_folder = training_of(folder, results)
    training = (None if run_folder is None else training_config(run_folder)) or {}
    joined = None if run_folder is None else wandb_run(run_folder)
    part = "test" if joined is None else Path(folder).absolute().name
    config = {part: {"settings": results.settings, "bpnp_version": results.bpnp_version, "written": results.written}}
    config |= {key: training[key] for key in TRAINING if key in training}
    mode: Any = os.environ.get("WANDB_MODE") or "offline"
    identity: dict[str, Any] = (
        {"project": project, "name": name, "job_type": "test"} if joined is None else joined | {"resume": "allow"}
    )
    run = wandb.init(
        dir=str(directory),
        mode=mode,
        reinit="create_new",  # an open run continues
        settings=wandb.Settings(silent=True, console="off", disable_git=True, save_code=False),
        **identity,
    )
    try:
        run.config.update(config, allow_val_change=True)
        run.log(scalars(results, part) | _media(results, problems, part, source))
        return Path(run.settings.sync_dir)
    finally:
        run.finish()


def scalars(results: Results, part: str = "test") -> dict[str, float]:
    """Return the numbers of `summary.json`, under the names that a test logs.

    Args:
        results: Results.
        part: First part of the names.
    """
    estimates = results.estimates.items()
    values = {f"{part}/{estimate}/{key}": value for estimate, numbers in estimates for key, value in numbers.items()}
    loss = results.correspondence_loss
    return values if loss is None else values | {f"{part}/correspondence_loss": loss}


def _media(
    results: Results, problems: Sequence[ProblemPoints], part: str, photos: PhotoSource | None
) -> dict[str, Any]:
    """Return tables, recall curves and pictures of the worst problems."""
    import wandb
    from pandas import DataFrame

    paper = paper_of(results)
    causes = {name: cause_fractions(results.of(name)) for name in results.estimates}
    tables = {
        "quartiles": DataFrame.from_dict(results.estimates, orient="index").reset_index(names="estimate"),
        "causes": DataFrame.from_dict(causes, orient="index").reset_index(names="estimate"),
        "problems": results.frame().map(lambda value: utf8(value) if isinstance(value, str) else value),
    }
    media: dict[str, Any] = {f"{part}/{name}": wandb.Table(dataframe=frame) for name, frame in tables.items()}
    for error in RECALLS:
        if (chart := recall_chart({part: results}, error, paper=paper)) is not None:
            media[f"{part}/recall_curve/{error}"] = chart
    media[f"{part}/recall"] = wandb.Image(recall_curve({part: results}, paper=paper))
    worst = sorted(problems, key=lambda problem: -problem.error)[:MOST_PICTURES]
    if drawn := [wandb.Image(_picture(problem, photos), caption=utf8(problem.id)) for problem in worst]:
        media[f"{part}/worst_problems"] = drawn
    return media


def _picture(problem: ProblemPoints, photos: PhotoSource | None) -> "Figure":
    """Draw a problem, over its photo if there is one."""
    photo = None if photos is None else photos(problem)
    if photo is None:
        return plot_problem(problem)
    return plot_photo(replace(problem, camera=photo.camera), photo.pixels)
