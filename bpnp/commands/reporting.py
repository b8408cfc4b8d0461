"""`bpnp report`, `view` and `wandb`: results as tables, as a page, as figures, and in Weights & Biases."""

import re
import webbrowser
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from bpnp.commands.output import console, say
from bpnp.report.tables.published import Paper

if TYPE_CHECKING:
    from bpnp.report.pictures import Lines
    from bpnp.report.samples import PairView

LINES: Mapping[str, "Lines | None"] = {"true": "match3d", "assigned": "assigned3d", "none": None}


def report(
    runs: list[Path],
    *,
    paper: Paper | None = None,
    untrained: Path | None = None,
    html: Path | None = None,
    photos: Path | None = None,
    recall: Path | None = None,
) -> None:
    """Show results side by side: tables here, and on request a page and recall curves.

    Args:
        runs: folders that `bpnp test` wrote, or their runs.
        paper: the paper's rows beneath, for orientation.
        untrained: results of the untrained weights, to compare.
        html: write a page that needs no network.
        photos: the COLMAP scenes, to put the images under the page's 2D views.
        recall: write the recall curves as .png, .svg or .pdf.
    """
    from bpnp.datamodules.colmap.scenes import photo_finder
    from bpnp.report.figures import recall_curve, save_figure
    from bpnp.report.page.write import write_page
    from bpnp.report.runs import named_runs
    from bpnp.report.tables.result_tables import report as print_tables

    paths = list(named_runs(runs).values())
    if html is not None:
        page = write_page(paths, html, paper=paper, photo=None if photos is None else photo_finder(photos))
        say(f"wrote {page}")
    if recall is not None:
        say(f"wrote {save_figure(recall_curve(paths), recall)}")
    print_tables(paths, console(), paper=paper, untrained=untrained)


def view(
    run: Path,
    pairs: list[str] | None = None,
    *,
    output: Path | None = None,
    estimate: str | None = None,
    lines: Literal["true", "assigned", "none"] = "true",
    photos: Path | None = None,
    open: bool = False,
) -> None:
    """Draw a pair of a test, or a solution: points and cameras in space, and what is seen in the image.

    Args:
        run: folder that `bpnp test` wrote, or its run; or the JSON of a solution.
        pairs: name of a pair, or part of it; the worst by default.
        output: .png, .svg or .pdf; RUN/views/PAIR.png by default.
        estimate: whose pose reprojects the 3D points; the first by default.
        lines: which matches to draw.
        photos: the COLMAP scenes, with the images beside them.
        open: show the file with the system's viewer.
    """
    from bpnp.datamodules.colmap.scenes import photo_finder
    from bpnp.report.figures import plot_pair, save_figure
    from bpnp.report.photos import box_of
    from bpnp.report.runs import named_runs

    wanted = pairs or []
    if output is not None and len(wanted) > 1:
        raise ValueError(f"expected one pair with --output, got {len(wanted)}; try without --output")
    if not run.exists():
        raise ValueError(f"expected the folder of a test or the JSON of a solution, got {run}, which is not there")
    if run.is_file() and wanted:
        raise ValueError(f"expected no pair beside the solution {run}, got {wanted[0]!r}")
    photo = None if photos is None else photo_finder(photos)
    if run.is_file():
        views, folder = [_solution(run)], run.absolute().parent
    else:
        (folder,) = named_runs([run]).values()
        views = chosen_views(folder, wanted)
    for own in views:
        name = run.stem if run.is_file() else re.sub(r"[^A-Za-z0-9._-]+", "_", own.id) or str(own.index)
        figure = plot_pair(own, estimate=estimate, lines=LINES[lines], photo=photo and photo(own.id, box_of(own)))
        written = save_figure(figure, output or folder / "views" / f"{name}.png")
        say(f"wrote {written}")
        if open:
            webbrowser.open(written.absolute().as_uri())


def _solution(path: Path) -> "PairView":
    """The view of a solution's file. Raises ValueError that names the file."""
    from bpnp.solving.pictures import solution_view
    from bpnp.solving.solution import Solution

    try:
        return solution_view(Solution.from_json(path), title=path.stem)
    except ValueError as error:
        pictures = path.parent / "pictures"
        there = f"; the pictures of `bpnp localize` are in {pictures}" if pictures.is_dir() else ""
        raise ValueError(f"{path}: {error}{there}") from error


def chosen_views(folder: Path, wanted: Sequence[str]) -> list["PairView"]:
    """The views of the named pairs; the worst if none is named. Raises ValueError for a name of none or of several."""
    from bpnp.report.samples import read_views

    views = {view.id: view for view in read_views(folder)}
    if not views:
        raise ValueError(f"expected points.npz in {folder}, got none; try `bpnp test` again, which keeps points")
    if not wanted:
        return [max(views.values(), key=lambda view: view.error)]
    found = []
    for name in wanted:
        named = [id for id in views if id == name] or [id for id in views if name in id]
        if len(named) != 1:
            some = ", ".join((named or list(views))[:20])
            raise ValueError(f"expected the name of one pair kept in {folder}, got {name!r}; try one of {some}")
        found.append(views[named[0]])
    return found


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
