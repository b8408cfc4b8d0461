"""Results by group against numbers by hand, and the settings in which two runs differ."""

from dataclasses import replace
from pathlib import Path

from report_data import rows

from bpnp.report import Results, write_results
from bpnp.report.groups import differences, group_rows
from bpnp.report.page import page_html
from bpnp.report.results import summarise

NAMES = ["chair/test/a", "desk/test/b", "chair/test/c", "chair/test/d", "desk/test/e"]


def results(settings: dict) -> Results:
    """Errors of 1 to 5 degrees."""
    found = [
        replace(row, id=name, rotation_error_deg=i + 1.0)
        for i, (row, name) in enumerate(zip(rows(5, seed=0, estimates=("pnp",)), NAMES, strict=True))
    ]
    return Results(tuple(found), summarise(found), None, settings, "0", "")


def test_each_group_has_its_median_and_the_largest_comes_first() -> None:
    assert group_rows({"a": results({}), "b": results({})}) == [
        ("chair", 3, ["3.00", "3.00"]),
        ("desk", 2, ["3.50", "3.50"]),
    ]


def test_problems_without_groups_have_no_table() -> None:
    found = [replace(row, id=f"problem {i}") for i, row in enumerate(rows(5, seed=0))]
    assert group_rows({"a": Results(tuple(found), summarise(found), None, {}, "0", "")}) == []


def test_the_settings_that_differ_are_named_with_both_values() -> None:
    one = {"solver": {"class_path": "Net", "init_args": {"rounds": 0, "mu": 0.1}}, "checkpoint": "a.ckpt"}
    other = {"solver": {"class_path": "Net", "init_args": {"rounds": 8, "mu": 0.1}}, "checkpoint": "a.ckpt"}
    assert differences({"a": results(one), "b": results(other)}) == ["solver.rounds: 0 (a), 8 (b)"]
    assert differences({"a": results(one)}) == []


def test_the_page_shows_both(tmp_path: Path) -> None:
    for name, rounds in (("a", 0), ("b", 8)):
        write_results(tmp_path / name, results({}).rows, settings={"solver": {"init_args": {"rounds": rounds}}})
    page = page_html([tmp_path / "a", tmp_path / "b"])
    assert "<li>solver.rounds: 0 (a), 8 (b)</li>" in page
    assert "<h2>By class or scene</h2>" in page
