"""Bootstrap intervals of test statistics, and of the difference of two estimates on the same problems."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import astuple, dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray
from rich.text import Text

from bpnp.metrics import joint_error
from bpnp.report.results import Results
from bpnp.report.tables import Column, Line, cell, joint_limits, lines_of, tested_problems
from bpnp.report.terminal import SplitTable

if TYPE_CHECKING:
    from pandas import DataFrame

LEVEL = 0.95
DRAWS = 2000
# Replaces infinity, so that interpolation is defined; what is interpolated or averaged with it is infinite.
LARGE, LARGEST = 1e200, 1e300

MEDIANS = (
    Column("rotation_q2_deg", "rotation\nmedian"),
    Column("translation_q2", "translation\nmedian"),
    Column("reprojection_q2_deg", "reprojection\nmedian"),
)
CAPTION = (
    "Rotation and reprojection error in degrees, translation error in scene units, % of problems within both limits, "
    'seconds a problem. Below each number is its 95 % interval (bootstrap over the problems). Rows "minus ..." are '
    "differences, paired over the same problems, and significant if their interval excludes zero."
)
Statistic = Callable[[NDArray[np.float64]], NDArray[np.float64]]  # reduces the last axis


@dataclass(frozen=True)
class Interval:
    """Statistic and its 95 % percentile bootstrap interval."""

    value: float  # statistic of the problems; NaN for the difference of two infinite ones
    low: float  # lower end, which may be -infinity
    high: float  # upper end, which may be infinity


def median(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the median along the last axis."""
    return np.asarray(np.median(values, axis=-1))


def bootstrap(values: NDArray[np.float64], statistic: Statistic = median, *, seed: int = 0) -> Interval:
    """Return a statistic of some problems with its bootstrap interval, from draws of as many problems with replacement.

    `values` has a number per problem (k,); infinity for a problem without a pose. Raise ValueError for no values, or
    NaN.
    """
    return _interval(*_draw(values, statistic, seed))


def paired_difference(
    first: NDArray[np.float64], second: NDArray[np.float64], statistic: Statistic = median, *, seed: int = 0
) -> Interval:
    """Return statistic(second) - statistic(first) of the same problems, as in `bootstrap`, with its bootstrap interval.

    Each draw takes the same problems for both. The difference is significant if the interval excludes zero. The
    difference of two infinite statistics is unknown: the value is NaN, and such a draw widens the interval on both
    sides.
    """
    if len(first) != len(second):
        raise ValueError(
            f"a paired difference needs values of the same problems; there are {len(first)} and {len(second)}"
        )
    (one, one_drawn), (other, other_drawn) = (_draw(values, statistic, seed) for values in (first, second))
    return _interval(*_difference((other, other_drawn), (one, one_drawn)))


def quantile(probability: float) -> Statistic:
    """Return the statistic that computes the quantile of a probability in [0, 1]."""
    return lambda values: np.asarray(np.quantile(values, probability, axis=-1))


