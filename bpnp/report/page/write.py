"""Results as one HTML file that needs nothing else: no network, no server.

plotly's script is inside, compressed: 2.0 MB of text. The numbers and points travel as compressed JSON: eight runs of
ten thousand problems stay under 20 MB. What is drawn from them is in `assets`.
"""

import html
import json
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

from bpnp.files import written_whole
from bpnp.report.page.charts import CONFIG, chart_text, figures, look, page_charts
from bpnp.report.page.problems import compressed, page_numbers, page_points, shown_id
from bpnp.report.page.text import causes_html, headline_html, options, quartiles_html, series_boxes, visible
from bpnp.report.palette import INKS
from bpnp.report.photos import PhotoFinder, page_photos
from bpnp.report.points import read_points
from bpnp.report.results import CAUSES, read_results
from bpnp.report.runs import TrainingLog, lines_of, named_runs, read_training_log, trained_only
from bpnp.report.terminal import Paper

SCRIPTS = ("page.js", "problem.js")
MOST_BYTES = 19_850_000
COLUMNS = {  # of the table of problems: head and hover text
    "rotation_error_deg": ("rot deg", "rotation error, degrees"),
    "translation_error": ("trans", "translation error, scene units"),
    "centre_error": ("centre", "distance of the camera centres, scene units"),
    "reprojection_error_deg": ("repr deg", "mean reprojection error of the true matches, degrees"),
    "inliers": ("inliers", "2D points with a reprojected 3D point beside them"),
    "m": ("2D points", "2D points of the problem"),
    "n": ("3D points", "3D points of the problem"),
    "matches": ("matches", "3D points with a true match"),
    "iterations": ("iterations", "iterations of the solver"),
    "seconds": ("sec", "seconds, the problem's share of its batch"),
}
STATUSES = ("converged", "not converged", "no pose")
HEADINGS = {"recall": "Recall", "errors": "Errors against size", "time": "Time", "training": "Training"}
VERSUS = (
    '<div class="controls"><label>A <select id="a" data-state>{0}</select></label>'
    '<label>B <select id="b" data-state>{1}</select></label></div><p id="versus-text" role="status"></p>'
    '<div class="chart" id="versus" role="img"></div>'
    '<p class="note">A point above the diagonal is a problem that A solves better. Click a point to open it.</p>'
)


def write_page(
    paths: Sequence[Path | str], output: Path | str, *, paper: Paper | None = None, photo: PhotoFinder | None = None
) -> Path:
    """Write the page of one or several results folders, whole or not at all, and return where it is.

    photo: what finds the photo of a problem, to lie under its image points; see `bpnp.report.photos`.
    Raises ValueError if a folder, its points or its training log cannot be read.
    """
    output = Path(output)
    text = page_html(paths, paper=paper, photo=photo)
    with written_whole(output) as temporary:
        temporary.write_text(text, encoding="utf-8")
    return output


def page_html(
    paths: Sequence[Path | str], *, paper: Paper | None = None, photo: PhotoFinder | None = None
) -> str:  # fmt: skip
    """The page as text. Raises ValueError as `write_page`."""
    folders = named_runs(paths)
    logs = _logs(folders)
    runs = {} if trained_only(paths) else {name: read_results(path) for name, path in folders.items()}
    points = {name: read_points(path) for name, path in folders.items()}
    charts = page_charts(runs, logs)
    drawn = [chart for section in charts.values() for chart in section]
    names = [line.label for line in lines_of(runs)]
    sections = {
        **({"quartiles": ("Quartiles", quartiles_html(runs, paper))} if runs else {}),
        **(
            {"versus-section": ("Run against run", VERSUS.format(options(names), options(names, 1)))}
            if names[1:]
            else {}
        ),
        **{name: (HEADINGS[name], _charts_html(section, drawn)) for name, section in charts.items()},
        **({"failures": ("Failures", causes_html(runs))} if runs else {}),
    }
    plotly, assets = plotly_script(), files("bpnp.report.page") / "assets"
    data = compressed(json.dumps(page_numbers(runs) | {
        "keys": list(COLUMNS), "causes": CAUSES, "inks": INKS,
        "photos": {shown_id(id): image for id, image in page_photos(points, photo).items()},
        "charts": [chart.to_json() for chart in drawn], "config": CONFIG,
        "figures": {name: json.dumps(figure) for name, figure in figures().items()},
        "look": json.dumps(look()),
    }))  # fmt: skip
    links = {name: heading for name, (heading, _) in sections.items()} | ({"problems": "Problems"} if runs else {})
    colours = " ".join(f"--{name}: light-dark({light}, {dark});" for name, (light, dark) in INKS.items())
    parts = {
        "style": f":root {{ color-scheme: light dark; {colours} }}\n"
        + (assets / "page.css").read_text(encoding="utf-8"),
        "script": "\n".join((assets / name).read_text(encoding="utf-8") for name in SCRIPTS),
        "data": data,
        "points": page_points(runs, points, room=MOST_BYTES - len(data) - len(plotly) - 200_000),
        "plotly": plotly,
        "title": html.escape("bpnp: " + ", ".join(folders)),
        "headline": headline_html(runs),
        "list": options(names),
        "causes": options(CAUSES),
        "statuses": options(STATUSES),
        "no-problems": "" if runs else " hidden",
        "problem-head": problem_head("problem", sort=True),
        "number-head": problem_head("estimate"),
        "series": series_boxes(runs),
        "navigation": " ".join(f'<a href="#{name}">{heading}</a>' for name, heading in links.items()),
        "sections": "\n".join(
            f'<section id="{name}"><h2>{heading}</h2>{content}</section>'
            for name, (heading, content) in sections.items()
        ),
        "footer": f"plotly.js (MIT licence) is part of this file: {len(plotly) / 1e6:.1f} MB of it.",
    }
    pieces = (assets / "page.html").read_text(encoding="utf-8").split("%%")
    return "".join(parts[piece] if i % 2 else piece for i, piece in enumerate(pieces))


def problem_head(first: str, *, sort: bool = False) -> str:
    """The head of a table of problems or of the estimates of one, with buttons that sort."""
    heads = ""
    for key, (text, title) in {"id": (first, ""), **COLUMNS}.items():
        shown = f'<button type="button" data-key="{key}">{text}</button>' if sort else text
        heads += f'<th scope="col" title="{title}">{shown}</th>'
    return f'<thead><tr>{heads}<th scope="col" class="words">cause</th></tr></thead><tbody></tbody>'


@cache
def plotly_script() -> str:
    """plotly.js, compressed, in base64."""
    from plotly.offline import get_plotlyjs

    return compressed(get_plotlyjs())


def _charts_html(charts: Iterable[Any], figures: Sequence[Any]) -> str:
    places = {id(figure): i for i, figure in enumerate(figures)}
    shown = (
        f'<div class="chart" role="img" data-chart="{places[id(chart)]}" '
        f'aria-label="{visible(chart_text(chart))}"></div>'
        for chart in charts
    )
    return f'<div class="charts">{"".join(shown)}</div>'


def _logs(folders: Mapping[str, Path]) -> dict[str, TrainingLog]:
    """Each training once, under the name of the first results that stem from it."""
    logs: dict[tuple[Path, ...], tuple[str, TrainingLog]] = {}
    for name, folder in folders.items():
        log = read_training_log(folder)
        if log is not None:
            logs.setdefault(log.files, (name, log))
    return dict(logs.values())
