"""Bootstrap intervals against scipy's bootstrap, laws of chance, and pairs whose difference is known."""

import io
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from report_data import rows
from rich.console import Console
from scipy import stats

from bpnp.report import ProblemRow, Results
from bpnp.report.charts import recall_chart
from bpnp.report.intervals import (
    Interval,
    bootstrap,
    fraction,
    interval_table,
    paired_difference,
    quantile,
)
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


@pytest.mark.slow
def test_what_is_interpolated_with_infinity_is_infinite() -> None:
    """The third quartile of 500 problems, 375 with a pose, lies between the last of these and infinity."""
    found = bootstrap(np.r_[np.linspace(0, 1, 375), np.full(125, np.inf)], quantile(0.75))
    assert (found.value, found.high) == (np.inf, np.inf)
    assert 0.9 < found.low <= 1
    assert bootstrap(np.r_[np.ones(9999), np.inf], fraction).value == np.inf
    assert paired_difference(np.full(4, 10.0), np.array([0.1, 0.1, np.inf, np.inf])).value == np.inf
    assert paired_difference(np.full(2, 5.0), np.array([1.0, np.inf])) == Interval(np.inf, -4.0, np.inf)


def test_a_difference_of_two_infinite_medians_is_unknown() -> None:
    lost = np.full(5, np.inf)
    unknown = paired_difference(lost, lost)
    assert np.isnan(unknown.value)
    assert (unknown.low, unknown.high) == (-np.inf, np.inf)
    # Both medians are finite, but infinite in more than 2.5 % of the draws.
    partly = paired_difference(np.r_[np.ones(6), np.full(5, np.inf)], np.r_[np.full(6, 3.0), np.full(5, np.inf)])
    assert partly == Interval(2.0, -np.inf, np.inf)


def test_an_interval_of_nan_or_unequal_lists_is_refused() -> None:
    with pytest.raises(ValueError, match="there are 2, 1 of them NaN"):
        bootstrap(np.array([1.0, np.nan]))
    with pytest.raises(ValueError, match="the same problems; there are 2 and 3"):
        paired_difference(np.ones(2), np.ones(3))


COLUMNS = ["rotation_q2_deg", "translation_q2", "reprojection_q2_deg", "recall_joint_15deg_0.5", "seconds_mean"]


def rows_of(estimates: dict[str, float], **shift: float) -> list[ProblemRow]:
    """40 problems with rotation errors of 10, 11, ... degrees plus a number for each estimate, and translation errors
    of 0, 0.02, ...; shifted."""
    return [
        replace(
            row,
            rotation_error_deg=10.0 + row.index + estimates[row.estimate] + shift.get("rotation", 0),
            translation_error=0.02 * row.index + shift.get("translation", 0),
            reprojection_error_deg=1.0 + 0.1 * row.index + shift.get("reprojection", 0),
            seconds=0.5 + shift.get("seconds", 0),
        )
        for row in rows(40, seed=0, estimates=tuple(estimates))
    ]


def texts(runs: dict[str, Results]) -> dict[tuple[str, str], list[str]]:
    """The cells of each row, by the label of its estimate and that of what is subtracted."""
    table = interval_table(runs)
    (shown,) = table.groups.values()
    return {(row.line.label, row.minus.label if row.minus else ""): table.cells(row) for row in shown}


