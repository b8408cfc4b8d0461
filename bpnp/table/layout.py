"""The table in the paper's form: for the terminal, as CSV, Markdown and LaTeX."""

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from rich.text import Text

from bpnp.report.tables.fitted_table import FittedTable
from bpnp.report.tables.published import NAMES, PUBLISHED, Paper, published_rows
from bpnp.report.tables.result_tables import QUARTILES, RESULT_COLUMNS, Column, cell

CAPTION = (
    "rot, repr: errors in degrees; trans: in scene units; quartiles Q1, Q2, Q3. 15deg 0.5, 10deg 1.0: % of pairs with "
    "both rotation and translation error within. sec: mean seconds a pair. No pose counts as 180 deg and inf."
)
GROUPS = (("Rotation Error", 3), ("Translation Error", 3), ("Reproj. Error", 3))
LATEX_SPECIAL = {"&": r"\&", "%": r"\%", "_": r"\_", "#": r"\#", "$": r"\$", "{": r"\{", "}": r"\}"}


@dataclass(frozen=True)
class Line:
    """One row: a method's estimate, the share of outliers it was given (None: as the data are), and its figures.

    spread_of: of how many seeds the figures are the standard deviation; 0 for the figures themselves.
    """

    label: str
    pairs: int
    values: Mapping[str, float]
    rho: float | None = None
    spread_of: int = 0

    @property
    def row(self) -> str:
        """The label, and whether it is a spread."""
        return f"{self.label}, standard deviation of {self.spread_of} seeds" if self.spread_of else self.label

    @property
    def name(self) -> str:
        return self.row if self.rho is None else f"{self.row}, rho {self.rho:g}"

    @property
    def cells(self) -> list[str]:
        return [str(self.pairs), *(cell(column, self.values) for column in RESULT_COLUMNS)]


def headers() -> list[str]:
    return ["pairs", *(column.header for column in RESULT_COLUMNS)]


def note(paper: Paper | None) -> str:
    return "" if paper is None else f"published, on {NAMES[paper]}: another data set than ours"


def terminal(lines: Sequence[Line], paper: Paper | None) -> FittedTable:
    """The table of the report, with the number of pairs and the share of outliers."""
    caption = CAPTION if paper is None else f"{CAPTION} paper: {note(paper)}."
    here = [(Text(line.name), [Text(shown) for shown in line.cells]) for line in lines]
    there = [
        (Text(name, "dim"), [Text(shown, "dim") for shown in cells]) for name, cells in published_cells(paper).items()
    ]
    return FittedTable("Pose errors", headers(), [here, there], caption)


def published_cells(paper: Paper | None) -> dict[str, list[str]]:
    """Names and cells of the paper's rows; "-" for what it does not print."""
    return {
        name: ["-", *(printed.get(column.key, "-") for column in RESULT_COLUMNS)]
        for name, printed in published_rows(paper).items()
    }


def as_csv(lines: Sequence[Line], paper: Paper | None) -> str:
    """Every figure in full, the paper's rows as printed; `source` tells them apart."""
    text = io.StringIO(newline="")
    writer = csv.writer(text)
    keys = [column.key for column in RESULT_COLUMNS]
    writer.writerow(["method", "source", "rho", "pairs", *keys])
    for line in lines:
        rho = "" if line.rho is None else line.rho
        writer.writerow([line.row, "here", rho, line.pairs, *(line.values.get(key, "") for key in keys)])
    if paper is not None:
        for label, printed in PUBLISHED[paper].items():
            shown = (_full(column, printed.get(column.key)) for column in RESULT_COLUMNS)
            writer.writerow([label, f"paper, {NAMES[paper]}", "", "", *shown])
    return text.getvalue()


def _full(column: Column, printed: str | None) -> str | float:
    """A printed number in the unit of `Results`: shares are printed in percent."""
    if printed is None:
        return ""
    return float(printed) / 100 if column.share else printed


def as_markdown(lines: Sequence[Line], paper: Paper | None) -> str:
    rows = [["method", *(" ".join(header.split()) for header in headers())]]
    rows += [[line.name, *line.cells] for line in lines]
    body = [f"| {' | '.join(text.replace('|', chr(92) + '|') for text in row)} |" for row in rows]
    body.insert(1, "|---" + "|---:" * len(headers()) + "|")
    if paper is not None:
        body.append(f"| *{note(paper)}* |" + " |" * len(headers()))
        body += [f"| *{name}* | {' | '.join(cells)} |" for name, cells in published_cells(paper).items()]
    return "\n".join([*body, "", CAPTION, ""])


def as_latex(lines: Sequence[Line], paper: Paper | None) -> str:
    """A booktabs tabular with the paper's columns: quartiles, seconds, and both recalls."""
    columns: list[Column] = [*QUARTILES, *(c for c in RESULT_COLUMNS if c.key == "seconds_mean")]
    columns += [column for column in RESULT_COLUMNS if column.share and column.key != "found"]
    place = [RESULT_COLUMNS.index(column) + 1 for column in columns]
    head = " & ".join(rf"\multicolumn{{{width}}}{{c}}{{{name}}}" for name, width in GROUPS)
    quarters = " & ".join(["Method", *(["Q1", "Q2", "Q3"] * 3), r"$\bar{x}$", r"$15^\circ\!, 0.5$", r"$10^\circ\!, 1$"])
    text = [rf"\begin{{tabular}}{{@{{}}l{'r' * len(columns)}@{{}}}}", r"\toprule",
            rf" & {head} & T & \multicolumn{{2}}{{c}}{{Recall (\%)}}\\", rf"{quarters}\\", r"\midrule"]  # fmt: skip
    text += [_latex_row(line.name, [line.cells[i] for i in place]) for line in lines]
    if paper is not None:
        text += [r"\midrule", rf"\multicolumn{{{len(columns) + 1}}}{{l}}{{{_latex(note(paper))}}}\\"]
        text += [_latex_row(name, [cells[i] for i in place]) for name, cells in published_cells(paper).items()]
    return "\n".join([*text, r"\bottomrule", r"\end{tabular}", ""])


def _latex_row(name: str, cells: Sequence[str]) -> str:
    return " & ".join(map(_latex, [name, *cells])) + r"\\"


def _latex(text: str) -> str:
    return "".join(LATEX_SPECIAL.get(letter, letter) for letter in text)
