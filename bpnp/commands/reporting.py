"""`bpnp report`, `view` and `wandb`: results as tables, as a page, as figures, and in Weights & Biases."""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from bpnp.commands.output import say
from bpnp.report.terminal import Paper

if TYPE_CHECKING:
    from bpnp.report.figures import Lines
    from bpnp.report.points import ProblemPoints

LINES: Mapping[str, "Lines | None"] = {"true": "match3d", "assigned": "assigned3d", "none": None}


def report(
    runs: list[Path], *, paper: Paper | None = None, html: Path | None = None, recall: Path | None = None
) -> None:
    """Show results side by side: tables here, and on request a page and recall curves.

    Args:
        runs: folders that `bpnp test` or `bpnp table` wrote, or their runs.
        paper: modelnet40 or megadepth, the paper's rows beneath, for orientation.
        html: write a page that needs no network.
        recall: write the recall curves as .png, .svg or .pdf.
    """
    from bpnp.report.figures import recall_curve, save_figure
    from bpnp.report.page.write import write_page
    from bpnp.report.runs import named_runs
    from bpnp.report.tables import report as print_tables

    paths = list(named_runs(runs).values())
    if html is not None:
        say(f"wrote {write_page(paths, html, paper=paper)}")
    if recall is not None:
        say(f"wrote {save_figure(recall_curve(paths), recall)}")
    print_tables(paths, paper=paper)


def view(
    run: Path,
    problems: list[str] | None = None,
    *,
    output: Path | None = None,
    estimate: str | None = None,
    lines: Literal["true", "assigned", "none"] = "true",
) -> None:
    """Draw a problem of a test, or a solution: points and cameras in space, and what is seen in the image.

    Args:
        run: folder that `bpnp test` wrote, or its run; or the JSON of a solution.
        problems: name of a problem, or part of it; the worst by default.
        output: .png, .svg or .pdf; RUN/views/PROBLEM.png by default.
        estimate: whose pose reprojects the 3D points; the first by default.
        lines: which matches to draw.
    """
    from bpnp.report.figures import plot_problem, save_figure
    from bpnp.report.runs import named_runs

    names = problems or []
    if output is not None and len(names) > 1:
        raise ValueError(f"expected one problem with --output, got {len(names)}; try without --output")
    if not run.exists():
        raise ValueError(f"expected the folder of a test or the JSON of a solution, got {run}, which is not there")
    if run.is_file() and names:
        raise ValueError(f"expected no problem beside the solution {run}, got {names[0]!r}")
    if run.is_file():
        drawn, folder = [_solution(run)], run.absolute().parent
    else:
        folder, *others = named_runs([run]).values()
        if others:
            raise ValueError(f"expected the results of one test, got several below {run}; try {folder}")
        drawn = chosen_problems(folder, names)
    for problem in drawn:
        name = run.stem if run.is_file() else re.sub(r"[^A-Za-z0-9._-]+", "_", problem.id) or str(problem.index)
        figure = plot_problem(problem, estimate=estimate, lines=LINES[lines])
        say(f"wrote {save_figure(figure, output or folder / 'views' / f'{name}.png')}")


def _solution(path: Path) -> "ProblemPoints":
    """The points of a solution's file. Raises ValueError that names the file."""
    from bpnp.solving.pictures import solution_points
    from bpnp.solving.solution import Solution

    try:
        return solution_points(Solution.from_json(path), title=path.stem)
    except ValueError as error:
        pictures = path.parent / "pictures"
        there = f"; the pictures of `bpnp localize` are in {pictures}" if pictures.is_dir() else ""
        raise ValueError(f"{path}: {error}{there}") from error


def chosen_problems(folder: Path, names: Sequence[str]) -> list["ProblemPoints"]:
    """The problems of these names; the worst if there is none. Raises ValueError for a name of none or of several."""
    from bpnp.report.points import read_points

    problems = {problem.id: problem for problem in read_points(folder)}
    if not problems:
        raise ValueError(f"expected points.npz in {folder}, got none; try `bpnp test` again, which keeps points")
    if not names:
        return [max(problems.values(), key=lambda problem: problem.error)]
    chosen = []
    for name in names:
        alike = [id for id in problems if id == name] or [id for id in problems if name in id]
        if len(alike) != 1:
            some = ", ".join((alike or list(problems))[:20])
            raise ValueError(f"expected the name of one problem in {folder}, got {name!r}; try one of {some}")
        chosen.append(problems[alike[0]])
    return chosen


def wandb_results(runs: list[Path], *, project: str = "bpnp", directory: Path = Path("runs")) -> None:
    """Log results to Weights & Biases: to folders for `wandb sync` unless WANDB_MODE=online.

    Args:
        runs: folders that `bpnp test` wrote, or their runs.
        project: name of the project.
        directory: where the folders of offline runs go.
    """
    from bpnp.report.dashboards import log_results
    from bpnp.report.runs import named_runs

    for name, folder in named_runs(runs).items():
        written = log_results(folder, project=project, name=name, directory=directory)
        say(f"logged {name} to {written}")
