"""Rows of results as CSV, Markdown and LaTeX, the latter in the paper's form."""

import csv
import io
from collections.abc import Sequence

from bpnp.report.tables.result_tables import CAPTION
from bpnp.report.tables.rows import HERE, QUARTILES, RESULT_COLUMNS, Column, Row, cell

COLUMNS = (Column("pairs", "pairs", count=True), *RESULT_COLUMNS)
LATEX_COLUMNS = (
    *QUARTILES,
    *(column for key in ("seconds_mean", "recall_joint_15deg_0.5", "recall_joint_10deg_1") for column in RESULT_COLUMNS
      if column.key == key),
)  # fmt: skip
GROUPS = ("Rotation Error", "Translation Error", "Reproj. Error")
LATEX_SPECIAL = str.maketrans({letter: f"\\{letter}" for letter in "&%_#${}"})


def as_csv(rows: Sequence[Row]) -> str:
    """Every figure in full, the paper's rows as printed; `source` tells them apart."""
    text = io.StringIO(newline="")
    writer = csv.writer(text)
    writer.writerow(["method", "source", "rho", *(column.key for column in COLUMNS)])
    for row in rows:
        rho = "" if row.rho is None else row.rho
        writer.writerow([row.label, row.source, rho, *(_full(column, row) for column in COLUMNS)])
    return text.getvalue()


def _full(column: Column, row: Row) -> str | float | int:
    """A figure in the unit of `Results`: printed shares are in percent."""
    value = row.values.get(column.key, "")
    return float(value) / 100 if column.share and isinstance(value, str) and value else value


def as_markdown(rows: Sequence[Row]) -> str:
    """A table with the caption beneath; what is published is in italics."""
    body = [["method", *(" ".join(column.header.split()) for column in COLUMNS)], ["---", *["---:"] * len(COLUMNS)]]
    for row in rows:
        name = row.name.replace("|", r"\|")
        body.append([name if row.source == HERE else f"*{name}*", *(cell(column, row.values) for column in COLUMNS)])
    return "\n".join([*(f"| {' | '.join(cells)} |" for cells in body), "", CAPTION, *note(rows), ""])


def as_latex(rows: Sequence[Row]) -> str:
    """A booktabs tabular with the paper's columns: quartiles, seconds, and both recalls."""
    head = " & ".join(rf"\multicolumn{{3}}{{c}}{{{name}}}" for name in GROUPS)
    quarters = " & ".join(["Method", *(["Q1", "Q2", "Q3"] * 3), r"$\bar{x}$", r"$15^\circ\!, 0.5$", r"$10^\circ\!, 1$"])
    text = [rf"\begin{{tabular}}{{@{{}}l{'r' * len(LATEX_COLUMNS)}@{{}}}}", r"\toprule",
            rf" & {head} & T & \multicolumn{{2}}{{c}}{{Recall (\%)}}\\", rf"{quarters}\\", r"\midrule"]  # fmt: skip
    for source in dict.fromkeys(row.source for row in rows):
        own = [row for row in rows if row.source == source]
        if source != HERE:
            said = "".join(note(own)).translate(LATEX_SPECIAL)
            text += [r"\midrule", rf"\multicolumn{{{len(LATEX_COLUMNS) + 1}}}{{l}}{{{said}}}\\"]
        for row in own:
            cells = [row.name, *(cell(column, row.values) for column in LATEX_COLUMNS)]
            text.append(" & ".join(text.translate(LATEX_SPECIAL) for text in cells) + r"\\")
    return "\n".join([*text, r"\bottomrule", r"\end{tabular}", ""])


def note(rows: Sequence[Row]) -> list[str]:
    """A line on each source that is not ours."""
    sources = dict.fromkeys(row.source for row in rows if row.source != HERE)
    return [f"{source}: another data set than ours." for source in sources]
