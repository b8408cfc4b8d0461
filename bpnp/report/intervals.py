"""Bootstrap intervals of figures of a test, and of the difference of two methods on the same problems."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

LEVEL = 0.95
DRAWS = 2000
FINITE = 1e12  # in place of infinity, so that an interpolation with it is defined

Statistic = Callable[[NDArray[np.float64]], NDArray[np.float64]]  # of the last axis


@dataclass(frozen=True)
class Interval:
    """A figure and its percentile bootstrap interval of 95 %."""

    value: float
    low: float
    high: float


def median(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the median along the last axis."""
    return np.asarray(np.median(values, axis=-1))


def bootstrap(values: NDArray[np.float64], statistic: Statistic = median, *, seed: int = 0) -> Interval:
    """Return a statistic of some problems and its interval over draws of as many problems with replacement.

    Args:
        values: one number per problem (k,); infinity for a problem without a pose.
        statistic: of the last axis.
        seed: of the draws.

    Raises:
        ValueError: There are no values, or one is NaN.
    """
    clean = _checked(values)
    drawn = statistic(clean[_draws(len(clean), seed)])
    return _interval(float(statistic(clean)), drawn)


def paired_difference(
    first: NDArray[np.float64], second: NDArray[np.float64], statistic: Statistic = median, *, seed: int = 0
) -> Interval:
    """Return statistic(second) - statistic(first) and its interval over draws of the same problems for both.

    An interval on one side of zero is a difference that the problems show.

    Args:
        first: one number per problem (k,).
        second: numbers of the same problems in the same order.
        statistic: of the last axis.
        seed: of the draws.

    Raises:
        ValueError: The lengths differ, there are no values, or one is NaN.
    """
    if len(first) != len(second):
        raise ValueError(f"a paired difference needs the same problems, got {len(first)} and {len(second)}")
    one, other = _checked(first), _checked(second)
    draws = _draws(len(one), seed)
    drawn = statistic(other[draws]) - statistic(one[draws])
    return _interval(float(statistic(other) - statistic(one)), drawn)


def quantile(fraction: float) -> Statistic:
    """Return the statistic of this quantile."""
    return lambda values: np.asarray(np.quantile(values, fraction, axis=-1))


def share(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the mean of zeros and ones along the last axis."""
    return np.asarray(np.mean(values, axis=-1))


def _draws(count: int, seed: int) -> NDArray[np.int64]:
    return np.random.default_rng(seed).integers(0, count, (DRAWS, count))


def _checked(values: NDArray[np.float64]) -> NDArray[np.float64]:
    array = np.asarray(values, np.float64)
    if not len(array) or np.isnan(array).any():
        raise ValueError(f"a bootstrap needs numbers, got {len(array)} of which {int(np.isnan(array).sum())} are NaN")
    return np.clip(array, -FINITE, FINITE)


def _interval(value: float, drawn: NDArray[np.float64]) -> Interval:
    low, high = np.quantile(drawn, [(1 - LEVEL) / 2, (1 + LEVEL) / 2])
    numbers = (float(x) if abs(x) < FINITE / 2 else float(np.sign(x) * np.inf) for x in (value, low, high))
    return Interval(*numbers)
