"""Tables of several runs and of the paper's rows: as a DataFrame, on the terminal, and in files."""

import json
import math
import os
from collections.abc import Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from rich.text import Text

from bpnp.report.results import SUMMARY, ProblemRow, Results, read_results
from bpnp.report.terminal import DASHES, LIGHT, Paper, SplitTable, number

if TYPE_CHECKING:
    from pandas import DataFrame

Values = Mapping[str, float | int | str]
HERE = "here"
POSES = "pose: % of problems with a pose; none counts as 180° and inf."
CAPTION = (
    "rot, repr: errors in degrees; trans: in scene units; quartiles Q1, Q2, Q3. 15° 0.5, 10° 1.0: % of problems with "
    f"both rotation and translation error within. {POSES} sec: mean seconds a problem."
)
PAPERS: dict[str, Paper] = {"MeshDataModule": "modelnet40", "ColmapDataModule": "megadepth"}  # by data module
JOINT_LIMITS: dict[Paper, tuple[float, float]] = {"modelnet40": (15.0, 0.5), "megadepth": (10.0, 1.0)}
# Options of the data that do not change the problems of a test.
LOADING = {
    "batch_size", "cache_dir", "eval_batch_size", "fresh_subsets", "fresh_views", "max_cells", "max_points",
    "num_workers", "train_outliers", "train_problems", "train_shapes", "val_fraction", "val_problems", "val_shapes",
}  # fmt: skip


def read_runs(paths: Sequence[Path | str]) -> dict[str, Results]:
    """Read results, by the names of `named_runs`."""
    return {name: read_results(path) for name, path in named_runs(paths).items()}


def table(runs: Sequence[Path | str] | Mapping[str, Results]) -> "DataFrame":
    """Return the aggregates of one or several results as a DataFrame with a row per run and estimate.

    Args:
        runs: Results folders, or results by name.

    Returns:
        Columns "run", "estimate", "correspondence_loss" and all numbers of `summarise`.

    Raises:
        ValueError: A folder cannot be read.
    """
    from pandas import DataFrame

    return DataFrame(
        {"run": name, "estimate": estimate, "correspondence_loss": results.correspondence_loss, **values}
        for name, results in (runs if isinstance(runs, Mapping) else read_runs(runs)).items()
        for estimate, values in results.estimates.items()
    )


class Line(NamedTuple):
    """Estimate of a run, as tables and figures show it."""

    run: str
    estimate: str
    label: str
    colour: int  # index of the palette
    dashes: int  # index of the dash patterns


def lines_of(runs: Mapping[str, Results]) -> list[Line]:
    """Return every estimate of every run; labels have the name of the run only if there are several runs.

    With at most eight lines each has its own colour; with more, each run has one. Estimates of one name share dashes.
    """
    keys = [(run, estimate) for run, results in runs.items() for estimate in results.estimates]
    order, names = list(runs), list(dict.fromkeys(estimate for _, estimate in keys))
    lines = []
    for i, (run, estimate) in enumerate(keys):
        colour = i if len(keys) <= len(LIGHT) else order.index(run) % len(LIGHT)
        label = estimate if len(runs) == 1 else f"{run}: {estimate}"
        lines.append(Line(run, estimate, label, colour, names.index(estimate) % len(DASHES)))
    return lines


class LargeTree(ValueError):
    """A folder that is no run, and has more folders than may be searched for results."""


def named_runs(paths: Sequence[Path | str], most: float | int = math.inf) -> dict[str, Path]:
    """Return results folders by the parts of their paths that differ; a single one by the name of its run.

    A run's folder stands for its `test`, and a folder of several results, such as that of `bpnp table`, for all of
    them. A folder that is given twice counts once. Raise LargeTree if `most` folders were searched and there are more.
    """
    if not paths:
        raise ValueError("no results folder is given; give one that `bpnp test` wrote")
    folders = list(dict.fromkeys(folder for path in paths for folder in _results_in(Path(path).absolute(), most)))
    if len(folders) == 1:
        (folder,) = folders
        return {(folder.parent if folder.name == "test" else folder).name: folder}
    shared = os.path.commonpath([path.parent for path in folders])
    parts = [Path(os.path.relpath(path, shared)).parts for path in folders]
    while len(set(parts)) > 1 and min(map(len, parts)) > 1 and len({path[-1] for path in parts}) == 1:
        parts = [path[:-1] for path in parts]
    return {os.path.join(*path): folder for path, folder in zip(parts, folders, strict=True)}


