"""The parts of the page that need no script: what was tested, the quartiles, the causes of failures."""

import html
import json
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from bpnp.report.page.charts import SIZES
from bpnp.report.palette import DASHES
from bpnp.report.results import CAUSES, PLAUSIBLE_INLIERS, SOLVED_DEG, ProblemRow, Results, cause_shares
from bpnp.report.runs import Line, lines_of
from bpnp.report.tables import CAPTION, LOADING, RESULT_COLUMNS, best_texts, cell, run_rows
from bpnp.report.terminal import Paper


def visible(text: object) -> str:
    """A text for HTML; bytes that are no UTF-8 are replaced."""
    return html.escape(str(text).encode("utf-8", "replace").decode())


def options(texts: Iterable[str], chosen: int | None = None) -> str:
    """The options of a select element, numbered."""
    numbered = ((i, " selected" if i == chosen else "", visible(text)) for i, text in enumerate(texts))
    return "".join(f'<option value="{i}"{selected}>{text}</option>' for i, selected, text in numbered)


def headline_html(runs: Mapping[str, Results]) -> str:
    """What was tested, with which settings and with which outcome: a line per run."""
    lines = []
    for name, results in runs.items():
        first, values = next(iter(results.estimates.items()))
        rows = results.of(first)
        sizes = ", ".join(f"{_span(rows, key)} {what}" for key, what in SIZES.items())
        best = min(results.estimates.items(), key=lambda item: item[1]["rotation_q2_deg"])
        outcome = (
            f"{best[0]}: median rotation error {cell(RESULT_COLUMNS[1], best[1])} deg, "
            f"{100 * cause_shares(results.of(best[0]))['solved']:.1f} % within {SOLVED_DEG:g} deg"
        )
        facts = [f"{len(rows)} problems with {sizes}", _described(results.settings), outcome]
        lines.append(
            f"<li><strong>{visible(name)}</strong>: {'. '.join(visible(fact) for fact in facts if fact)}.</li>"
        )
    details = "".join(
        f"<h3>{visible(name)}</h3><pre tabindex=0>{visible(json.dumps(_facts(results), indent=2))}</pre>"
        for name, results in runs.items()
    )
    return f"<ul>{''.join(lines)}</ul><details><summary>Settings of the runs</summary>{details}</details>"


def _span(rows: list[ProblemRow], key: str) -> str:
    low, high = np.quantile([getattr(row, key) for row in rows], [0, 1]).astype(int)
    return str(low) if low == high else f"{low} to {high}"


def _facts(results: Results) -> dict[str, Any]:
    names = ("written", "bpnp_version", "correspondence_loss", "settings")
    return {name: getattr(results, name) for name in names}


def _described(settings: Mapping[str, Any]) -> str:
    """Solver, data and checkpoint of a test, as far as they were recorded."""
    said = []
    for name in ("solver", "data"):
        part = settings.get(name)
        if isinstance(part, Mapping) and "class_path" in part:
            plain = {key: value for key, value in (part.get("init_args") or {}).items() if _plain(value)}
            options = ", ".join(f"{key} {value}" for key, value in plain.items() if key not in LOADING)
            kind = str(part["class_path"]).rpartition(".")[2]
            said.append(f"{name} {kind}" + (f" ({options})" if options and name == "data" else ""))
    if settings.get("complete") is False:
        said.append("interrupted before the last problem")
    if settings.get("checkpoint"):
        said.append(f"checkpoint {settings['checkpoint']}")
    return ", ".join(said)


def _plain(value: Any) -> bool:
    return isinstance(value, (bool, int, float, str)) and value not in ("", False)


def series_boxes(runs: Mapping[str, Results]) -> str:
    """A checkbox for each estimate of each run that shows and hides it."""
    return "".join(
        f'<label><input type="checkbox" id="series{i}" data-state checked>{_named(line)}</label>'
        for i, line in enumerate(lines_of(runs))
    )


def quartiles_html(runs: Mapping[str, Results], paper: Paper | None) -> str:
    """The table of quartiles with the terminal's numbers; the best of each column is bold."""
    rows = run_rows(runs, paper)
    best = best_texts(RESULT_COLUMNS, rows)
    head = "".join(
        f'<th scope="col"><button type="button">{visible(column.header)}</button></th>' for column in RESULT_COLUMNS
    )
    lines = lines_of(runs)
    body = ""
    for i, row in enumerate(rows):
        ours = i < len(lines)
        body += f'<tr data-series="{i}">' if ours else '<tr class="paper">'
        body += f'<th scope="row">{_named(lines[i]) if ours else visible(row.name)}</th>'
        for column in RESULT_COLUMNS:
            text, value = cell(column, row.values), row.values.get(column.key)
            mark = " class=best" if ours and text == best.get((row.problems, column.key)) else ""
            if ours and value is not None:
                mark += f' data-value="{str(value).replace("inf", "Infinity")}" title="{value}"'
            body += f"<td{mark}>{text}</td>"
        body += "</tr>"
    return (
        f'<div class="wide"><table id="quartile-table"><thead><tr><th scope="col">estimate</th>{head}</tr></thead>'
        f'<tbody>{body}</tbody></table></div><p class="note">{CAPTION} Best values are bold, among runs of the same '
        "problems.</p>"
    )


def causes_html(runs: Mapping[str, Results]) -> str:
    """The share of problems with each cause as a bar and in numbers, and the share that the solver calls converged."""
    head = "".join(
        f'<th scope="col"><span class="fill cause{i}"></span> {cause}</th>' for i, cause in enumerate(CAUSES)
    )
    body = ""
    for i, line in enumerate(lines_of(runs)):
        results = runs[line.run]
        shares = list(cause_shares(results.of(line.estimate)).values())
        parts = [(k, f"{100 * share:.2f}") for k, share in enumerate(shares) if share]
        bar = "".join(f'<span class="cause{k}" style="width: {width}%"></span>' for k, width in parts)
        converged = results.estimates[line.estimate].get("converged", float("nan"))
        body += (
            f'<tr data-series="{i}"><th scope="row">{_named(line)}</th>'
            f'<td><div class="bar" aria-hidden="true">{bar}</div></td>'
            + "".join(f"<td>{100 * share:.1f}%</td>" for share in [*shares, converged])
            + "</tr>"
        )
    return (
        f'<div class="wide"><table id="cause-table"><thead><tr><th scope="col">estimate</th><th></th>{head}'
        f'<th scope="col">solver reports convergence</th></tr></thead><tbody>{body}</tbody></table></div>'
        f'<p class="note">Solved: rotation error up to {SOLVED_DEG:g} degrees. Fits the image: '
        f"{100 * PLAUSIBLE_INLIERS:.0f} % of the 2D points have a reprojected 3D point beside them.</p>"
    )


def _named(line: Line) -> str:
    """A line in the colour and the dashes of an estimate, and its label."""
    return (
        f'<svg class="swatch" aria-hidden="true" viewBox="0 0 28 10"><path d="M0,5H28" style="stroke: '
        f'var(--c{line.colour})" stroke-dasharray="{" ".join(map(str, DASHES[line.dashes]))}"/></svg>'
        f"{visible(line.label)}"
    )
