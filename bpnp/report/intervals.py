"""Bootstrap intervals of test statistics, and of the difference of two estimates on the same problems."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from rich.text import Text

from bpnp.report.results import ProblemRow, Results
from bpnp.report.tables import lines_of, tested_problems
from bpnp.report.terminal import SplitTable, number

LEVEL = 0.95
DRAWS = 2000
FINITE = 1e12  # replaces infinity, so that interpolation is defined

JOINT = (15.0, 0.5)  # degrees, scene units
HEADERS = (
    "rotation\nmedian",
    "95 %\ninterval",
    "% within\n15deg 0.5",
    "95 %\ninterval",
    "rotation\n- first",
    "95 %\ninterval",
    "sec",
)
CAPTION = (
    "Medians in degrees. Intervals: 95 %, bootstrap over the problems. - first: difference of the medians to the first "
    "row, paired over the same problems; it is significant if its interval excludes zero."
)
Statistic = Callable[[NDArray[np.float64]], NDArray[np.float64]]  # reduces the last axis


@dataclass(frozen=True)
class Interval:
    """Statistic and its 95 % percentile bootstrap interval.

    Attributes:
        value: Statistic of the problems.
        low: Lower end.
        high: Upper end.
    """

    value: float
    low: float
    high: float


def median(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the median along the last axis."""
    return np.asarray(np.median(values, axis=-1))


def bootstrap(values: NDArray[np.float64], statistic: Statistic = median, *, seed: int = 0) -> Interval:
    """Return a statistic of some problems with its bootstrap interval, from draws of as many problems with replacement.

    Args:
        values: One number per problem (k,); infinity for a problem without a pose.
        statistic: Reduces the last axis. Default: median.
        seed: Seed of the draws.

    Raises:
        ValueError: There are no values, or one is NaN.
    """
    clean = _check_values(values)
    drawn = statistic(clean[_draws(len(clean), seed)])
    return _interval(float(statistic(clean)), drawn)


def paired_difference(
    first: NDArray[np.float64], second: NDArray[np.float64], statistic: Statistic = median, *, seed: int = 0
) -> Interval:
    """Return statistic(second) - statistic(first) with its bootstrap interval.

    Each draw takes the same problems for both. The difference is significant if the interval excludes zero.

    Args:
        first: One number per problem (k,).
        second: Numbers of the same problems in the same order.
        statistic: Reduces the last axis. Default: median.
        seed: Seed of the draws.

    Raises:
        ValueError: The lengths differ, there are no values, or one is NaN.
    """
    if len(first) != len(second):
        raise ValueError(
            f"a paired difference needs values of the same problems; there are {len(first)} and {len(second)}"
        )
    one, other = _check_values(first), _check_values(second)
    draws = _draws(len(one), seed)
    drawn = statistic(other[draws]) - statistic(one[draws])
    return _interval(float(statistic(other) - statistic(one)), drawn)


def quantile(probability: float) -> Statistic:
    """Return the statistic that computes a quantile.

    Args:
        probability: Quantile in [0, 1].
    """
    return lambda values: np.asarray(np.quantile(values, probability, axis=-1))


def fraction(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the mean along the last axis, the fraction of ones among zeros and ones."""
    return np.asarray(np.mean(values, axis=-1))


def _draws(count: int, seed: int) -> NDArray[np.int64]:
    return np.random.default_rng(seed).integers(0, count, (DRAWS, count))


def _check_values(values: NDArray[np.float64]) -> NDArray[np.float64]:
    array = np.asarray(values, np.float64)
    if not len(array) or np.isnan(array).any():
        raise ValueError(f"a bootstrap needs numbers; there are {len(array)}, {int(np.isnan(array).sum())} of them NaN")
    return np.clip(array, -FINITE, FINITE)


def _interval(value: float, drawn: NDArray[np.float64]) -> Interval:
    low, high = np.quantile(drawn, [(1 - LEVEL) / 2, (1 + LEVEL) / 2])
    numbers = (float(x) if abs(x) < FINITE / 2 else float(np.sign(x) * np.inf) for x in (value, low, high))
    return Interval(*numbers)


def interval_table(runs: Mapping[str, Results]) -> SplitTable:
    """Return a table of medians and recalls with intervals, differences to the first row, and seconds.

    It has one row per run and estimate.

    Args:
        runs: Results by name.
    """
    lines = lines_of(runs)
    shown = [
        (Text(line.label), list(map(Text, cells))) for line, cells in zip(lines, interval_cells(runs), strict=True)
    ]
    return SplitTable("Intervals and differences", HEADERS, (shown, []), CAPTION)


def interval_cells(runs: Mapping[str, Results]) -> list[list[str]]:
    """Return the texts of `interval_table`: a row per run and estimate, a cell per header."""
    lines = lines_of(runs)
    first, rows = lines[0], []
    for line in lines:
        tested = runs[line.run].of(line.estimate)
        angles = _angles(tested)
        rotation = bootstrap(angles)
        within = [row.rotation_error_deg < JOINT[0] and row.translation_error < JOINT[1] for row in tested]
        recall = bootstrap(100 * np.array(within, float), fraction)
        paired = ["", ""]
        if line != first and tested_problems(runs[line.run]) == tested_problems(runs[first.run]):
            difference = paired_difference(_angles(runs[first.run].of(first.estimate)), angles)
            paired = [f"{difference.value:+.2g}", f"{difference.low:+.2g} to {difference.high:+.2g}"]
        seconds = runs[line.run].estimates[line.estimate]["seconds_mean"]
        rows.append([
            number(rotation.value), f"{number(rotation.low)} to {number(rotation.high)}",
            f"{recall.value:.0f}", f"{recall.low:.0f} to {recall.high:.0f}", *paired, number(seconds),
        ])  # fmt: skip
    return rows


def _angles(rows: list[ProblemRow]) -> NDArray[np.float64]:
    return np.array([row.rotation_error_deg for row in rows])