def _results_in(folder: Path, most: float | int) -> list[Path]:
    for candidate in (folder, folder / "test"):
        if (candidate / SUMMARY).is_file():
            return [candidate]
    found = []
    for count, (inside, _, files) in enumerate(os.walk(folder)):
        if count >= most:
            raise LargeTree(f"{folder} is no run, and has more than {most:.0f} folders; name the folders of the tests")
        if SUMMARY in files:
            found.append(Path(inside))
    return sorted(found) or [folder]


@dataclass(frozen=True)
class Column:
    """Column of a table."""

    key: str  # of its number
    header: str  # text above it
    percent: bool = False  # a fraction, shown in %; larger is better
    count: bool = False  # a count; in other columns, errors and times, smaller is better


@dataclass(frozen=True)
class MethodRow:
    """Row of a table: an estimate of a run, or a method."""

    label: str
    values: Values  # numbers by column; texts for published rows
    source: str = HERE  # "here", or the paper
    rho: float | None = None  # outlier ratio of the data, None if it does not apply
    # Equal for rows of the same problems, among which the best numbers are marked; None to take no part.
    problems: Hashable = None

    @property
    def name(self) -> str:
        """Label with the source or the outlier ratio."""
        name = self.label if self.source == HERE else f"{self.source}: {self.label}"
        return name if self.rho is None else f"{name}, rho {self.rho:g}"


ERRORS = (("rotation", "_deg", "rot"), ("translation", "", "trans"), ("reprojection", "_deg", "repr"))
QUARTILES = tuple(
    Column(f"{error}_q{i}{unit}", f"{short}\nQ{i}") for error, unit, short in ERRORS for i in (1, 2, 3)
)  # fmt: skip
RECALLS = (
    Column("recall_joint_15deg_0.5", "15°\n0.5", percent=True),
    Column("recall_joint_10deg_1", "10°\n1.0", percent=True),
)
SECONDS = Column("seconds_mean", "sec")
FOUND = Column("found", "pose\n%", percent=True)
RESULT_COLUMNS = (*QUARTILES, *RECALLS, FOUND, SECONDS)
FILE_COLUMNS = (Column("problems", "problems", count=True), *RESULT_COLUMNS)
HEADS = ("Rotation Error", "Translation Error", "Reproj. Error")
LATEX_COLUMNS = {
    **{(head, f"Q{i + 1}"): QUARTILES[3 * k + i] for k, head in enumerate(HEADS) for i in range(3)},
    ("T", r"$\bar{x}$"): SECONDS,
    (r"Recall (\%)", r"$15^\circ\!, 0.5$"): RECALLS[0],
    (r"Recall (\%)", r"$10^\circ\!, 1$"): RECALLS[1],
}

# Campbell, Liu, Gould, ECCV 2020, tables 1 and 2. Recalls are from the text; that of Lc is 25 below that of Lc Lp. R:
# the RANSAC estimate. SoftPOSIT, RANSAC and GOSMA were stopped after 30 s; SoftPOSIT started from the mean pose (table
# 1) or near the true one (table 2).
# Each line is a row: label | nine quartiles, seconds and, for some, the recall in %. Other data, another machine.
PRINTED: Mapping[Paper, tuple[str, Column, str]] = {
    "modelnet40": ("ModelNet40", RECALLS[0], """
        SoftPOSIT | 16.1 21.8 28.0 0.33 0.49 0.72 2.82 3.98 5.21 27
        RANSAC    | 90.8 139  165  0.43 1.15 3.08 4.22 5.87 8.06 30
        GOSMA     | 10.1 22.1 52.0 0.25 0.46 0.75 1.04 1.62 3.11 30
        Lc        | 6.08 11.3 18.3 0.34 0.52 0.81 0.56 0.86 1.31 0.1 47
        Lc Lp     | 4.88 9.66 16.0 0.04 0.08 0.15 0.36 0.61 1.03 0.1 72
        Lc R      | 5.49 11.7 20.0 0.04 0.09 0.20 0.37 0.70 1.25 0.1
        Lc Lp R   | 3.33 8.09 15.8 0.04 0.08 0.16 0.28 0.52 1.01 0.1"""),
    "megadepth": ("MegaDepth", RECALLS[1], """
        SoftPOSIT | 1.81 21.4 165  0.24 1.53 6.10 0.92 7.85 24.1 18
        RANSAC    | 66.6 122  155  6.80 15.2 28.2 4.45 8.77 13.3 30
        GOSMA     | 8.69 86.8 145  1.07 5.67 9.34 1.30 13.7 37.1 30
        Lc        | 1.91 4.47 11.4 0.52 1.05 2.34 0.54 1.12 2.81 0.2 48
        Lc Lp     | 1.32 3.31 8.84 0.21 0.46 1.08 0.21 0.53 1.64 0.2 73
        Lc R      | 0.44 1.55 7.70 0.05 0.18 0.80 0.06 0.16 1.27 0.2
        Lc Lp R   | 0.34 1.00 4.88 0.04 0.12 0.53 0.06 0.12 0.74 0.2 82"""),
}  # fmt: skip


