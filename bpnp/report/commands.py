"""`bpnp report` and `bpnp view`: results as tables, as a page, as figures."""

import argparse
import re
import webbrowser
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from bpnp.report.figures import plot_pair, recall_curve, save_figure
from bpnp.report.page import write_page
from bpnp.report.runs import named_runs
from bpnp.report.tables import report
from bpnp.report.views import PairView, read_views


def report_command(arguments: Sequence[str], console: Console | None = None) -> None:
    """`bpnp report RUN... [--paper SET] [--untrained RUN] [--html FILE] [--recall FILE]`.

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
    parser.add_argument("--recall", type=Path, metavar="FILE", help="write the recall curves as .png, .svg or .pdf")
    chosen = parser.parse_args(arguments)
    paths = list(named_runs(chosen.runs).values())
    if chosen.html is not None:
        _say(console, write_page(paths, chosen.html, paper=chosen.paper))
    if chosen.recall is not None:
        _say(console, save_figure(recall_curve(paths), chosen.recall))
    report(paths, console, paper=chosen.paper, untrained=chosen.untrained)


def view_command(arguments: Sequence[str], console: Console | None = None) -> None:
    """`bpnp view RUN [PAIR] [--output FILE] [--estimate NAME] [--lines WHICH] [--open]`.

    Raises ValueError if the run kept no points, or none of that pair; OSError for what cannot be written.
    """
    parser = argparse.ArgumentParser(
        prog="bpnp view",
        description="Draw a pair of a test: points and cameras in space, and what is seen in the image.",
    )
    parser.add_argument("run", type=Path, metavar="RUN", help="folder that `bpnp test` wrote, or its run")
    parser.add_argument("pair", nargs="?", help="name of the pair, or part of it; the worst by default")
    parser.add_argument("--output", type=Path, metavar="FILE", help=".png, .svg or .pdf; RUN/views/PAIR.png by default")
    parser.add_argument("--estimate", help="whose pose reprojects the 3D points; the first by default")
    parser.add_argument("--lines", choices=("true", "assigned", "none"), default="true", help="which matches to draw")
    parser.add_argument("--open", action="store_true", help="show the file with the system's viewer")
    chosen = parser.parse_args(arguments)
    (folder,) = named_runs([chosen.run]).values()
    view = _chosen_view(folder, chosen.pair)
    lines = {"true": "match3d", "assigned": "assigned3d", "none": None}[chosen.lines]
    output = chosen.output or folder / "views" / f"{re.sub(r'[^A-Za-z0-9._-]+', '_', view.id) or view.index}.png"
    written = save_figure(plot_pair(view, estimate=chosen.estimate, lines=lines), output)  # type: ignore[arg-type]
    _say(console, written)
    if chosen.open:
        webbrowser.open(written.absolute().as_uri())


def _chosen_view(folder: Path, wanted: str | None) -> PairView:
    views = read_views(folder)
    if not views:
        raise ValueError(f"expected views.npz in {folder}, got none; try `bpnp test` again, which keeps some pairs")
    if wanted is None:
        return max(views, key=lambda view: view.error)
    named = [view for view in views if view.id == wanted] or [view for view in views if wanted in view.id]
    if len(named) != 1:
        known = ", ".join(view.id for view in named or views)
        raise ValueError(f"expected the name of one pair kept in {folder}, got {wanted!r}; try one of {known}")
    return named[0]


def _say(console: Console | None, path: Path) -> None:
    (console or Console()).print(f"wrote {path}", markup=False, highlight=False, soft_wrap=True)
