"""Results as one HTML file that needs nothing else: no network, no server.

plotly's script is inside, compressed: 2.0 MB of text. The numbers and points travel as compressed JSON: eight runs of
ten thousand problems stay under 20 MB. The template and what is drawn by the browser are in `assets`.
"""

import base64
import gzip
import io
import json
import math
from collections.abc import Hashable, Iterable, Mapping, Sequence
from functools import cache
from importlib.resources import files
from itertools import zip_longest
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jinja2 import Environment
from markupsafe import Markup
from scipy.spatial.transform import Rotation

from bpnp.files import write_text
from bpnp.report.charts import CONFIG, RECALLS, chart_text, figures, look, recall_chart
from bpnp.report.groups import differences, group_rows
from bpnp.report.intervals import CAPTION as INTERVALS
from bpnp.report.intervals import HEADERS, interval_cells
from bpnp.report.points import Array, ProblemPoints, read_points, utf8
from bpnp.report.results import CAUSES, PLAUSIBLE_INLIERS, SOLVED_DEG, ProblemRow, Results, cause_shares, read_results
from bpnp.report.tables import CAPTION, LOADING, RESULT_COLUMNS, Line, best_texts, cell, lines_of, named_runs, run_rows
from bpnp.report.terminal import DASHES, INKS, Paper
from bpnp.report.training_curves import training_curves, training_folder

FACTS = ("written", "bpnp_version", "correspondence_loss", "settings")  # of a run
SCRIPTS = ("page.js", "problem.js")
SIZES = {"m": "2D points", "n": "3D points", "matches": "true matches"}
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
PROBLEMS = 500  # whose points are on the page
DIGITS = 5  # significant ones of errors; of points and poses, of their extent
ERRORS = ("rotation_error_deg", "translation_error", "centre_error", "reprojection_error_deg", "seconds")
COUNTS = ("inliers", "m", "n", "matches", "iterations")


class TableRow(NamedTuple):
    """line: None for a published row. cells: text, number and whether it is the best of its column."""

    name: str
    line: Line | None
    cells: list[tuple[str, Any, bool]]


def write_page(paths: Sequence[Path | str], output: Path | str, *, paper: Paper | None = None) -> Path:
    """Write the page of one or several results folders, whole or not at all, and return where it is.

    Raises ValueError if a folder or its points cannot be read.
    """
    return write_text(Path(output), page_html(paths, paper=paper))


def page_html(paths: Sequence[Path | str], *, paper: Paper | None = None) -> str:
    """The page as text. Raises ValueError as `write_page`."""
    folders = named_runs(paths)
    runs = {name: read_results(path) for name, path in folders.items()}
    points = {name: read_points(path) for name, path in folders.items()}
    charts = [chart for error in RECALLS if (chart := recall_chart(runs, error, paper=paper)) is not None]
    numbers = page_numbers(runs) | {
        "keys": list(COLUMNS),
        "causes": CAUSES,
        "inks": INKS,
        "charts": [chart.to_json() for chart in charts],
        "config": CONFIG,
        "figures": {name: json.dumps(figure) for name, figure in figures().items()},
        "look": json.dumps(look()),
    }
    lines = lines_of(runs)
    # Names are text, whatever is in them: what is not Markup is escaped, bytes that are no UTF-8 are replaced.
    page = Environment(
        autoescape=True, finalize=lambda it: utf8(it) if type(it) is str else it, trim_blocks=True, lstrip_blocks=True
    )
    return page.from_string(_asset("page.html")).render(
        style=Markup(_asset("page.css")),
        script=Markup("\n".join(map(_asset, SCRIPTS))),
        data=compress_text(json.dumps(numbers)),
        points=page_points(runs, points),
        plotly=plotly_script(),
        runs={
            name: (
                describe_run(results),
                ", ".join(_settings(results.settings)),
                json.dumps({key: getattr(results, key) for key in FACTS}, indent=2),
            )
            for name, results in runs.items()
        },
        folders=", ".join(folders),
        inks=INKS,
        dashes=DASHES,
        lines=lines,
        heads=[column.header for column in RESULT_COLUMNS],
        rows=quartile_rows(runs, paper),
        caption=CAPTION,
        interval_heads=HEADERS,
        intervals=list(zip(lines, interval_cells(runs), strict=True)),
        interval_caption=INTERVALS,
        trainings=training_pictures(folders),
        groups=group_rows(runs),
        differences=differences(runs),
        charts=list(map(chart_text, charts)),
        causes=CAUSES,
        shares=[(line, *_shares(runs[line.run], line.estimate)) for line in lines],
        solved=f"{SOLVED_DEG:g} degrees",
        plausible=f"{100 * PLAUSIBLE_INLIERS:.0f} %",
        columns=COLUMNS,
        drawn=PROBLEMS,
    )


