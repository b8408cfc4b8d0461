"""Causes of failures, the palette, the training log and the plain table of a report."""

import dataclasses
from pathlib import Path

import pytest
from report_data import rows

from bpnp.report.results import cause_shares
from bpnp.report.runs import read_training_log


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


def write_log(folder: Path, version: int, steps: range, value: float, switch: int = 10**9) -> None:
    path = folder / "logs" / f"version_{version}" / "metrics.csv"
    path.parent.mkdir(parents=True)
    lines = [f"{step},{value},{1.0 if step >= switch else ''}" for step in steps]
    path.write_text("\n".join(["step,train/loss,train/without_pose", *lines]))


def test_a_resumed_training_is_one_curve_and_a_repeated_one_the_newest(tmp_path: Path) -> None:
    write_log(tmp_path / "resumed", 0, range(0, 80, 10), 2.0)
    write_log(tmp_path / "resumed", 1, range(50, 100, 10), 1.0, switch=70)
    log = read_training_log(tmp_path / "resumed" / "test")
    assert log is not None
    assert log.curves["train/loss"] == (list(range(0, 100, 10)), [2.0] * 5 + [1.0] * 5)
    assert log.switch_step == 70
    write_log(tmp_path / "repeated", 9, range(0, 50, 10), 2.0)
    write_log(tmp_path / "repeated", 10, range(0, 30, 10), 1.0)
    log = read_training_log(tmp_path / "repeated")
    assert log is not None
    assert log.curves["train/loss"] == ([0, 10, 20], [1.0] * 3)
    assert log.switch_step is None
    assert read_training_log(tmp_path) is None


def test_a_training_too_short_to_log_its_loss_shows_its_validation(tmp_path: Path) -> None:
    for version, lines in enumerate((["0,0.9"], ["19,0.6", "39,0.5"])):
        path = tmp_path / "short" / "logs" / f"version_{version}" / "metrics.csv"
        path.parent.mkdir(parents=True)
        path.write_text("\n".join(["step,val/correspondence_loss", *lines]))
    log = read_training_log(tmp_path / "short")
    assert log is not None
    assert log.curves == {"val/correspondence_loss": ([19, 39], [0.6, 0.5])}
    write_log(tmp_path / "short", 2, range(0, 50, 10), 2.0)  # a longer one is all that counts
    log = read_training_log(tmp_path / "short")
    assert log is not None
    assert list(log.curves) == ["train/loss"]
