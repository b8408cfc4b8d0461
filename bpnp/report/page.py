"""Results as one HTML file that needs neither network nor server.

It contains plotly's script, compressed: 2.0 MB of text. Numbers and points are compressed JSON: eight runs of ten
thousand problems stay under 20 MB. Photos add up to 4 MB. The template and the scripts that draw in the browser are in
`assets`.
"""

import base64
import gzip
import io
import json
import math
import re
from collections.abc import Hashable, Iterable, Mapping, Sequence
from functools import cache
from importlib.resources import files
from itertools import zip_longest
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from markupsafe import Markup
from scipy.spatial.transform import Rotation

from bpnp.arrays import AnyArray
from bpnp.files import write_text
from bpnp.report.charts import CONFIG, RECALLS, chart_text, figures, import_plotly, look, recall_chart
from bpnp.report.groups import differences, group_table, training_configs
from bpnp.report.intervals import CAPTION as INTERVAL_CAPTION
from bpnp.report.intervals import IntervalTable, interval_table
from bpnp.report.photos import PhotoFinder, PhotoSource
from bpnp.report.points import ProblemPoints, read_points, utf8
from bpnp.report.results import (
    CAUSES,
    PLAUSIBLE_INLIERS,
    SOLVED_DEG,
    ProblemRow,
    Results,
    cause_fractions,
    read_results,
)
from bpnp.report.tables import (
    CAPTION,
    LOADING,
    QUARTILES,
    RESULT_COLUMNS,
    Line,
    best_texts,
    cell,
    lines_of,
    named_runs,
    problem_keys,
    problems_text,
    run_rows,
)
from bpnp.report.templates import render_page
from bpnp.report.terminal import DASHES, INKS, Paper
from bpnp.report.training_curves import lines_of_training, training_curves
from bpnp.report.training_run import training_of

FACTS = ("written", "bpnp_version", "correspondence_loss", "settings")  # facts of a run that the page shows
SCRIPTS = ("page.js", "problem.js")
SIZES = {"m": "2D points", "n": "3D points", "matches": "true matches"}
COLUMNS = {  # columns of the table of problems: head and hover text
    "rotation_error_deg": ("rot deg", "rotation error, degrees"),
    "translation_error": ("trans", "translation error, scene units"),
    "centre_error": ("centre", "distance of the camera centres, scene units"),
    "reprojection_error_deg": ("repr deg", "mean reprojection error of the true matches, degrees"),
    "inliers": ("inliers", "2D points with a projected 3D point within the inlier threshold"),
    "m": ("2D points", "2D points of the problem"),
    "n": ("3D points", "3D points of the problem"),
    "matches": ("matches", "3D points with a true match"),
    "iterations": ("iterations", "iterations of the solver"),
    "seconds": ("sec", "seconds, an equal part of those of its batch"),
}
PROBLEMS = 500  # number of problems whose points are on the page
PHOTO_BYTES = 4_000_000  # text of the photos on the page
DIGITS = 5  # significant digits of errors; for points and translations, relative to their extent
ROTATION_DIGITS = 12  # decimals of a quaternion, which is multiplied by points that may be far from the origin
ERRORS = ("rotation_error_deg", "translation_error", "centre_error", "reprojection_error_deg", "seconds")
COUNTS = ("inliers", "m", "n", "matches", "iterations")


class TableRow(NamedTuple):
    """Row of the table of quartiles."""

    name: str
    line: Line | None  # estimate, None for a published row
    cells: list[tuple[str, Any, bool]]  # text, number, and True for the best of its column


def write_page(
    paths: Sequence[Path | str],
    output: Path | str,
    *,
    paper: Paper | None = None,
    photos: PhotoFinder | None = None,
    intervals: IntervalTable | None = None,
    groups: IntervalTable | None = None,
) -> Path:
    """Write the page of one or several results folders atomically.

    Args:
        paths: Results folders.
        output: HTML file; an existing one is replaced.
        paper: Data set whose published rows are added, "modelnet40" or "megadepth". Default: None, no rows.
        photos: Function that finds the photos of each test. Default: None, no photos.
        intervals: Result of `interval_table` for these folders. Default: None, which computes it.
        groups: Result of `group_table` for these folders. Default: None, which computes it.

    Returns:
        Path of the file.

    Raises:
        ValueError: A folder or its points cannot be read.
    """
    return write_text(Path(output), page_html(paths, paper=paper, photos=photos, intervals=intervals, groups=groups))