def training_pictures(folders: Mapping[str, Path]) -> dict[str, str]:
    """Draw the training of each run that has logs, as SVG in base64."""
    pictures = {}
    for name, folder in folders.items():
        if (run := training_folder(folder)) is not None:
            drawing = io.BytesIO()
            training_curves(run).savefig(drawing, format="svg", metadata={"Date": None})
            pictures[name] = base64.b64encode(drawing.getvalue()).decode()
    return pictures


def quartile_rows(runs: Mapping[str, Results], paper: Paper | None) -> list[TableRow]:
    """The rows of the table of quartiles, with the terminal's texts."""
    rows = run_rows(runs, paper)
    best = best_texts(RESULT_COLUMNS, rows)
    shown = []
    for row, line in zip_longest(rows, lines_of(runs)):
        texts = [(cell(column, row.values), row.values.get(column.key), column.key) for column in RESULT_COLUMNS]
        cells = [(text, value, bool(line) and text == best.get((row.problems, key))) for text, value, key in texts]
        shown.append(TableRow(row.name, line, cells))
    return shown


def describe_run(results: Results) -> str:
    """Describe the problems and the outcome of a run."""
    rows = results.of(next(iter(results.estimates)))
    spans = {what: sorted(getattr(row, key) for row in rows) for key, what in SIZES.items()}
    sizes = (f"{span[0] if span[0] == span[-1] else f'{span[0]} to {span[-1]}'} {what}" for what, span in spans.items())
    best, values = min(results.estimates.items(), key=lambda item: item[1]["rotation_q2_deg"])
    solved = f"{100 * cause_shares(results.of(best))['solved']:.1f} % within {SOLVED_DEG:g} deg"
    outcome = f"{best}: median rotation error {cell(RESULT_COLUMNS[1], values)} deg, {solved}"
    return f"{len(rows)} problems with {', '.join(sizes)}. {outcome}"


def _settings(settings: Mapping[str, Any]) -> Iterable[str]:
    """Solver, data and checkpoint of a test, as far as they were recorded."""
    for name in ("solver", "data"):
        part = settings.get(name)
        if isinstance(part, Mapping) and "class_path" in part:
            plain = {k: v for k, v in (part.get("init_args") or {}).items() if isinstance(v, (int, float, str)) and v}
            options = ", ".join(f"{key} {value}" for key, value in plain.items() if key not in LOADING)
            kind = str(part["class_path"]).rpartition(".")[2]
            yield f"{name} {kind}" + (f" ({options})" if options and name == "data" else "")
    if settings.get("complete") is False:
        yield "interrupted before the last problem"
    if settings.get("checkpoint"):
        yield f"checkpoint {settings['checkpoint']}"


def _shares(results: Results, estimate: str) -> tuple[list[float], float]:
    """Percent of the problems with each cause, and that the solver calls converged."""
    shares = np.array(list(cause_shares(results.of(estimate)).values()))
    return (100 * shares).tolist(), 100 * results.estimates[estimate].get("converged", float("nan"))


@cache
def plotly_script() -> str:
    """plotly.js, compressed, in base64."""
    from plotly.offline import get_plotlyjs

    return compress_text(get_plotlyjs())


def _asset(name: str) -> str:
    return (files("bpnp.report") / "assets" / name).read_text(encoding="utf-8")


def compress_text(text: str) -> str:
    """gzip in base64, which the page's `inflated` reads."""
    return base64.b64encode(gzip.compress(text.encode(), 6, mtime=0)).decode()


