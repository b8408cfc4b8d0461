"""Bootstrap intervals against scipy's bootstrap, laws of chance, and pairs whose difference is known."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from report_data import rows
from scipy import stats

from bpnp.report import ProblemRow, Results
from bpnp.report.intervals import bootstrap, fraction, interval_cells, paired_difference, quantile
from bpnp.report.results import summarise


def results(found: Sequence[ProblemRow]) -> Results:
    return Results(tuple(found), summarise(found), None, {}, "0", "")


def test_the_interval_of_a_median_is_scipys() -> None:
    values = np.random.default_rng(1).gamma(2.0, 3.0, 200)
    expected = stats.bootstrap((values,), np.median, method="percentile", n_resamples=2000, rng=2).confidence_interval
    found = bootstrap(values)
    assert found.value == np.median(values)
    assert (found.low, found.high) == pytest.approx((expected.low, expected.high), abs=0.15)


def test_nineteen_of_twenty_intervals_contain_the_true_fraction() -> None:
    rng = np.random.default_rng(0)
    held = 0
    for seed in range(200):
        found = bootstrap((rng.random(100) < 0.7).astype(float), fraction, seed=seed)
        held += found.low <= 0.7 <= found.high
    assert 180 <= held <= 199


def test_a_paired_interval_shows_a_difference_that_separate_intervals_hide() -> None:
    rng = np.random.default_rng(0)
    first = rng.gamma(2.0, 5.0, 300)
    second = first + 0.3 + 0.01 * rng.normal(size=300)
    apart = paired_difference(first, second)
    assert 0 < apart.low < 0.3 < apart.high < 0.4
    one, other = bootstrap(first), bootstrap(second)
    assert one.high > other.low
    same = paired_difference(first, first)
    assert (same.value, same.low, same.high) == (0, 0, 0)


def test_problems_without_a_pose_are_infinite_and_leave_the_rest_alone() -> None:
    values = np.array([1.0, 2, 3, np.inf, np.inf])
    assert bootstrap(values).value == 3
    assert bootstrap(values).high == np.inf
    assert bootstrap(values, quantile(0.25)).value == 2


def test_an_interval_of_nan_or_unequal_lists_is_refused() -> None:
    with pytest.raises(ValueError, match="there are 2, 1 of them NaN"):
        bootstrap(np.array([1.0, np.nan]))
    with pytest.raises(ValueError, match="the same problems; there are 2 and 3"):
        paired_difference(np.ones(2), np.ones(3))


def test_the_table_pairs_runs_of_the_same_problems_with_the_first_row() -> None:
    """Every rotation error of the second run is 1 degree less; a run of other problems has no difference."""
    first = [replace(row, rotation_error_deg=10.0 + row.index) for row in rows(40, seed=0, estimates=("pnp",))]
    better = [replace(row, rotation_error_deg=row.rotation_error_deg - 1) for row in first]
    runs = {"first": results(first), "better": results(better), "other": results(better[:30])}
    cells = interval_cells(runs)
    assert cells[0][4:6] == ["", ""]
    assert cells[1][4:6] == ["-1", "-1 to -1"]
    assert cells[2][4:6] == ["", ""]
    assert [row[0] for row in cells] == ["29.5", "28.5", "23.5"]
    low, high = (float(x) for x in cells[0][1].split(" to "))
    assert 10 < low < 29.5 < high < 50
