"""Results as one HTML file that needs nothing else: no network, no server.

plotly's script is inside, compressed: 2.0 MB of text. The numbers travel as JSON, long columns as base64 of
little-endian arrays: eight runs of ten thousand pairs stay under 20 MB. What is drawn from them is in `assets`.
"""

import base64
import gzip
import html
import json
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

from bpnp.files import written_whole
from bpnp.report.folder import read_results
from bpnp.report.page import templates
from bpnp.report.page.charts import chart_text, page_charts
from bpnp.report.page.points import packed, page_points, whole
from bpnp.report.page.text import causes_html, headline_html, labels, options, quartiles_html, series_buttons, visible
from bpnp.report.palette import DARK, DARK_BACKGROUND, DARK_INKS, INKS, LIGHT, LIGHT_BACKGROUND, LIGHT_INKS, styles
from bpnp.report.photos import PhotoFinder, page_photos
from bpnp.report.results import CAUSES, PairRow, Results
from bpnp.report.runs import named_runs, trained_only
from bpnp.report.samples import read_views
from bpnp.report.tables.published import Paper
from bpnp.report.training_log import TrainingLog, read_training_log

SCRIPTS = ("results.js", "pairs.js", "viewer.js")
MOST_BYTES = 19_850_000
ERRORS = ("rotation_error_deg", "translation_error", "centre_error", "reprojection_error_deg", "seconds")
COUNTS = ("inliers", "iterations")
SIZES = ("m", "n", "true_pairs")
COLUMNS = {  # of the table of pairs: head and hover text
    "rotation_error_deg": ("rot deg", "rotation error, degrees"),
    "translation_error": ("trans", "translation error, scene units"),
    "centre_error": ("centre", "distance of the camera centres, scene units"),
    "reprojection_error_deg": ("repr deg", "mean reprojection error of the true matches, degrees"),
    "inliers": ("inliers", "2D points with a reprojected 3D point beside them"),
    "m": ("2D points", "2D points of the pair"),
    "n": ("3D points", "3D points of the pair"),
    "true_pairs": ("true pairs", "3D points with a true match"),
    "iterations": ("iterations", "iterations of the solver"),
    "seconds": ("sec", "seconds, the pair's share of its batch"),
}
# Of plotly's buttons those that are not shown.
BUTTONS = (
    "sendChartToCloud",
    "select2d",
    "lasso2d",
    "autoScale2d",
    "tableRotation",
    "resetCameraLastSave3d",
)  # not shown
STATUSES = ("converged", "not converged", "no pose")
HEADINGS = {"recall": "Recall", "errors": "Errors against size", "time": "Time", "training": "Training"}