def fraction(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the mean along the last axis, the fraction of ones among zeros and ones."""
    return np.asarray(np.mean(values, axis=-1))


def _draw(values: NDArray[np.float64], statistic: Statistic, seed: int = 0) -> tuple[float, NDArray[np.float64]]:
    """Return the statistic of the values, and that of each draw; draws of as many values are of the same ones."""
    array = np.asarray(values, np.float64)
    if not len(array) or np.isnan(array).any():
        raise ValueError(f"a bootstrap needs numbers; there are {len(array)}, {int(np.isnan(array).sum())} of them NaN")
    draws = np.random.default_rng(seed).integers(0, len(array), (DRAWS, len(array)))
    value, drawn = (_with_infinity(statistic, values) for values in (array, array[draws]))
    return float(value), drawn


def _with_infinity(statistic: Statistic, values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a statistic of numbers with infinite ones, which interpolates between them or averages them."""
    found = np.asarray(statistic(np.clip(values, -LARGEST, LARGEST)))
    return np.where(np.abs(found) < LARGE, found, np.copysign(np.inf, found))


def _difference(
    one: tuple[float, NDArray[np.float64]], other: tuple[float, NDArray[np.float64]]
) -> tuple[float, NDArray[np.float64]]:
    """Return the difference of two statistics and of their draws, NaN where both are infinite."""
    with np.errstate(invalid="ignore"):
        return one[0] - other[0], one[1] - other[1]


def _interval(value: float, drawn: NDArray[np.float64]) -> Interval:
    unknown = np.isnan(drawn)
    low, high = (
        float(_with_infinity(quantile(probability), np.where(unknown, end, drawn)))
        for probability, end in (((1 - LEVEL) / 2, -np.inf), ((1 + LEVEL) / 2, np.inf))
    )
    return Interval(value, low, high)


@dataclass(frozen=True)
class IntervalRow:
    """Statistics of an estimate, or their difference to those of another estimate, with intervals."""

    line: Line
    minus: Line | None  # estimate that is subtracted, None for the statistics of `line` itself
    problems: int
    intervals: tuple[Interval | None, ...]  # interval of each column; None if no problem has its number

    @property
    def label(self) -> str:
        """Name of the row."""
        return self.line.label if self.minus is None else f"minus {self.minus.label}"


@dataclass(frozen=True)
class IntervalTable:
    """Medians, recall and seconds with intervals, for the terminal, the page and W&B."""

    title: str
    columns: tuple[Column, ...]  # with the keys of `summarise`
    # Rows of all problems, or of each group of problems, by the title of the group.
    groups: Mapping[str, Sequence[IntervalRow]]
    note: str = ""  # runs without differences, and why

    def cells(self, row: IntervalRow) -> list[str]:
        """Return the texts of a row: the number and, below it, its interval."""
        return [
            _shown(interval, column, signed=row.minus is not None)
            for interval, column in zip(row.intervals, self.columns, strict=True)
        ]

    def split_table(self) -> SplitTable:
        """Return the table for the terminal."""
        groups = []
        for name, rows in self.groups.items():
            head = [(Text(name, "bold"), [Text("")] * len(self.columns))] if name else []
            shown = [(Text(row.label, "" if row.minus is None else "dim"), row) for row in rows]
            groups.append([*head, *((label, list(map(Text, self.cells(row)))) for label, row in shown)])
        return SplitTable(
            self.title, [column.header for column in self.columns], groups, f"{CAPTION} {self.note}".strip()
        )

    def frame(self) -> "DataFrame":
        """Return the numbers, fractions from 0 to 1.

        The columns are "group" (absent for all problems), "run", "estimate", "minus" (empty for the statistics of the
        estimate itself) and "problems"; of each column its number, and "..._low" and "..._high", the ends of its
        interval, NaN where there is none.
        """
        from pandas import DataFrame

        records = []
        for group, rows in self.groups.items():
            for row in rows:
                names = {"group": group} if group else {}
                names |= {"run": row.line.run, "estimate": row.line.estimate}
                names |= {"minus": row.minus.label if row.minus else ""}
                record: dict[str, float | int | str] = {**names, "problems": row.problems}
                for column, interval in zip(self.columns, row.intervals, strict=True):
                    ends = (math.nan,) * 3 if interval is None else astuple(interval)
                    record |= zip((column.key, f"{column.key}_low", f"{column.key}_high"), ends, strict=True)
                records.append(record)
        return DataFrame(records)


def interval_table(runs: Mapping[str, Results]) -> IntervalTable:
    """Return medians, recall and seconds of each estimate, with intervals, and the differences to `baseline_of`."""
    title = "Medians and recall with 95 % intervals"
    return IntervalTable(title, interval_columns(runs), {"": interval_rows(runs, runs)}, unpaired_note(runs))


def unpaired_note(runs: Mapping[str, Results]) -> str:
    """Return a sentence on the runs that have no differences, since the first run has other problems; or no text."""
    first, *others = runs
    problems = tested_problems(runs[first])
    names = [name for name in others if tested_problems(runs[name]) != problems]
    return f"No differences for {', '.join(names)}: {first} was tested on other problems." if names else ""


def interval_columns(runs: Mapping[str, Results]) -> tuple[Column, ...]:
    """Return the columns of a table of intervals; the recall has the limits of `joint_limits`."""
    degrees, length = joint_limits(runs)
    recall = Column(f"recall_joint_{degrees:g}deg_{length:g}", f"% within\n{degrees:g}deg {length:g}", percent=True)
    return (*MEDIANS, recall, Column("seconds_mean", "seconds\nmean"))


def interval_rows(runs: Mapping[str, Results], members: Mapping[str, Results]) -> list[IntervalRow]:
    """Return the rows of each run and estimate: its statistics, then the difference to its baseline, if it has one.

    `members` are some problems of the runs, such as a group; a run without any may be absent.
    """
    lines, limits = lines_of(runs), joint_limits(runs)
    tested = {name: tested_problems(results) for name, results in members.items()}
    samples: dict[Line, list[Sample]] = {}
    rows = []
    for line in (line for line in lines if line.run in members):
        own, count = _samples(members[line.run], line.estimate, limits), members[line.run].problems
        rows.append(IntervalRow(line, None, count, tuple(sample.interval() for sample in own)))
        baseline = baseline_of(line, lines)
        if baseline is not None and baseline in samples and tested[line.run] == tested[baseline.run]:
            pairs = zip(own, samples[baseline], strict=True)
            rows.append(IntervalRow(line, baseline, count, tuple(sample.minus(other) for sample, other in pairs)))
        samples[line] = own
    return rows


@dataclass(frozen=True)
class Sample:
    """Statistic of the problems that have a number, and of draws of them."""

    known: NDArray[np.bool_]  # (k,) the problems that have a number
    value: float  # statistic, NaN if no problem has a number
    drawn: NDArray[np.float64]  # (2000,) statistic of each draw

    def interval(self) -> Interval | None:
        """Return the statistic with its interval, None if no problem has a number."""
        return _interval(self.value, self.drawn) if self.known.any() else None

    def minus(self, other: "Sample") -> Interval | None:
        """Return the difference with its interval, None if not the same problems have a number."""
        if not np.array_equal(self.known, other.known):
            return None
        value, drawn = _difference((self.value, self.drawn), (other.value, other.drawn))
        return replace(self, value=value, drawn=drawn).interval()


def baseline_of(line: Line, lines: Sequence[Line]) -> Line | None:
    """Return the line that another is compared with: the same estimate of the first run, or else its first line.

    In a single run it is the first line. The lines of the first of several runs, and the first line, have none.
    """
    first = lines[0]
    if line == first or (line.run == first.run and lines[-1].run != first.run):
        return None
    return next((each for each in lines if each.run == first.run != line.run and each.estimate == line.estimate), first)


def _samples(results: Results, estimate: str, limits: tuple[float, float]) -> list[Sample]:
    """Return the sample of each of `interval_columns`."""
    errors = results.errors(estimate)
    within = (joint_error(errors, limits[1]) <= limits[0]).double()
    seconds = torch.tensor([row.seconds for row in results.of(estimate)], dtype=torch.float64)
    medians = (errors.rotation_deg, errors.translation, errors.reprojection_deg)
    columns = [*((values, median) for values in medians), (within, fraction), (seconds, fraction)]
    samples = []
    for values, statistic in columns:
        known = ~values.isnan().numpy()
        drawn = _draw(values.numpy()[known], statistic) if known.any() else (math.nan, np.full(DRAWS, math.nan))
        samples.append(Sample(known, *drawn))
    return samples


def _shown(interval: Interval | None, column: Column, *, signed: bool) -> str:
    if interval is None:
        return cell(column, {})
    value, low, high = (
        cell(column, {})
        if math.isnan(number)
        else f"{'+' if signed and number > 0 else ''}{cell(column, {column.key: number})}"
        for number in astuple(interval)
    )
    return f"{value}\n{low} to {high}"
