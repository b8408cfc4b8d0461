"""`bpnp wandb`: results in Weights & Biases."""

from pathlib import Path

from bpnp.commands.output import say


def wandb_results(
    runs: list[Path], *, project: str = "bpnp", directory: Path = Path("runs"), workspace: str | None = None
) -> None:
    """Log results to Weights & Biases: to folders for `wandb sync` unless WANDB_MODE=online.

    Args:
        runs: folders that `bpnp test` wrote, or their runs.
        project: name of the project.
        directory: where the folders of offline runs go.
        workspace: entity whose project gets the dashboard as well; goes online.
    """
    from bpnp.report.dashboards import log_results
    from bpnp.report.dashboards import workspace as dashboard
    from bpnp.report.runs import named_runs

    for name, folder in named_runs(runs).items():
        written = log_results(folder, project=project, name=name, directory=directory)
        say(f"logged {name} to {written}")
    if workspace is not None:
        saved = dashboard(workspace, project)
        saved.save()
        say(f"saved {saved.url}")
