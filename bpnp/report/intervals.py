"""Bootstrap intervals of test statistics, and of the difference of two estimates on the same problems."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray
from rich.text import Text

from bpnp.report.results import Results
from bpnp.report.tables import Line, lines_of, tested_problems
from bpnp.report.terminal import SplitTable, number

LEVEL = 0.95
DRAWS = 2000
FINITE = 1e12  # replaces infinity, so that interpolation is defined

JOINT = (15.0, 0.5)  # degrees, scene units
HEADERS = (
    "rotation\nmedian",
    "rotation\ndifference",
    "translation\nmedian",
    "translation\ndifference",
    "% within\n15deg 0.5",
    "% within\ndifference",
    "sec",
)
CAPTION = (
    "Rotation in degrees, translation in scene units; below each number its 95 % interval (bootstrap over the "
    "problems). Differences are paired over the same problems, and significant if their interval excludes zero."
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
    """Return a table of medians and recalls with intervals, paired differences to the first run, and seconds.

    It has one row per run and estimate.

    Args:
        runs: Results by name.
    """
    lines = lines_of(runs)
    shown = [
        (Text(line.label), list(map(Text, cells))) for line, cells in zip(lines, interval_cells(runs), strict=True)
    ]
    return SplitTable(interval_title(runs), HEADERS, (shown, []), interval_caption(runs))


def interval_title(runs: Mapping[str, Results]) -> str:
    """Return the title of `interval_table`, which names what each row is compared with."""
    first, *others = lines_of(runs)
    if len(runs) == 1:
        return f"Intervals, and differences to {first.estimate}" if others else "Intervals"
    return f"Intervals, and differences to the same estimate of {first.run}"


def interval_caption(runs: Mapping[str, Results]) -> str:
    """Return the text below `interval_table`."""
    first, known = lines_of(runs)[0], next(iter(runs.values())).estimates
    if all(results.estimates.keys() <= known.keys() for results in runs.values()):
        return CAPTION
    return f"{CAPTION} Estimates that {first.run} does not have are compared with its {first.estimate}."


def baseline_of(line: Line, lines: Sequence[Line]) -> Line | None:
    """Return the line that another is compared with.

    It is the same estimate of the first run, or the first line where that run has no such estimate. In a single run it
    is the first line.

    Args:
        line: Estimate of a run.
        lines: Estimates of all runs.

    Returns:
        The line, None for the lines of the first of several runs, and for the first line.
    """
    first = lines[0]
    if line == first or (line.run == first.run and lines[-1].run != first.run):
        return None
    return next((each for each in lines if each.run == first.run != line.run and each.estimate == line.estimate), first)


def interval_cells(runs: Mapping[str, Results]) -> list[list[str]]:
    """Return the texts of `interval_table`: a row per run and estimate, a cell per header.

    A cell has the number and, below it, its interval.
    """
    lines, rows = lines_of(runs), []
    for line in lines:
        values, baseline = _values(runs, line), baseline_of(line, lines)
        alike = baseline is not None and tested_problems(runs[line.run]) == tested_problems(runs[baseline.run])
        others = _values(runs, baseline) if baseline is not None and alike else [None] * len(values)
        cells = []
        for own, other, (statistic, text) in zip(values, others, STATISTICS, strict=True):
            cells.append(_shown(bootstrap(own, statistic), text))
            cells.append(
                "" if other is None else _shown(paired_difference(other, own, statistic), partial(_signed, text))
            )
        rows.append([*cells, number(runs[line.run].estimates[line.estimate]["seconds_mean"])])
    return rows


def _percent(value: float) -> str:
    return f"{value:.0f}"


STATISTICS: tuple[tuple[Statistic, Callable[[float], str]], ...] = (
    (median, number),  # rotation
    (median, number),  # translation
    (fraction, _percent),  # within both limits
)


def _values(runs: Mapping[str, Results], line: Line) -> list[NDArray[np.float64]]:
    """Return a number per problem for each of `STATISTICS`."""
    errors = runs[line.run].errors(line.estimate)
    rotation, translation = errors.rotation_deg.numpy(), errors.translation.numpy()
    return [rotation, translation, 100.0 * ((rotation < JOINT[0]) & (translation < JOINT[1]))]


def _signed(text: Callable[[float], str], value: float) -> str:
    return f"{'+' if value > 0 else ''}{text(value)}"


def _shown(interval: Interval, text: Callable[[float], str]) -> str:
    return f"{text(interval.value)}\n{text(interval.low)} to {text(interval.high)}"