def test_each_row_is_paired_with_the_same_estimate_of_the_first_run() -> None:
    """The second run turns each problem by 1 degree less and misses it by 0.25 more. Of the 40 problems of `pnp`, those
    with index 0 to 5 are within 15 degrees and 0.5; of the second run 0 to 6; `ransac` is 3 degrees worse."""
    estimates = {"ransac": 3.0, "pnp": 0.0}
    shift = {"rotation": -1, "translation": 0.25, "reprojection": 0.5, "seconds": 0.25}
    runs = {"Lc": results(rows_of(estimates)), "test": results(rows_of(estimates, **shift))}
    runs["other"] = results(rows_of(estimates)[:60])
    cells = texts(runs)
    assert list(cells) == [
        ("Lc: ransac", ""),
        ("Lc: pnp", ""),
        ("test: ransac", ""),
        ("test: ransac", "Lc: ransac"),
        ("test: pnp", ""),
        ("test: pnp", "Lc: pnp"),
        ("other: ransac", ""),  # other problems
        ("other: pnp", ""),
    ]
    values = {label: [text.split("\n")[0] for text in row] for (label, minus), row in cells.items() if not minus}
    assert values["Lc: ransac"] == ["32.5", "0.390", "2.95", "7.5", "0.500"]
    assert values["Lc: pnp"] == ["29.5", "0.390", "2.95", "15.0", "0.500"]
    assert values["test: ransac"] == ["31.5", "0.640", "3.45", "10.0", "0.750"]
    assert values["test: pnp"] == ["28.5", "0.640", "3.45", "17.5", "0.750"]
    assert (values["other: ransac"][0], values["other: pnp"][0]) == ("27.5", "24.5")
    for estimate in estimates:  # against its own kind: neither 3 - 1 nor -3 - 1
        rotation, translation, reprojection, recall, seconds = cells[f"test: {estimate}", f"Lc: {estimate}"]
        assert rotation == "-1.00\n-1.00 to -1.00"
        assert translation == "+0.250\n+0.250 to +0.250"
        assert reprojection == "+0.500\n+0.500 to +0.500"
        assert seconds == "+0.250\n+0.250 to +0.250"
        value, low, high = (float(x) for x in recall.replace("\n", " to ").split(" to "))
        assert value == 2.5
        assert low <= 0 < value < high
    low, high = (float(x) for x in cells["Lc: ransac", ""][0].split("\n")[1].split(" to "))
    assert 13 < low < 32.5 < high < 53


def test_the_numbers_are_those_of_the_summary() -> None:
    """Of problems with and without poses and matches; an error at a limit is within it."""
    found = [*rows(40, seed=3, estimates=("pnp",))]
    found[2] = replace(found[2], rotation_error_deg=15.0, translation_error=0.5)
    run = results(found)
    frame = interval_table({"run": run}).frame()
    assert run.estimates["pnp"]["without_matches"] == 1
    for key in COLUMNS:
        assert frame[key][0] == pytest.approx(run.estimates["pnp"][key], rel=1e-12)
        assert frame[f"{key}_low"][0] <= frame[key][0] <= frame[f"{key}_high"][0]
    assert (frame.run[0], frame.estimate[0], frame["minus"][0], frame.problems[0]) == ("run", "pnp", "", 40)


@pytest.mark.parametrize(
    ("kind", "key", "head"),
    [
        ("MeshDataModule", "recall_joint_15deg_0.5", "% within\n15deg 0.5"),
        ("ColmapDataModule", "recall_joint_10deg_1", "% within\n10deg 1"),
    ],
)
def test_the_recall_has_the_limits_of_the_table_of_the_paper(kind: str, key: str, head: str) -> None:
    """15 degrees and 0.5 for shapes (Table 1), 10 degrees and 1.0 for photos (Table 2)."""
    found = rows(40, seed=3, estimates=("pnp",))
    run = replace(results(found), settings={"data": {"class_path": f"bpnp.datamodules.{kind}"}})
    table = interval_table({"run": run})
    assert table.columns[3].header == head
    assert table.frame()[key][0] == pytest.approx(run.estimates["pnp"][key])
    chart = recall_chart({"run": run}, "joint")
    assert chart is not None
    degrees, length = map(float, head.split("\n")[1].replace("deg", "").split())
    at = next(i for i, x in enumerate(chart.data[0].x) if x > degrees)
    assert chart.data[0].y[at - 1] <= run.estimates["pnp"][key] <= chart.data[0].y[at]
    assert chart.layout.xaxis.title.text.endswith(f"within {length:g} scene units")


