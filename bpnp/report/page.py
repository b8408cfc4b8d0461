"""Results as one HTML file that needs nothing else: no network, no server, no library.

The numbers travel as JSON inside the file, long columns as base64 of little-endian arrays: eight runs of ten thousand
pairs stay under 20 MB. What is drawn from them is in `assets`.
"""

import html
import json
from collections.abc import Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from bpnp.files import written_whole
from bpnp.report.causes import CAUSES, SOLVED_DEG, cause_of
from bpnp.report.page_views import packed, page_sketches, page_view
from bpnp.report.palette import DARK, DARK_BACKGROUND, DASHES, LIGHT, LIGHT_BACKGROUND, styles
from bpnp.report.photos import PhotoFinder, page_photos
from bpnp.report.results import PairRow, Results, read_results
from bpnp.report.runs import named_runs
from bpnp.report.sketches import read_sketches
from bpnp.report.tables import PAPER, RESULT_COLUMNS, Paper, cell
from bpnp.report.training_log import TrainingLog, read_training_log
from bpnp.report.views import PairView, read_views

SCRIPTS = (
    "data.js",
    "sketches.js",
    "chart.js",
    "quartiles.js",
    "plots.js",
    "training.js",
    "pairs.js",
    "scene.js",
    "image.js",
    "dialog.js",
    "main.js",
)
MOST_BYTES = 19_850_000
ERRORS = ("rotation_error_deg", "translation_error", "centre_error", "reprojection_error_deg", "seconds")
COUNTS = ("inliers", "iterations")
SIZES = ("m", "n", "true_pairs")


def write_page(
    paths: Sequence[Path | str], output: Path | str, *, paper: Paper | None = None, photo: PhotoFinder | None = None
) -> Path:
    """Write the page of one or several results folders, whole or not at all, and return where it is.

    photo: what finds the photo of a pair, to lie under its 2D view; see `bpnp.report.photos`.
    Raises ValueError if a folder, its views or its training log cannot be read.
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
    runs = {name: read_results(path) for name, path in folders.items()}
    views = {name: read_views(path) for name, path in folders.items()}
    data = page_data(runs, views, _logs(folders), paper=paper) | {"photos": page_photos(views, photo)}
    text = script_json(data)
    places = {name: _places(results) for name, results in runs.items()}
    sketches = {name: read_sketches(path) for name, path in folders.items()}
    own, groups = page_sketches(sketches, places, room=MOST_BYTES - len(text))
    assets = files("bpnp.report") / "assets"
    scripts = "\n".join((assets / name).read_text(encoding="utf-8") for name in SCRIPTS)
    parts = {
        "style": _colours() + (assets / "page.css").read_text(encoding="utf-8"),
        "script": f"(() => {{\n{scripts}}})();\n",
        "data": text,
        "sketches": script_json({"runs": own, "groups": groups}),
        "title": html.escape("bpnp: " + ", ".join(runs)),
    }
    pieces = (assets / "page.html").read_text(encoding="utf-8").split("%%")
    return "".join(parts[piece] if i % 2 else piece for i, piece in enumerate(pieces))


def page_data(
    runs: Mapping[str, Results],
    views: Mapping[str, Sequence[PairView]],
    logs: Mapping[str, TrainingLog],
    *,
    paper: Paper | None = None,
) -> dict[str, Any]:
    """All that the page shows, in the types of strict JSON and the packed columns of `packed`."""
    shapes = styles({name: list(results.estimates) for name, results in runs.items()})
    ids: list[list[str]] = []
    shown = []
    for name, results in runs.items():
        estimates = list(results.estimates)
        pairs = [row for row in results.rows if row.estimate == estimates[0]]
        own = [row.id for row in pairs]
        if own not in ids:
            ids.append(own)
        position = _places(results)
        shown.append(
            {
                "name": name,
                "written": results.written,
                "bpnp_version": results.bpnp_version,
                "settings": results.settings,
                "correspondence_loss": results.correspondence_loss,
                "ids": ids.index(own),
                "sizes": {key: _whole([getattr(row, key) for row in pairs]) for key in SIZES},
                "estimates": {
                    key: _estimate([row for row in results.rows if row.estimate == key], results.estimates[key])
                    | {"colour": shapes[name, key][0], "dashes": DASHES[shapes[name, key][1]]}
                    for key in estimates
                },
                "views": {str(position[v.index]): page_view(v) for v in views.get(name, ()) if v.index in position},
            }
        )
    return {
        "runs": shown,
        "ids": ids,
        "causes": CAUSES,
        "solved_deg": SOLVED_DEG,
        "columns": [{"header": column.header.split("\n"), "share": column.share} for column in RESULT_COLUMNS],
        "paper": _paper(paper),
        "logs": [_log(name, log) for name, log in logs.items()],
    }


def script_json(value: Any) -> str:
    """JSON that can stand in a script element: no name in it can close the element or open another."""
    text = json.dumps(value, allow_nan=False, separators=(",", ":"))
    return text.replace("&", "\\u0026").replace("<", "\\u003c").replace(">", "\\u003e")


def _places(results: Results) -> dict[int, int]:
    """The place of each pair's index in the page's lists."""
    first = next(iter(results.estimates))
    return {row.index: i for i, row in enumerate(row for row in results.rows if row.estimate == first)}


def _estimate(rows: Sequence[PairRow], values: Mapping[str, float]) -> dict[str, Any]:
    numbers = [values.get(column.key) for column in RESULT_COLUMNS]
    texts = [cell(column, values) for column in RESULT_COLUMNS]
    finite = [value if value is not None and np.isfinite(value) else None for value in numbers]
    return {
        "cells": list(zip(texts, finite, strict=True)),
        "columns": {key: packed([getattr(row, key) for row in rows], "f4") for key in ERRORS}
        | {key: _whole([getattr(row, key) for row in rows]) for key in COUNTS}
        | {"cause": packed([CAUSES.index(cause_of(row)) for row in rows], "u1")},
    }


def _whole(values: Sequence[int]) -> dict[str, str]:
    return packed(values, "u2" if min(values) >= 0 and max(values) < 2**16 else "i4")


def _paper(paper: Paper | None) -> list[dict[str, Any]]:
    if paper is None:
        return []
    name, estimates = PAPER[paper]
    return [
        {"name": f"{name}: {estimate}", "cells": [values.get(column.key, "-") for column in RESULT_COLUMNS]}
        for estimate, values in estimates.items()
    ]


def _logs(folders: Mapping[str, Path]) -> dict[str, TrainingLog]:
    """Each training once, under the name of the first results that stem from it."""
    logs: dict[tuple[Path, ...], tuple[str, TrainingLog]] = {}
    for name, folder in folders.items():
        log = read_training_log(folder)
        if log is not None:
            logs.setdefault(log.files, (name, log))
    return dict(logs.values())


def _log(name: str, log: TrainingLog) -> dict[str, Any]:
    curves = {
        key: {"steps": packed(steps, "f4"), "values": packed(values, "f4")}
        for key, (steps, values) in log.curves.items()
    }
    return {"name": name, "switch_step": log.switch_step, "curves": curves}


def _colours() -> str:
    schemes = ((LIGHT, LIGHT_BACKGROUND), (DARK, DARK_BACKGROUND))
    light, dark = (
        " ".join(f"--c{i}: {colour};" for i, colour in enumerate(colours)) + f" --background: {background};"
        for colours, background in schemes
    )
    return f":root {{ {light} }}\n@media (prefers-color-scheme: dark) {{ :root {{ {dark} }} }}\n"
