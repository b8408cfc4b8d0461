"""The parts of the page that need no script: what was tested, the quartiles, the causes of failures."""

import html
import json
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from bpnp.report.palette import DASHES
from bpnp.report.results import CAUSES, PLAUSIBLE_INLIERS, SOLVED_DEG, PairRow, Results, cause_shares
from bpnp.report.runs import Series, series_of
from bpnp.report.tables.published import Paper
from bpnp.report.tables.result_tables import CAPTION
from bpnp.report.tables.rows import RESULT_COLUMNS, best_texts, cell, run_rows

# Options of the data that change no result.
LOADING = {"batch_size", "eval_batch_size", "max_cells", "num_workers", "max_points", "fresh_subsets", "val_fraction"}


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
        facts = [f"{len(rows)} pairs with {sizes}", _described(results.settings), outcome]
        lines.append(
            f"<li><strong>{visible(name)}</strong>: {'. '.join(visible(fact) for fact in facts if fact)}.</li>"
        )
    details = "".join(
        f"<h3>{visible(name)}</h3><pre tabindex=0>{visible(json.dumps(_facts(results), indent=2))}</pre>"
        for name, results in runs.items()
    )
    return f"<ul>{''.join(lines)}</ul><details><summary>Settings of the runs</summary>{details}</details>"


SIZES = {"m": "2D points", "n": "3D points", "true_pairs": "true pairs"}


def _span(rows: list[PairRow], key: str) -> str:
    low, high = np.quantile([getattr(row, key) for row in rows], [0, 1]).astype(int)
    return str(low) if low == high else f"{low} to {high}"


def _facts(results: Results) -> dict[str, Any]:
    names = ("written", "bpnp_version", "correspondence_loss", "settings")
    return {name: getattr(results, name) for name in names}


def _described(settings: Mapping[str, Any]) -> str:
    """Solver, data and checkpoint of a test, as far as they were recorded."""
    said = []
    for name in ("solver", "data"):
        own = settings.get(name)
        if isinstance(own, Mapping) and "class_path" in own:
            given = {
                key: value
                for key, value in (own.get("init_args") or {}).items()
                if _plain(value) and key not in LOADING
            }
            options = ", ".join(f"{key} {value}" for key, value in given.items())
            kind = str(own["class_path"]).rpartition(".")[2]
            said.append(f"{name} {kind}" + (f" ({options})" if options and name == "data" else ""))
    if settings.get("complete") is False:
        said.append("interrupted before the last pair")
    if settings.get("checkpoint"):
        said.append(f"checkpoint {settings['checkpoint']}")
    return ", ".join(said)


def _plain(value: Any) -> bool:
    return isinstance(value, (bool, int, float, str)) and value not in ("", False)


def series_boxes(runs: Mapping[str, Results]) -> str:
    """A checkbox for each estimate of each run that shows and hides it."""
    return "".join(
        f'<label><input type="checkbox" id="series{i}" data-state checked>{_named(own)}</label>'
        for i, own in enumerate(series_of(runs))
    )


def quartiles_html(runs: Mapping[str, Results], paper: Paper | None) -> str:
    """The table of quartiles with the terminal's numbers; the best of each column is bold."""
    rows = run_rows(runs, paper)
    best = best_texts(RESULT_COLUMNS, rows)
    head = "".join(
        f'<th scope="col"><button type="button">{visible(column.header)}</button></th>' for column in RESULT_COLUMNS
    )
    shown = series_of(runs)
    body = ""
    for i, row in enumerate(rows):
        own = i < len(shown)
        body += f'<tr data-series="{i}">' if own else f'<tr class="{"seeds" if row.seeds else "paper"}">'
        body += f'<th scope="row">{_named(shown[i]) if own else visible(row.name)}</th>'
        for column in RESULT_COLUMNS:
            text, value = cell(column, row.values), row.values.get(column.key)
            mark = " class=best" if own and text == best[column.key] else ""
            if own and value is not None:
                mark += f' data-value="{str(value).replace("inf", "Infinity")}" title="{value}"'
            body += f"<td{mark}>{text}</td>"
        body += "</tr>"
    return (
        f'<div class="wide"><table id="quartile-table"><thead><tr><th scope="col">estimate</th>{head}</tr></thead>'
        f'<tbody>{body}</tbody></table></div><p class="note">{CAPTION} Best values are bold.</p>'
    )


def causes_html(runs: Mapping[str, Results]) -> str:
    """The share of pairs with each cause, as a bar and in numbers; the share that the solver reports as converged."""
    head = "".join(
        f'<th scope="col"><span class="fill cause{i}"></span> {cause}</th>' for i, cause in enumerate(CAUSES)
    )
    body = ""
    for i, own in enumerate(series_of(runs)):
        results = runs[own.run]
        shares = cause_shares(results.of(own.estimate))
        bar = "".join(
            f'<span class="cause{place}" style="width: {100 * share:.2f}%"></span>'
            for place, share in enumerate(shares.values()) if share
        )  # fmt: skip
        cells = "".join(f"<td>{100 * share:.1f}%</td>" for share in shares.values())
        body += (
            f'<tr data-series="{i}"><th scope="row">{_named(own)}</th>'
            f'<td><div class="bar" aria-hidden="true">{bar}</div></td>{cells}'
            f"<td>{100 * results.estimates[own.estimate].get('converged', float('nan')):.1f}%</td></tr>"
        )
    return (
        f'<div class="wide"><table id="cause-table"><thead><tr><th scope="col">estimate</th><th></th>{head}'
        f'<th scope="col">solver reports convergence</th></tr></thead><tbody>{body}</tbody></table></div>'
        f'<p class="note">Solved: rotation error up to {SOLVED_DEG:g} degrees. Fits the image: '
        f"{100 * PLAUSIBLE_INLIERS:.0f} % of the 2D points have a reprojected 3D point beside them.</p>"
    )


def _named(own: Series) -> str:
    """A line in the colour and the dashes of a series, and its label."""
    return (
        f'<svg class="swatch" aria-hidden="true" viewBox="0 0 28 10"><path d="M0,5H28" style="stroke: '
        f'var(--c{own.colour})" stroke-dasharray="{" ".join(map(str, DASHES[own.dashes]))}"/></svg>{visible(own.label)}'
    )
