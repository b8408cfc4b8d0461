"""Results as a run of Weights & Biases.

Offline unless WANDB_MODE says otherwise. An offline run is a folder; `wandb sync FOLDER` sends it. `wandb` is imported
here only, when it is used.
"""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from bpnp.report.charts import RECALLS, recall_chart
from bpnp.report.figures import plot_problem, recall_curve
from bpnp.report.points import ProblemPoints, read_points, utf8
from bpnp.report.results import Results, cause_shares, read_results

MOST_PICTURES = 12


def log_results(folder: Path | str, *, name: str, project: str = "bpnp", directory: Path | str) -> Path:
    """Log a results folder to W&B and return the folder of the run, below `directory`.

    Scalars "test/<estimate>/rotation_q1_deg" and so on, the first estimate's also without its name; tables "quartiles",
    "causes" and "problems"; recall curves as plotly charts and as a picture; pictures of the worst problems.
    Raises ValueError if the folder cannot be read.
    """
    import wandb

    results, problems = read_results(folder), read_points(folder)
    Path(directory).mkdir(parents=True, exist_ok=True)
    mode: Any = os.environ.get("WANDB_MODE") or "offline"
    run = wandb.init(
        project=project,
        name=name,
        dir=str(directory),
        job_type="test",
        config={"settings": results.settings, "bpnp_version": results.bpnp_version, "written": results.written},
        mode=mode,
        reinit="create_new",  # a run that is open goes on
        settings=wandb.Settings(silent=True, console="off", disable_git=True, save_code=False),
    )
    try:
        run.log(scalars(results) | _media(results, problems))
        return Path(run.settings.sync_dir)
    finally:
        run.finish()


def scalars(results: Results) -> dict[str, float]:
    """The numbers of `summary.json` under the names that a test logs."""
    first = next(iter(results.estimates.values()))
    values = {f"test/{key}": value for key, value in first.items()}
    for estimate, numbers in results.estimates.items():
        values |= {f"test/{estimate}/{key}": value for key, value in numbers.items()}
    loss = results.correspondence_loss
    return values if loss is None else values | {"test/correspondence_loss": loss}


def _media(results: Results, problems: Sequence[ProblemPoints]) -> dict[str, Any]:
    """Tables, recall curves and the worst problems."""
    import wandb
    from pandas import DataFrame

    causes = {name: cause_shares(results.of(name)) for name in results.estimates}
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