def page_numbers(runs: Mapping[str, Results]) -> dict[str, Any]:
    """The numbers of all problems: a series for each run and estimate. Columns of several series are there once."""
    columns: dict[tuple[Any, ...], int] = {}

    def place(values: Iterable[Any]) -> int:
        return columns.setdefault(tuple(values), len(columns))

    series = []
    for line in lines_of(runs):
        rows = runs[line.run].of(line.estimate)
        names = {"run": line.run, "estimate": line.estimate, "name": line.label, "colour": f"c{line.colour}"}
        ids, numbers = place(utf8(row.id) or "(no name)" for row in rows), _columns(rows)
        series.append(names | {"ids": ids, "numbers": {key: place(values) for key, values in numbers.items()}})
    return {"series": series, "columns": list(columns)}


def page_points(runs: Mapping[str, Results], points: Mapping[str, Sequence[ProblemPoints]]) -> str:
    """The points of the `PROBLEMS` worst problems of all runs: compressed lines of JSON.

    The first line has, by run, the number of the line after it for each of the run's problems, -1 for none. Runs on the
    same points share lines.
    """
    keys = {name: {problem.index: _key(problem) for problem in points[name]} for name in runs}
    shared: dict[Hashable, dict[str, ProblemPoints]] = {}
    for name in runs:
        for problem in points[name]:
            shared.setdefault(keys[name][problem.index], {})[name] = problem
    error = {key: max(problem.error for problem in by_run.values()) for key, by_run in shared.items()}
    worst = sorted(error, key=lambda key: -error[key])[:PROBLEMS]
    place = {key: number for number, key in enumerate(worst)}
    places = {
        name: [place.get(keys[name].get(row.index), -1) for row in results.of(next(iter(results.estimates)))]
        for name, results in runs.items()
    }
    lines = [json.dumps(_line(shared[key]), separators=(",", ":")) for key in worst]
    return compress_text("\n".join([json.dumps(places), *lines]))


def _key(problem: ProblemPoints) -> Hashable:
    """The same for problems of the same points: the name, the points that are there and the true pose."""
    pose = None if problem.pose is None else np.c_[problem.pose].tobytes()
    return problem.id, problem.points2d.tobytes(), problem.points3d.tobytes(), pose


def _columns(rows: Sequence[ProblemRow]) -> dict[str, list[Any]]:
    return {
        **{key: [_shorten_number(getattr(row, key)) for row in rows] for key in ERRORS},
        **{key: [getattr(row, key) for row in rows] for key in COUNTS},
        "cause": [CAUSES.index(row.cause) for row in rows],
    }


def _shorten_number(value: float) -> float | str:
    """`DIGITS` significant digits; of what JSON has no number for, the name that JavaScript's `Number` reads."""
    if math.isfinite(value):
        return float(f"{value:.{DIGITS}g}")
    return "NaN" if math.isnan(value) else "Infinity"


def _line(runs: Mapping[str, ProblemPoints]) -> dict[str, Any]:
    """Points, true matches and pose; of each run the poses and the assigned matches."""
    shown = next(iter(runs.values()))
    ids2d, ids3d = (ids.tolist() for ids in shown.numbers())
    decimals = _decimals(shown.points3d)
    assigned = {name: problem.assigned3d.tolist() for name, problem in runs.items() if (problem.assigned3d >= 0).any()}
    return {
        "points2d": np.round(shown.points2d.astype(float), _decimals(shown.points2d)).tolist(),
        "points3d": np.round(shown.points3d.astype(float), decimals).tolist(),
        "ids2d": ids2d,
        "ids3d": ids3d,
        "match3d": shown.match3d.tolist(),
        "assigned": assigned,
        "truth": _pose(shown.pose, decimals),
        "poses": {
            name: {estimate: _pose(pose, decimals) for estimate, pose in problem.estimates.items()}
            for name, problem in runs.items()
        },
    }


def _decimals(points: Array) -> int:
    """Decimal places of `DIGITS` digits of the points' extent."""
    extent = float(np.ptp(points, axis=0).max()) if len(points) else 0.0
    return DIGITS - math.floor(math.log10(extent)) if extent > 0 else DIGITS


def _pose(pose: tuple[Array, Array] | None, decimals: int) -> list[float] | None:
    """Quaternion (x, y, z, w) and translation; none without a pose."""
    if pose is None or not np.isfinite(np.c_[pose]).all():
        return None
    quaternion = Rotation.from_matrix(pose[0]).as_quat()
    return [*np.round(quaternion, DIGITS).tolist(), *np.round(np.asarray(pose[1], float), decimals).tolist()]