def test_the_estimates_of_one_run_are_paired_with_its_first() -> None:
    cells = texts({"run": results(rows_of({"ransac": 3.0, "pnp": 0.0}))})
    assert list(cells) == [("ransac", ""), ("pnp", ""), ("pnp", "ransac")]
    assert cells["pnp", "ransac"][:2] == ["-3.00\n-3.00 to -3.00", "0\n0 to 0"]


def test_an_estimate_that_the_first_run_lacks_is_paired_with_its_first() -> None:
    runs = {"softposit": results(rows_of({"softposit": 3.0})), "net": results(rows_of({"pnp": 0.0}))}
    assert texts(runs)["net: pnp", "softposit: softposit"][0] == "-3.00\n-3.00 to -3.00"


def test_problems_without_a_pose_have_no_finite_translation_interval() -> None:
    lost = [replace(row, translation_error=np.inf) for row in rows_of({"pnp": 0.0})]
    cells = texts({"a": results(rows_of({"pnp": 0.0})), "b": results(lost)})
    assert cells["b: pnp", ""][1] == "inf\ninf to inf"
    assert cells["b: pnp", "a: pnp"][1] == "+inf\n+inf to +inf"


def test_reprojection_errors_of_different_problems_are_not_paired() -> None:
    """One problem without a match has no error; without any match the cell is empty."""
    known, none = rows_of({"pnp": 0.0}), [replace(row, reprojection_error_deg=np.nan) for row in rows_of({"pnp": 0.0})]
    runs = {"all": results(known), "but one": results([*known[:-1], none[-1]]), "none": results(none)}
    cells = texts(runs)
    assert [cells[f"{name}: pnp", ""][2].split("\n")[0] for name in runs] == ["2.95", "2.90", "-"]
    assert [cells[f"{name}: pnp", "all: pnp"][2] for name in ("but one", "none")] == ["-", "-"]
    assert cells["none: pnp", "all: pnp"][0] == "0\n0 to 0"


def test_runs_on_other_problems_are_named() -> None:
    """They have no rows "minus": what is missing is said below the table."""
    own, other = results(rows_of({"pnp": 0.0})), results(rows_of({"pnp": 0.0})[:-1])
    table = interval_table({"a": own, "b": other, "c": own})
    assert [row.label for row in table.groups[""]] == ["a: pnp", "b: pnp", "c: pnp", "minus a: pnp"]
    assert table.note == "No differences for b: a was tested on other problems."
    text = io.StringIO()
    Console(file=text, width=80).print(table.split_table())
    assert table.note in " ".join(text.getvalue().split())
    assert interval_table({"a": own, "c": own}).note == interval_table({"b": other}).note == ""


def test_the_terminal_shows_each_interval_below_its_number_within_80_columns() -> None:
    estimates = {"ransac": 3.0, "pnp": 0.0}
    runs = {"Lc": results(rows_of(estimates)), "test": results(rows_of(estimates, rotation=-1))}
    text = io.StringIO()
    Console(file=text, width=80).print(interval_table(runs).split_table())
    lines = text.getvalue().splitlines()
    assert max(map(len, lines)) <= 80
    (number,) = (i for i, line in enumerate(lines) if "test:" in line and "28.5" in line)
    assert lines[number + 1].split()[:3] == ["pnp", "22.5", "to"]  # names are folded, and the table is not split
    assert sum("-1.00 to -1.00" in line for line in lines) == 2
    assert sum("rotation" in line and "translation" in line for line in lines) == 1


def test_a_difference_of_estimates_without_poses_is_a_dash() -> None:
    lost = [replace(row, rotation_error_deg=180.0, translation_error=float("inf")) for row in rows_of({"pnp": 0.0})]
    difference = texts({"a": results(lost), "b": results(lost)})["b: pnp", "a: pnp"]
    assert difference[:2] == ["0\n0 to 0", "-\n-inf to +inf"]