def page_html(
    paths: Sequence[Path | str],
    *,
    paper: Paper | None = None,
    photos: PhotoFinder | None = None,
    intervals: IntervalTable | None = None,
    groups: IntervalTable | None = None,
) -> str:
    """Return the page as text; arguments and errors are those of `write_page`."""
    folders = named_runs(paths)
    runs = {name: read_results(path) for name, path in folders.items()}
    points = {name: read_points(path) for name, path in folders.items()}
    found = {} if photos is None else {name: photos(runs[name], points[name]) for name in runs}
    sources = {name: source for name, source in found.items() if source is not None}
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
    return render_page(
        "page.html",
        script=Markup("\n".join(map(_asset, SCRIPTS))),
        data=compress_text(json.dumps(numbers)),
        points=page_points(runs, points, sources),
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
        dashes=DASHES,
        lines=lines,
        heads=[column.header for column in RESULT_COLUMNS],
        rows=quartile_rows(runs, paper),
        caption=CAPTION,
        intervals=intervals or interval_table(runs),
        interval_caption=INTERVAL_CAPTION,
        trainings=training_pictures(folders, runs),
        groups=groups or group_table(runs),
        differences=differences(runs, training_configs(folders, runs)),
        charts=list(map(chart_text, charts)),
        causes=CAUSES,
        shares=[(line, *_shares(runs[line.run], line.estimate)) for line in lines],
        solved=f"{SOLVED_DEG:g} degrees",
        plausible=f"{100 * PLAUSIBLE_INLIERS:.0f} %",
        columns=COLUMNS,
        drawn=PROBLEMS,
    )


def training_pictures(folders: Mapping[str, Path], runs: Mapping[str, Results]) -> dict[str, str]:
    """Draw each training that has logs, once for all its tests, as SVG in base64 by the names of these."""
    tests: dict[Path, list[str]] = {}
    for name, folder in folders.items():
        if (run := training_of(folder, runs[name])) is not None:
            tests.setdefault(run, []).append(name)
    pictures = {}
    for run, names in tests.items():
        drawing = io.StringIO()
        figure = training_curves(run, lines_of_training(run, folders, runs))
        figure.savefig(drawing, format="svg", metadata={"Date": None}, transparent=True)
        pictures[", ".join(names)] = base64.b64encode(in_both_schemes(drawing.getvalue()).encode()).decode()
    return pictures


def in_both_schemes(svg: str) -> str:
    """Return a picture whose colours of `INKS` follow the scheme of the page."""
    dark = dict(INKS.values())
    themed = re.sub("|".join(dark), lambda ink: f"light-dark({ink[0]}, {dark[ink[0]]})", svg)
    return themed.replace("<svg ", '<svg style="color-scheme: light dark" ', 1)


def quartile_rows(runs: Mapping[str, Results], paper: Paper | None) -> list[TableRow]:
    """Return the rows of the table of quartiles, with three digits."""
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
    rotation, translation = QUARTILES[1], QUARTILES[4]
    errors = (f"{name} {cell(rotation, v)} deg, {cell(translation, v)}" for name, v in results.estimates.items())
    outcome = f"Estimates by median rotation error and translation error: {'; '.join(errors)}"
    return f"{problems_text(str(len(rows)))} with {', '.join(sizes)}. {outcome}"


def _settings(settings: Mapping[str, Any]) -> Iterable[str]:
    """Yield the solver, data and checkpoint of a test that were recorded."""
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


def _shares(results: Results, estimate: str) -> tuple[list[float], float | None]:
    """Return the percentages of problems with each cause, and of those that converged, None if all are solved."""
    fractions = cause_fractions(results.of(estimate))
    converged = 100 * results.estimates[estimate].get("converged", float("nan"))
    return [100 * fraction for fraction in fractions.values()], None if fractions["solved"] == 1 else converged


@cache
def plotly_script() -> str:
    """Return plotly.js, compressed, in base64."""
    return compress_text(import_plotly().offline.get_plotlyjs())


def _asset(name: str) -> str:
    return (files("bpnp.report") / "assets" / name).read_text(encoding="utf-8")


def compress_text(text: str) -> str:
    """Return a text as gzip in base64, which the function `inflated` of the page reads."""
    return base64.b64encode(gzip.compress(text.encode(), 6, mtime=0)).decode()


