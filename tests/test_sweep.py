"""The sweep over outliers: errors of planted poses, areas under known curves, and the table of a record."""

import math
from types import SimpleNamespace
from typing import Any

import bench_sweep
import numpy as np
import pytest
from bench_sweep import area_under_curve, errors
from scipy.spatial.transform import Rotation


def test_the_area_under_the_curve_is_the_mean_recall_over_thresholds() -> None:
    """By hand: errors 0, half the limit and beyond it; and against a sum over thresholds."""
    assert area_under_curve(np.array([0.0, 2.5, math.inf]), 5.0) == pytest.approx((1 + 0.5 + 0) / 3)
    values = np.random.default_rng(0).gamma(1, 3, 50)
    recalls = [np.mean(values < limit) for limit in np.linspace(0, 10, 20_001)]
    assert area_under_curve(values, 10.0) == pytest.approx(np.mean(recalls), abs=1e-3)


def test_errors_are_those_of_a_planted_pose() -> None:
    """A camera rolled by 3 degrees: a point at an angle of 45 degrees moves by 2 sin(1.5 degrees) focal lengths."""
    points = np.array([[4.0, 0, 4], [0, -4.0, 4], [9, 9, 9]])
    true = (np.eye(3), np.zeros(3))
    problem: Any = SimpleNamespace(points3d=points, matched=np.array([True, True, False]), pose=true, focal=500.0)
    rolled = (Rotation.from_euler("z", 3, degrees=True).as_matrix(), np.array([0.0, 0, 0]))
    degrees, shift, pixels = errors(problem, rolled)
    assert (degrees, shift) == (pytest.approx(3), 0)
    assert pixels == pytest.approx(500 * 2 * math.sin(math.radians(1.5)))
    assert errors(problem, None) == (180, math.inf, math.inf)


def test_the_table_has_a_row_a_method_and_a_column_a_fraction() -> None:
    right, wrong = (
        {"rotation": 1.0, "translation": 0.5, "pixels": 5.0},
        {"rotation": 90.0, "translation": None, "pixels": None},
    )
    rows = {"0|a|x": right, "0|a|y": wrong, "1|a|x": wrong, "0|b|x": right}
    tables = bench_sweep.tables({"rows": rows})
    assert tables["recall"].splitlines()[2:4] == ["| a | 50 |  |  |  | 0 |", "| b | 100 |  |  |  |  |"]
    assert tables["recall"].count("MegaDepth") == 2
    assert tables["auc"].splitlines()[2] == "| a | 0 / 0 / 25 |  |  |  | 0 / 0 / 0 |"
    assert bench_sweep.sheets({"rows": rows})[""].splitlines()[1].startswith("0,a,x,1.0,0.5,5.0")