def run_rows(runs: Mapping[str, Results], paper: Paper | None = None) -> list[MethodRow]:
    """Return a row per run and estimate, then the published rows."""
    tested = {name: tested_problems(results) for name, results in runs.items()}
    rows = [
        MethodRow(line.label, runs[line.run].estimates[line.estimate], problems=tested[line.run])
        for line in lines_of(runs)
    ]
    return rows + paper_rows(paper)


def tested_problems(results: Results) -> Hashable:
    """Return a key that is equal for results of the same problems."""
    return frozenset(problem_keys(results, results.rows))


def problem_keys(results: Results, rows: Iterable[ProblemRow]) -> list[Hashable]:
    """Return a key of each row's problem, equal for the same data, index, name and numbers of points and matches."""
    data = results.settings.get("data")
    if isinstance(data, Mapping) and isinstance(data.get("init_args"), Mapping):
        options = {key: value for key, value in data["init_args"].items() if key not in LOADING}
        data = {**data, "init_args": options}
    text = json.dumps(data, sort_keys=True)
    return [(text, row.index, row.id, row.m, row.n, row.matches) for row in rows]


def paper_of(results: Results) -> Paper | None:
    """Return the table of the paper with data of the kind that was tested: shapes or photos; None for others."""
    data = results.settings.get("data")
    kind = str(data.get("class_path")).rpartition(".")[2] if isinstance(data, Mapping) else ""
    return PAPERS.get(kind)


def joint_limits(runs: Mapping[str, Results]) -> tuple[float, float]:
    """Return the limits of the recall in the paper, degrees and scene units, for the kind of data of the first run."""
    return JOINT_LIMITS[paper_of(next(iter(runs.values()))) or "modelnet40"]


def paper_rows(paper: Paper | None) -> list[MethodRow]:
    """Return the published rows of a data set; none for None."""
    if paper is None:
        return []
    name, recall, text = PRINTED[paper]
    keys = [column.key for column in (*QUARTILES, SECONDS, recall)]
    lines = (line.split("|") for line in text.strip().splitlines())
    return [
        MethodRow(label.strip(), dict(zip(keys, numbers.split(), strict=False)), f"paper, {name}")
        for label, numbers in lines
    ]


def paper_quartiles(paper: Paper | None, error: str) -> dict[str, list[float]]:
    """Return the three printed quartiles of an error for each network of the paper; empty for an error without them."""
    keys = [f"{error.removesuffix('_deg')}_q{i}{'_deg' if error.endswith('_deg') else ''}" for i in (1, 2, 3)]
    rows = [row for row in paper_rows(paper) if row.label.startswith("Lc") and keys[0] in row.values]
    return {row.label: [float(row.values[key]) for key in keys] for row in rows}


def cell(column: Column, values: Values, *, short: bool = False) -> str:
    """Return the text of a cell: fractions in percent, counts whole, published texts unchanged, else `number`.

    A short one has at most four characters of a percentage and two digits of a number below 1.
    """
    value = values.get(column.key)
    if value is None or isinstance(value, str):
        return value or "-"
    if column.count:
        return f"{value:.0f}"
    if column.percent:
        text = f"{100 * value:.1f}"
        return "100" if short and text == "100.0" else text
    return number(value, short=short)


