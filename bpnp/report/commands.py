"""`bpnp report` and `bpnp view`: results as tables, as a page, as figures."""

import argparse
import re
import webbrowser
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from bpnp.report.figures import Lines, plot_pair, recall_curve, save_figure
from bpnp.report.folder import named_runs
from bpnp.report.page.write import write_page
from bpnp.report.photos import PhotoFinder, Photos, box_of
from bpnp.report.samples import PairView, read_views
from bpnp.report.solutions import read_solution
from bpnp.report.tables import report


def report_command(
    arguments: Sequence[str], console: Console | None = None, *, photos: Photos | None = None
) -> None:  # fmt: skip
    """`bpnp report RUN... [--paper SET] [--untrained RUN] [--html FILE] [--photos SCENES] [--recall FILE]`.

    photos: what finds the photos of the pairs below a folder of scenes; see `bpnp.report.photos`.

    Raises ValueError for what cannot be read, OSError for what cannot be written.
    """
    parser = argparse.ArgumentParser(
        prog="bpnp report", description="Results side by side: tables here, and on request a page and recall curves."
    )
    parser.add_argument("runs", nargs="+", type=Path, metavar="RUN", help="folder that `bpnp test` wrote, or its run")
    parser.add_argument(
        "--paper", choices=("modelnet40", "megadepth"), help="the paper's rows beneath, for orientation"
    )
    parser.add_argument("--untrained", type=Path, metavar="RUN", help="results of the untrained weights, to compare")
    parser.add_argument("--html", type=Path, metavar="FILE", help="write a page that needs no network")
    parser.add_argument(
        "--photos", type=Path, metavar="SCENES", help="the COLMAP scenes, to put the images under the page's 2D views"
    )
    parser.add_argument("--recall", type=Path, metavar="FILE", help="write the recall curves as .png, .svg or .pdf")
    chosen = parser.parse_args(arguments)
    paths = list(named_runs(chosen.runs).values())
    if chosen.html is not None:
        photo = None if chosen.photos is None else _finder(chosen.photos, photos)
        _say(console, write_page(paths, chosen.html, paper=chosen.paper, photo=photo))
    if chosen.recall is not None:
        _say(console, save_figure(recall_curve(paths), chosen.recall))
    report(paths, console, paper=chosen.paper, untrained=chosen.untrained)


def view_command(
    arguments: Sequence[str], console: Console | None = None, *, photos: Photos | None = None
) -> None:  # fmt: skip
    """`bpnp view RUN [PAIR...]` or `bpnp view SOLUTION.json`; `--output FILE`, `--estimate NAME`, `--lines WHICH`,
    `--photos SCENES`, `--open`.

    Raises ValueError if the run kept no points, or none of that pair; OSError for what cannot be written.
    """
    parser = argparse.ArgumentParser(
        prog="bpnp view",
        description="Draw a pair of a test: points and cameras in space, and what is seen in the image.",
    )
    parser.add_argument(
        "run", type=Path, metavar="RUN", help="folder that `bpnp test` wrote, or its run; or the JSON of a solution"
    )
    parser.add_argument("pairs", nargs="*", metavar="PAIR", help="name of a pair, or part of it; the worst by default")
    parser.add_argument("--output", type=Path, metavar="FILE", help=".png, .svg or .pdf; RUN/views/PAIR.png by default")
    parser.add_argument("--estimate", help="whose pose reprojects the 3D points; the first by default")
    parser.add_argument("--lines", choices=("true", "assigned", "none"), default="true", help="which matches to draw")
    parser.add_argument("--photos", type=Path, metavar="SCENES", help="the COLMAP scenes, with the images beside them")
    parser.add_argument("--open", action="store_true", help="show the file with the system's viewer")
    chosen = parser.parse_args(arguments)
    if chosen.output is not None and len(chosen.pairs) > 1:
        raise ValueError(f"expected one pair with --output, got {len(chosen.pairs)}; try without --output")
    if not chosen.run.exists():
        raise ValueError(
            f"expected the folder of a test or the JSON of a solution, got {chosen.run}, which is not there"
        )
    if chosen.run.is_file() and chosen.pairs:
        raise ValueError(f"expected no pair beside the solution {chosen.run}, got {chosen.pairs[0]!r}")
    photo = None if chosen.photos is None else _finder(chosen.photos, photos)
    which: dict[str, Lines | None] = {"true": "match3d", "assigned": "assigned3d", "none": None}
    lines = which[chosen.lines]
    if chosen.run.is_file():
        views, folder = [read_solution(chosen.run)], chosen.run.absolute().parent
    else:
        (folder,) = named_runs([chosen.run]).values()
        views = chosen_views(folder, chosen.pairs)
    for view in views:
        name = chosen.run.stem if chosen.run.is_file() else re.sub(r"[^A-Za-z0-9._-]+", "_", view.id) or str(view.index)
        output = chosen.output or folder / "views" / f"{name}.png"
        figure = plot_pair(view, estimate=chosen.estimate, lines=lines, photo=photo and photo(view.id, box_of(view)))
        written = save_figure(figure, output)
        _say(console, written)
        if chosen.open:
            webbrowser.open(written.absolute().as_uri())


def chosen_views(folder: Path, wanted: Sequence[str]) -> list[PairView]:
    """The views of the named pairs; the worst if none is named. Raises ValueError for a name of none or of several."""
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


def _finder(scenes: Path, photos: Photos | None) -> PhotoFinder:
    if photos is None:
        raise ValueError("expected a reader of photos for --photos, got none; try the command `bpnp`")
    return photos(scenes)


def _say(console: Console | None, path: Path) -> None:
    (console or Console()).print(f"wrote {path}", markup=False, highlight=False, soft_wrap=True)