def page_numbers(runs: Mapping[str, Results]) -> dict[str, Any]:
    """Return the numbers of all problems: a series for each run and estimate. Equal columns are stored once.

    "problems" numbers the problems: the same number stands for the same problem of the same data, see `problem_keys`.
    """
    columns: dict[tuple[Any, ...], int] = {}
    problems: dict[Hashable, int] = {}

    def add_column(values: Iterable[Any]) -> int:
        return columns.setdefault(tuple(values), len(columns))

    series = []
    for line in lines_of(runs):
        rows = runs[line.run].of(line.estimate)
        names = {"run": line.run, "estimate": line.estimate, "name": line.label, "colour": f"c{line.colour}"}
        ids, numbers = add_column(utf8(row.id) or "(no name)" for row in rows), _columns(rows)
        keys = problem_keys(runs[line.run], rows)
        same = add_column(problems.setdefault(key, len(problems)) for key in keys)
        columns_of = {key: add_column(values) for key, values in numbers.items()}
        series.append(names | {"ids": ids, "problems": same, "numbers": columns_of})
    return {"series": series, "columns": list(columns)}


def page_points(
    runs: Mapping[str, Results],
    points: Mapping[str, Sequence[ProblemPoints]],
    photos: Mapping[str, PhotoSource] | None = None,
) -> str:
    """Return the points of the `PROBLEMS` worst problems of all runs: compressed lines of JSON.

    The first line has, by run, the number of the following line for each of the run's problems, -1 for none. Runs on
    the same points share lines. The worst problems have their photos, `PHOTO_BYTES` in all.
    """
    keys = {name: {problem.index: _key(problem) for problem in points[name]} for name in runs}
    shared: dict[Hashable, dict[str, ProblemPoints]] = {}
    for name in runs:
        for problem in points[name]:
            shared.setdefault(keys[name][problem.index], {})[name] = problem
    error = {key: max(problem.error for problem in by_run.values()) for key, by_run in shared.items()}
    worst = sorted(error, key=lambda key: -error[key])[:PROBLEMS]
    number = {key: i for i, key in enumerate(worst)}
    line_numbers = {
        name: [number.get(keys[name].get(row.index), -1) for row in results.of(next(iter(results.estimates)))]
        for name, results in runs.items()
    }
    lines, left = [], PHOTO_BYTES
    for key in worst:
        line = _line(shared[key])
        if left > 0 and (photo := _photo(shared[key], photos or {})) is not None:
            line["photo"] = photo
            left -= len(photo["jpeg"])
        lines.append(json.dumps(line, separators=(",", ":")))
    return compress_text("\n".join([json.dumps(line_numbers), *lines]))


def _key(problem: ProblemPoints) -> Hashable:
    """Return a key that is equal for problems with the same name, points and true pose."""
    pose = None if problem.pose is None else np.c_[problem.pose].tobytes()
    return problem.id, problem.points2d.tobytes(), problem.points3d.tobytes(), pose


def _columns(rows: Sequence[ProblemRow]) -> dict[str, list[Any]]:
    return {
        **{key: [_shorten_number(getattr(row, key)) for row in rows] for key in ERRORS},
        **{key: [getattr(row, key) for row in rows] for key in COUNTS},
        "cause": [CAUSES.index(row.cause) for row in rows],
    }


def _shorten_number(value: float) -> float | str:
    """Round to `DIGITS` significant digits; NaN and infinity become the names that JavaScript's `Number()` reads."""
    if math.isfinite(value):
        return float(f"{value:.{DIGITS}g}")
    return "NaN" if math.isnan(value) else "Infinity"


def _line(runs: Mapping[str, ProblemPoints]) -> dict[str, Any]:
    """Return points, true matches and true pose, and the poses and assigned matches of each run."""
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


def _photo(runs: Mapping[str, ProblemPoints], photos: Mapping[str, PhotoSource]) -> dict[str, Any] | None:
    """Return the photo of a problem and its extent in normalised coordinates."""
    found = (photos[name](problem) for name, problem in runs.items() if name in photos)
    photo = next((photo for photo in found if photo is not None), None)
    return None if photo is None else {"jpeg": photo.jpeg, "extent": [round(x, DIGITS) for x in photo.extent]}


def _decimals(points: AnyArray) -> int:
    """Return the number of decimal places for `DIGITS` digits of the points' extent."""
    extent = float(np.ptp(points, axis=0).max()) if len(points) else 0.0
    return DIGITS - math.floor(math.log10(extent)) if extent > 0 else DIGITS


def _pose(pose: tuple[AnyArray, AnyArray] | None, decimals: int) -> list[float] | None:
    """Return quaternion (x, y, z, w) and translation; None without a pose."""
    if pose is None or not np.isfinite(np.c_[pose]).all():
        return None
    quaternion = Rotation.from_matrix(pose[0]).as_quat()
    return [*np.round(quaternion, ROTATION_DIGITS).tolist(), *np.round(np.asarray(pose[1], float), decimals).tolist()]
