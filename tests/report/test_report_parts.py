"""Causes of failures, the palette, the training log and the plain table of a report."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from report_data import rows, write_run

from bpnp.report import cause_shares, read_training_log, table
from bpnp.report.palette import DARK, INKS, LIGHT, styles
from bpnp.report.runs import named_runs

# Machado, Oliveira, Fernandes 2009, severity 1.0, on linear RGB: how the three kinds of dichromats see.
SEEN = {
    "normal": np.eye(3),
    "protanopia": np.array(
        [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]]
    ),
    "deuteranopia": np.array(
        [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]]
    ),
    "tritanopia": np.array(
        [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.303900]]
    ),
}


def linear(colours: tuple[str, ...]) -> np.ndarray:
    """Linear RGB of sRGB colours."""
    values = np.array([[int(colour[i : i + 2], 16) for i in (1, 3, 5)] for colour in colours]) / 255
    return np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)


def lab(rgb: np.ndarray) -> np.ndarray:
    """CIE Lab of linear RGB, white D65."""
    to_xyz = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
    xyz = rgb.clip(0, 1) @ to_xyz.T / [0.95047, 1.0, 1.08883]
    f = np.where(xyz > 0.008856, np.cbrt(xyz), 7.787 * xyz + 16 / 116)
    return np.stack([116 * f[:, 1] - 16, 500 * (f[:, 0] - f[:, 1]), 200 * (f[:, 1] - f[:, 2])], -1)


@pytest.mark.parametrize("sight", SEEN)
@pytest.mark.parametrize(("colours", "background"), [(LIGHT, INKS["background"][0]), (DARK, INKS["background"][1])])
def test_colours_stay_apart_for_every_kind_of_sight(colours: tuple[str, ...], background: str, sight: str) -> None:
    seen = lab(linear(colours) @ SEEN[sight].T)
    distance = np.linalg.norm(seen[:, None] - seen, axis=-1)
    assert distance[~np.eye(len(colours), dtype=bool)].min() > (23 if sight == "tritanopia" else 30)
    luminance = linear((*colours, background)) @ [0.2126, 0.7152, 0.0722] + 0.05
    assert np.maximum(luminance[:-1] / luminance[-1], luminance[-1] / luminance[:-1]).min() >= 3


def test_every_estimate_looks_different() -> None:
    few = styles({"a": ["ransac", "pnp"], "b": ["ransac", "pnp"]})
    assert len({colour for colour, _ in few.values()}) == 4
    many = styles({f"run{i}": ["ransac", "pnp", "refined"] for i in range(8)})
    assert len(set(many.values())) == 24
    assert many["run3", "pnp"] == (3, 1)


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


def test_names_are_what_paths_do_not_share(tmp_path: Path) -> None:
    def names(*paths: str) -> list[str]:
        return list(named_runs([tmp_path / path for path in paths]))

    assert names("a/test", "b/test") == ["a", "b"]
    assert names("x/a/test", "x/b/c/test") == ["a", "b/c"]
    assert names("a/test", "a/untrained") == ["test", "untrained"]
    assert names("a/test", "test") == ["a/test", "test"]
    assert names("a/test") == names("a") == ["a"]
    for method in ("table/rho-0/blind", "table/rho-1/blind", "run/test", "run/untrained"):
        (tmp_path / method).mkdir(parents=True)
        (tmp_path / method / "summary.json").write_text("{}")
    assert names("table") == ["rho-0", "rho-1"]
    assert names("run") == ["run"]


def test_long_curves_are_thinned_without_moving_their_mean(tmp_path: Path) -> None:
    write_log(tmp_path, 0, range(10_000), 0.5)
    log = read_training_log(tmp_path)
    assert log is not None
    steps, values = log.curves["train/loss"]
    assert len(steps) == len(values) <= 500
    assert np.mean(steps) == pytest.approx(9999 / 2)
    assert set(values) == {0.5}


def test_the_table_has_a_row_per_run_and_estimate(tmp_path: Path) -> None:
    results = write_run(tmp_path / "run", 9, 0)
    by_path, by_name = (
        table(runs).to_dict("records") for runs in ([tmp_path / "run"], {"mine": results})
    )  # fmt: skip
    assert [(row["run"], row["estimate"]) for row in by_path] == [("run", "ransac"), ("run", "pnp")]
    errors = [row.rotation_error_deg for row in results.rows if row.estimate == "pnp"]
    assert by_name[1]["rotation_q2_deg"] == by_path[1]["rotation_q2_deg"] == pytest.approx(np.median(errors))
    assert by_name[1]["correspondence_loss"] == 0.25
