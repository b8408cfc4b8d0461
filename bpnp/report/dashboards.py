"""Results as a run of Weights & Biases, and the workspace that shows such runs.

Offline unless WANDB_MODE says otherwise. An offline run is a folder; `wandb sync FOLDER` sends it. `wandb` is imported
here only, when it is used.
"""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from bpnp.report.figures import plot_pair, recall_curve
from bpnp.report.folder import read_results
from bpnp.report.page.charts import RECALLS, recall_chart
from bpnp.report.results import Results, cause_shares
from bpnp.report.samples import FEW, PairView, read_views

MOST_PICTURES = 12


def log_results(folder: Path | str, *, project: str = "bpnp", name: str | None = None, directory: Path | str) -> Path:
    """Log a results folder to W&B and return the folder of the run, below `directory`.

    Scalars "test/<estimate>/rotation_q1_deg" and so on, the first estimate's also without its name; tables "quartiles",
    "causes" and "pairs"; recall curves as plotly charts and as a picture; pictures of the worst kept pairs.
    Raises ValueError if the folder cannot be read.
    """
    import wandb

    results, views = read_results(folder), read_views(folder)
    directory = Path(directory)
    directory.mkdir(parents=True, exist_ok=True)
    run = wandb.init(
        project=project,
        name=name or Path(folder).absolute().parent.name,
        dir=str(directory),
        job_type="test",
        config={"settings": results.settings, "bpnp_version": results.bpnp_version, "written": results.written},
        mode=mode(),
        settings=wandb.Settings(silent=True, console="off", disable_git=True, save_code=False),
    )
    try:
        run.log(scalars(results) | _tables(results) | _curves(results) | _pictures(results, views))
        return Path(run.settings.sync_dir)
    finally:
        run.finish()


def mode() -> Any:
    """WANDB_MODE, "offline" where it is not set: nothing is sent unless asked."""
    return os.environ.get("WANDB_MODE") or "offline"


def scalars(results: Results) -> dict[str, float]:
    """The numbers of `summary.json` under the names that a test logs."""
    values: dict[str, float] = {}
    for i, (estimate, numbers) in enumerate(results.estimates.items()):
        values |= {f"test/{estimate}/{key}": value for key, value in numbers.items()}
        if i == 0:
            values |= {f"test/{key}": value for key, value in numbers.items()}
    if results.correspondence_loss is not None:
        values["test/correspondence_loss"] = results.correspondence_loss
    return values


def workspace(entity: str, project: str) -> Any:
    """The saved view of a project that shows what `log_results` and training log; `.save()` sends it.

    Raises ValueError without the package wandb-workspaces.
    """
    try:
        import wandb_workspaces.reports.v2 as panels
        import wandb_workspaces.workspaces as spaces
    except ImportError as error:
        raise ValueError(
            "expected the package wandb-workspaces, got none; try: pip install wandb-workspaces"
        ) from error
    errors: list[Any] = [f"test/{key}" for key in ("rotation_q2_deg", "translation_q2", "reprojection_q2_deg")]
    recalls: list[Any] = ["test/recall_joint_15deg_0.5", "test/recall_joint_10deg_1", "test/found"]
    training: dict[str, list[Any]] = {
        "Loss": ["train/loss", "train/pose_loss"],
        "Correspondence loss": ["train/correspondence_loss", "val/correspondence_loss"],
        "Rotation error, degrees": [f"val/rotation_q{i}_deg" for i in (1, 2, 3)],
        "Recall": ["val/recall_joint_15deg_0.5", "val/recall_joint_10deg_1"],
        "Probability of the true matches": ["val/true_match_mass"],
        "Iterations": ["train/sinkhorn_iterations", "val/pnp_iterations"],
        "Without a pose, share": ["train/without_pose"],
        "Gradient norm": ["train/gradient_norm"],
        "Pairs per second": ["train/pairs_per_second"],
    }
    tests: list[Any] = [
        panels.BarPlot(title=title, metrics=keys) for title, keys in (("Errors", errors), ("Recall", recalls))
    ]
    pictures = panels.MediaBrowser(media_keys=["test/recall", "test/worst_pairs", "val/pairs"])
    curves: list[Any] = [panels.LinePlot(title=title, x="Step", y=keys) for title, keys in training.items()]
    return spaces.Workspace(
        entity=entity,
        project=project,
        name="Blind PnP",
        sections=[
            spaces.Section(name="Test", panels=[*tests, pictures], is_open=True),
            spaces.Section(name="Training", panels=curves, is_open=True),
        ],
    )


def _tables(results: Results) -> dict[str, Any]:
    import wandb
    from pandas import DataFrame

    causes = {name: cause_shares(results.of(name)) for name in results.estimates}
    frames = {
        "quartiles": DataFrame({"estimate": name, **values} for name, values in results.estimates.items()),
        "causes": DataFrame({"estimate": name, **shares} for name, shares in causes.items()),
        "pairs": results.frame().map(_text),
    }
    return {f"test/{name}": wandb.Table(dataframe=frame) for name, frame in frames.items()}


def _curves(results: Results) -> dict[str, Any]:
    charts = {f"test/recall_curve/{error}": recall_chart({"test": results}, error) for error in RECALLS}
    return {key: chart for key, chart in charts.items() if chart is not None}


def _pictures(results: Results, views: Sequence[PairView]) -> dict[str, Any]:
    pictures: dict[str, Any] = {"test/recall": image(recall_curve({"test": results}))}
    # Pairs with many points: the worst and some others, as a test keeps them.
    worst = sorted(views, key=lambda view: (len(view.points2d) <= FEW, -view.error))[:MOST_PICTURES]
    if worst:
        pictures["test/worst_pairs"] = [image(plot_pair(view), caption=str(_text(view.id))) for view in worst]
    return pictures


def image(figure: Any, *, caption: str | None = None) -> Any:
    """A matplotlib figure as a W&B image."""
    import wandb
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return wandb.Image(np.asarray(canvas.buffer_rgba())[..., :3], caption=caption)


def _text(value: Any) -> Any:
    """Names that are not UTF-8 with replacements; numbers as they are."""
    return value.encode("utf-8", "replace").decode() if isinstance(value, str) else value
