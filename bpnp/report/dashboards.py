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
from bpnp.report.groups import group_table
from bpnp.report.intervals import interval_table
from bpnp.report.photos import PhotoFinder, PhotoSource
from bpnp.report.points import ProblemPoints, read_points, utf8
from bpnp.report.results import Results, cause_fractions, read_results
from bpnp.report.tables import paper_of, read_runs
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
    compare_with: Path | str | None = None,
) -> Path:
    """Log a results folder, written by `bpnp test`, to W&B, and return the folder of the W&B run.

    The run has scalars "test/<estimate>/rotation_q1_deg" and so on; tables "intervals" and "groups" (medians, recall
    and paired differences with 95 % intervals, of all problems and by class or scene), "quartiles", "causes" and
    "problems"; recall curves as plotly charts and as a picture; and pictures of the worst problems. It has the
    configuration of the training. If the training was logged to W&B, the results are added to its run, under the name
    of the folder in place of "test"; `name` and `project` are for a new run.

    The folder `wandb` is made in `directory`, by default the parent of `folder`. `photos` finds the photos under the
    points of the pictures. The estimates are compared with those of the results folder `compare_with`, by default with
    the first estimate of `folder`. Raise ValueError if a folder cannot be read.
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
        tables = _tables(results, folder, compare_with).items()
        media = {f"{part}/{table}": wandb.Table(dataframe=frame) for table, frame in tables}
        run.log(scalars(results, part) | media | _media(results, problems, part, source))
        return Path(run.settings.sync_dir)
    finally:
        run.finish()


def scalars(results: Results, part: str = "test") -> dict[str, float]:
    """Return the numbers of `summary.json`, under the names that a test logs."""
    estimates = results.estimates.items()
    values = {f"{part}/{estimate}/{key}": value for estimate, numbers in estimates for key, value in numbers.items()}
    loss = results.correspondence_loss
    return values if loss is None else values | {f"{part}/correspondence_loss": loss}


def _tables(results: Results, folder: Path | str, compare_with: Path | str | None) -> dict[str, Any]:
    """Return DataFrames by name; that of groups is absent if there are none."""
    from pandas import DataFrame

    runs = read_runs([folder if compare_with is None else compare_with, folder])
    *_, own = runs
    compared = {"intervals": interval_table(runs), "groups": group_table(runs)}
    frames = {name: table.frame() for name, table in compared.items() if table is not None}
    causes = {name: cause_fractions(results.of(name)) for name in results.estimates}
    tables = {name: frame[frame.run == own].drop(columns="run") for name, frame in frames.items()} | {
        "quartiles": DataFrame.from_dict(results.estimates, orient="index").reset_index(names="estimate"),
        "causes": DataFrame.from_dict(causes, orient="index").reset_index(names="estimate"),
        "problems": results.frame(),
    }
    return {name: frame.map(lambda it: utf8(it) if isinstance(it, str) else it) for name, frame in tables.items()}


def _media(
    results: Results, problems: Sequence[ProblemPoints], part: str, photos: PhotoSource | None
) -> dict[str, Any]:
    """Return recall curves and pictures of the worst problems."""
    import wandb

    paper = paper_of(results)
    media: dict[str, Any] = {}
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
