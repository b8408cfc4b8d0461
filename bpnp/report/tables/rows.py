"""Rows of the tables of results: what a column is, what a cell shows, the rows of runs and of the paper."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from bpnp.metrics import RecallThresholds, pose_recalls
from bpnp.report.results import Results
from bpnp.report.runs import seed_groups, series_of, with_spread
from bpnp.report.tables.published import NAMES, PUBLISHED, Paper

Values = Mapping[str, float | int | str]
HERE = "here"


@dataclass(frozen=True)
class Column:
    """Where a column's number is found, what is written above it, and whether it is a share (shown in %, more is
    better), a count, or an error or a time (less is better)."""

    key: str
    header: str
    share: bool = False
    count: bool = False


@dataclass(frozen=True)
class Row:
    """One row: an estimate of a run or a method, its figures by column, and the share of outliers it was given.

    source: "here", or the paper, whose figures are texts as printed. seeds: a mean or a spread over several seeds.
    """

    label: str
    values: Values
    source: str = HERE
    seeds: bool = False
    rho: float | None = None

    @property
    def name(self) -> str:
        """The label with the source or the share of outliers."""
        own = self.label if self.source == HERE else f"{self.source}: {self.label}"
        return own if self.rho is None else f"{own}, rho {self.rho:g}"


QUARTILES = tuple(
    Column(f"{error}_q{number}{unit}", f"{short}\nQ{number}")
    for error, unit, short in (
        ("rotation", "_deg", "rot"),
        ("translation", "", "trans"),
        ("reprojection", "_deg", "repr"),
    )
    for number in (1, 2, 3)
)
RESULT_COLUMNS = (
    *QUARTILES,
    Column("recall_joint_15deg_0.5", "15deg\n0.5", share=True),
    Column("recall_joint_10deg_1", "10deg\n1.0", share=True),
    Column("found", "found\n%", share=True),
    Column("seconds_mean", "sec"),
)
STANDARD_POINTS = RecallThresholds((1, 2, 5, 10, 20), (0.05, 0.1, 0.2, 0.5, 1), (), (0.25, 0.5, 1, 2))
RECALL_COLUMNS = tuple(
    Column(f"recall_{error}_{limit:g}{unit}", f"{short}\n{limit:g}", share=True)
    for error, short, unit, limits in (
        ("rotation", "rot", "deg", STANDARD_POINTS.rotation_deg),
        ("translation", "trans", "", STANDARD_POINTS.translation),
        ("reprojection", "repr", "deg", STANDARD_POINTS.reprojection_deg),
    )
    for limit in limits
)


def run_rows(runs: Mapping[str, Results], paper: Paper | None = None) -> list[Row]:
    """A row per run and estimate, then mean and spread of the runs that differ by their seeds, then what is printed."""
    known = {}
    for run, estimate, *_ in series_of(runs):
        standard = pose_recalls(runs[run].errors(estimate), STANDARD_POINTS)
        known[run, estimate] = runs[run].estimates[estimate] | {key: float(value) for key, value in standard.items()}
    rows = [Row(own.label, known[own.run, own.estimate]) for own in series_of(runs)]
    rows += [Row(label, values, seeds=True) for label, values in with_spread(known, seed_groups(runs))]
    return rows + paper_rows(paper)


def paper_rows(paper: Paper | None) -> list[Row]:
    """The printed rows of a data set; none without one."""
    if paper is None:
        return []
    return [Row(label, printed, f"paper, {NAMES[paper]}") for label, printed in PUBLISHED[paper].items()]


def number(value: float | None) -> str:
    """Three significant digits in at most six characters: two digits below 0.01; "-" for none."""
    if value is None:
        return "-"
    size = abs(value)
    if size == 0 or not math.isfinite(value):
        return f"{value:g}"
    if 0.01 <= size < 999.5:
        return f"{value:#.3g}".rstrip(".")
    if 0.001 <= size < 0.01:
        return f"{value:.4f}"
    if 999.5 <= size < 99_999.5:
        return f"{value:.0f}"
    mantissa, exponent = f"{value:.{0 if size < 1e-9 else 1}e}".split("e")
    return f"{mantissa}e{int(exponent)}"


def cell(column: Column, values: Values) -> str:
    """What a table shows of a column: a share in percent, a count whole, what was printed as it is, else `number`."""
    value = values.get(column.key)
    if value is None or isinstance(value, str):
        return value or "-"
    if column.count:
        return f"{value:.0f}"
    return f"{100 * value:.1f}" if column.share else number(value)


def best_texts(columns: Sequence[Column], rows: Sequence[Row]) -> dict[str, str | None]:
    """The best number of each column among the rows of runs as it is shown, so that what reads the same is marked the
    same; None where there is nothing to compare."""
    best: dict[str, str | None] = dict.fromkeys(column.key for column in columns)
    own = [row.values for row in rows if row.source == HERE and not row.seeds]
    for column in columns:
        known = [value for values in own if isinstance(value := values.get(column.key), float) and math.isfinite(value)]
        if len(own) > 1 and known and not column.count:
            best[column.key] = cell(column, {column.key: (max if column.share else min)(known)})
    return best