def write_page(
    paths: Sequence[Path | str], output: Path | str, *, paper: Paper | None = None, photo: PhotoFinder | None = None
) -> Path:
    """Write the page of one or several results folders, whole or not at all, and return where it is.

    photo: what finds the photo of a pair, to lie under its 2D view; see `bpnp.report.photos`.
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
    only_trained = bool(logs) and trained_only(paths)
    runs = {} if only_trained else {name: read_results(path) for name, path in folders.items()}
    views = {name: read_views(path) for name, path in folders.items()}
    charts = page_charts(runs, logs)
    figures = [chart for section in charts.values() for chart in section]
    several = sum(len(results.estimates) for results in runs.values()) > 1
    sections = {
        **({"quartiles": ("Quartiles", quartiles_html(runs, paper))} if runs else {}),
        **({"versus-section": ("Run against run", VERSUS.format(options(labels(runs).values())))} if several else {}),
        **{name: (HEADINGS[name], _charts_html(own, figures)) for name, own in charts.items()},
        **({"failures": ("Failures", causes_html(runs))} if runs else {}),
    }
    data = script_json(page_data(runs) | {
        "photos": page_photos(views, photo), "charts": [chart.to_json() for chart in figures], "buttons": BUTTONS,
        "figures": {name: json.dumps(figure) for name, figure in templates.figures().items()},
        "look": json.dumps(templates.look()),
    })  # fmt: skip
    plotly, assets = plotly_script(), files("bpnp.report.page") / "assets"
    places = {name: _places(results) for name, results in runs.items()}
    links = {name: heading for name, (heading, _) in sections.items()} | ({"pairs": "Pairs"} if runs else {})
    parts = {
        "style": _colours() + (assets / "page.css").read_text(encoding="utf-8"),
        "script": "\n".join((assets / name).read_text(encoding="utf-8") for name in SCRIPTS),
        "data": data,
        "points": script_json(page_points(views, places, room=MOST_BYTES - len(data) - len(plotly) - 200_000)),
        "plotly": plotly,
        "title": html.escape("bpnp: " + ", ".join(folders)),
        "headline": headline_html(runs),
        "list": options(labels(runs).values()),
        "causes": options(CAUSES),
        "statuses": options(STATUSES),
        "no-pairs": "" if runs else " hidden",
        "pair-head": pair_head("pair", sort=True),
        "number-head": pair_head("estimate"),
        "series": series_buttons(runs),
        "navigation": " ".join(f'<a href="#{name}">{heading}</a>' for name, heading in links.items()),
        "sections": "\n".join(
            f'<section id="{name}"><h2>{heading}</h2>{content}</section>'
            for name, (heading, content) in sections.items()
        ),
        "footer": f"plotly.js (MIT licence) is part of this file: {len(plotly) / 1e6:.1f} MB of it.",
    }
    pieces = (assets / "page.html").read_text(encoding="utf-8").split("%%")
    return "".join(parts[piece] if i % 2 else piece for i, piece in enumerate(pieces))


VERSUS = (
    '<div class="controls"><label>A <select id="a" data-state>{0}</select></label>'
    '<label>B <select id="b" data-state>{0}</select></label></div><p id="versus-text" role="status"></p>'
    '<div class="chart" id="versus" role="img" style="height: 420px; max-width: 42rem"></div>'
    '<p class="note">A point above the diagonal is a pair that A solves better. Click a point to open its pair.</p>'
)


def page_data(runs: Mapping[str, Results]) -> dict[str, Any]:
    """The numbers of all pairs, in the types of strict JSON and the packed columns of `packed`."""
    shapes = styles({name: list(results.estimates) for name, results in runs.items()})
    ids: list[list[str]] = []
    shown = []
    for name, results in runs.items():
        pairs = results.of(next(iter(results.estimates)))
        own = [row.id for row in pairs]
        if own not in ids:
            ids.append(own)
        estimates = {
            key: {"columns": _columns(results.of(key)), "colour": shapes[name, key][0]} for key in results.estimates
        }
        sizes = {key: whole([getattr(row, key) for row in pairs]) for key in SIZES}
        shown.append({"name": name, "ids": ids.index(own), "sizes": sizes, "estimates": estimates})
    columns = [{"key": key, "whole": key in (*COUNTS, *SIZES)} for key in COLUMNS]
    colours = [[*LIGHT, *LIGHT_INKS], [*DARK, *DARK_INKS]]
    return {"runs": shown, "ids": ids, "columns": columns, "causes": CAUSES, "colours": colours}


def pair_head(first: str, *, sort: bool = False) -> str:
    """The head of a table of pairs or of estimates of a pair, with buttons that sort."""
    cells = [("id", first, ""), *((key, *shown) for key, shown in COLUMNS.items())]
    texts = (
        (title, f'<button type="button" data-key="{key}">{text}</button>' if sort else text)
        for key, text, title in cells
    )
    heads = "".join(f'<th scope="col" title="{title}">{text}</th>' for title, text in texts)
    return f'<thead><tr>{heads}<th scope="col" class="words">cause</th></tr></thead><tbody></tbody>'


def script_json(value: Any) -> str:
    """JSON that can stand in a script element: no name in it can close the element or open another."""
    text = json.dumps(value, allow_nan=False, separators=(",", ":"))
    return text.replace("&", "\\u0026").replace("<", "\\u003c").replace(">", "\\u003e")


@cache
def plotly_script() -> str:
    """plotly.js, compressed, in base64."""
    from plotly.offline import get_plotlyjs

    return base64.b64encode(gzip.compress(get_plotlyjs().encode(), 9, mtime=0)).decode()


def _columns(rows: Sequence[PairRow]) -> dict[str, dict[str, str]]:
    status = [2 if not row.found else 0 if row.converged else 1 for row in rows]
    return {
        **{key: packed([getattr(row, key) for row in rows], "f4") for key in ERRORS},
        **{key: whole([getattr(row, key) for row in rows]) for key in COUNTS},
        "cause": packed([CAUSES.index(row.cause) for row in rows], "u1"),
        "status": packed(status, "u1"),
    }


def _charts_html(charts: Iterable[Any], figures: Sequence[Any]) -> str:
    places = {id(figure): i for i, figure in enumerate(figures)}
    return '<div class="charts">{}</div>'.format(
        "".join(
            f'<div class="chart" role="img" data-chart="{places[id(chart)]}" '
            f'aria-label="{visible(chart_text(chart))}"></div>'
            for chart in charts
        )
    )


def _places(results: Results) -> dict[int, int]:
    """The place of each pair's index in the page's lists."""
    return {row.index: i for i, row in enumerate(results.of(next(iter(results.estimates))))}


def _logs(folders: Mapping[str, Path]) -> dict[str, TrainingLog]:
    """Each training once, under the name of the first results that stem from it."""
    logs: dict[tuple[Path, ...], tuple[str, TrainingLog]] = {}
    for name, folder in folders.items():
        log = read_training_log(folder)
        if log is not None:
            logs.setdefault(log.files, (name, log))
    return dict(logs.values())


def _colours() -> str:
    schemes = ((LIGHT, LIGHT_BACKGROUND, LIGHT_INKS), (DARK, DARK_BACKGROUND, DARK_INKS))
    light, dark = (
        " ".join(
            f"--{name}: {colour};"
            for name, colour in (
                *((f"c{i}", colour) for i, colour in enumerate(colours)),
                ("background", background),
                *zip(INKS, inks, strict=True),
            )
        )
        for colours, background, inks in schemes
    )
    return f":root {{ {light} }}\n@media (prefers-color-scheme: dark) {{ :root {{ {dark} }} }}\n"