def best_texts(
    columns: Sequence[Column], rows: Sequence[MethodRow], *, short: bool = False
) -> dict[tuple[Hashable, str], str]:
    """Return the best number among rows of the same problems, as text, by (problems, key of the column).

    Comparing texts marks all cells that read the same.
    """
    best = {}
    for problems in {row.problems for row in rows} - {None}:
        alike = [row.values for row in rows if row.problems == problems]
        for column in columns:
            numbers = [value for values in alike if isinstance(value := values.get(column.key), float)]
            finite = [value for value in numbers if math.isfinite(value)]
            if len(alike) > 1 and finite and not column.count:
                most = (max if column.percent else min)(finite)
                best[problems, column.key] = cell(column, {column.key: most}, short=short)
    return best


def results_table(runs: Mapping[str, Results], *, paper: Paper | None = None) -> SplitTable:
    """Return quartiles, joint recalls, the fraction of problems with a pose and seconds, a row per run and estimate.

    The best number of each column is bold, among runs of the same problems. The column of the fraction is left out if
    every problem has a pose. Published rows of `paper` are added for orientation: they are of other data and are not
    compared.
    """
    sizes = " or ".join(str(size) for size in sorted({results.problems for results in runs.values()}))
    title, rows = f"Pose errors, {problems_text(sizes)}", run_rows(runs, paper)
    if not all(row.values["found"] == 1 for row in rows if row.source == HERE):
        return table_of_rows(title, RESULT_COLUMNS, rows, CAPTION)
    columns = [column for column in RESULT_COLUMNS if column != FOUND]
    return table_of_rows(title, columns, rows, CAPTION.replace(POSES, "Every problem has a pose."))


def problems_text(number: str) -> str:
    """Return a number of problems in words: "1 problem", "20 problems" or "20 or 30 problems"."""
    return f"{number} problem" if number == "1" else f"{number} problems"


def table_of_rows(title: str, columns: Sequence[Column], rows: Sequence[MethodRow], caption: str) -> SplitTable:
    """Return a table for the terminal: our rows with the best numbers bold, below them those of the paper."""
    best = best_texts(columns, rows, short=True)
    groups: tuple[list[tuple[Text, list[Text]]], ...] = ([], [])
    for row in rows:
        dim = "" if row.source == HERE else "dim"
        texts = [(best.get((row.problems, column.key)), cell(column, row.values, short=True)) for column in columns]
        cells = [Text(text, "bold" if text == most else dim) for most, text in texts]
        groups[row.source != HERE].append((Text(row.name, dim), cells))
    return SplitTable(title, [column.header for column in columns], groups, caption)


def table_frame(rows: Sequence[MethodRow]) -> "DataFrame":
    """Return all numbers as a DataFrame, fractions from 0 to 1, the paper's as published; `source` separates them."""
    from pandas import DataFrame

    def value_of(column: Column, row: MethodRow) -> float | int | str | None:
        value = row.values.get(column.key)
        return float(value) / 100 if column.percent and isinstance(value, str) else value  # published in percent

    records = [[row.label, row.source, row.rho, *(value_of(column, row) for column in FILE_COLUMNS)] for row in rows]
    return DataFrame(records, columns=["method", "source", "rho", *(c.key for c in FILE_COLUMNS)], dtype=object)


def as_latex(rows: Sequence[MethodRow]) -> str:
    """Return a booktabs table with the paper's columns: quartiles, seconds, and both recalls."""
    from pandas import DataFrame, MultiIndex

    cells = [[row.name, *(cell(column, row.values) for column in LATEX_COLUMNS.values())] for row in rows]
    frame = DataFrame(cells, columns=MultiIndex.from_tuples([("", "Method"), *LATEX_COLUMNS]))
    style = frame.style.hide(axis="index").format(escape="latex")
    align = "l" + "r" * len(LATEX_COLUMNS)
    return style.to_latex(hrules=True, column_format=align, multicol_align="c", caption=" ".join(note(rows)) or None)


def note(rows: Sequence[MethodRow]) -> list[str]:
    """Return a line for each source other than this run."""
    sources = dict.fromkeys(row.source for row in rows if row.source != HERE)
    return [f"{source}: another data set than ours." for source in sources]
