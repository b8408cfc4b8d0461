"""Causes of failures, of a report."""

import dataclasses

import pytest
from report_data import rows

from bpnp.report.results import cause_shares


def test_each_row_has_the_cause_that_its_numbers_say() -> None:
    good = dataclasses.replace(
        rows(1, 0)[0], rotation_error_deg=1.0, converged=True, found=True, inliers=0, m=10
    )  # fmt: skip
    cases = {
        "solved": {"converged": False},
        "no pose": {"found": False, "rotation_error_deg": 180.0},
        "wrong, not converged": {"rotation_error_deg": 6.0, "converged": False, "inliers": 9},
        "wrong, but fits the image": {"rotation_error_deg": 6.0, "inliers": 5},
        "wrong": {"rotation_error_deg": 6.0, "inliers": 4},
    }
    planted = [dataclasses.replace(good, **changes) for changes in cases.values()]  # type: ignore[arg-type]
    assert [row.cause for row in planted] == list(cases)
    shares = cause_shares([*planted, planted[0]])
    assert shares == {cause: (2 if cause == "solved" else 1) / 6 for cause in cases}
    with pytest.raises(ValueError, match="expected at least one row"):
        cause_shares([])
