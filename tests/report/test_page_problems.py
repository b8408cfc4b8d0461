"""The points of pairs on the page: planted points and poses survive."""

import json
from dataclasses import replace
from typing import Any

import numpy as np
from planted import seen
from report_data import drawn_problem, inflated, row
from scipy.spatial.transform import Rotation

from bpnp.report.page import PROBLEMS, page_points
from bpnp.report.points import ProblemPoints
from bpnp.report.results import Results


def results(problems: list[ProblemPoints]) -> Results:
    rows = tuple(row(own.index, id=own.id, m=len(own.points2d), n=len(own.points3d)) for own in problems)
    return Results(rows, {"pnp": {}}, None, {}, "", "")


def read(text: str) -> tuple[dict[str, list[int]], list[dict[str, Any]]]:
    """The number of each pair's line by run, and the lines."""
    places, *lines = map(json.loads, inflated(text).split("\n"))
    return places, lines


def planted(count: int) -> list[ProblemPoints]:
    """Pairs of 10 to 59 points, exactly projected by `ransac`; `pnp` has no pose."""
    return [drawn_problem(i, f"scene/{i:04d}", 10 + i % 50) for i in range(count)]


def test_the_page_has_the_points_and_poses_of_every_problem() -> None:
    problems = planted(40)
    runs = {"a": results(problems), "b": results(problems)}
    places, lines = read(page_points(runs, {"a": problems, "b": problems}))
    assert places["a"] == places["b"]
    assert sorted(places["a"]) == list(range(40))
    for place, original in zip(places["a"], problems, strict=True):
        line = lines[place]
        assert len(line["points2d"]) == len(original.points2d)
        points2d, points3d = np.array(line["points2d"]), np.array(line["points3d"])
        np.testing.assert_allclose(points3d, original.points3d[line["ids3d"]], atol=1e-4)
        rotation, translation = original.estimates["ransac"]
        *quaternion, x, y, z = line["poses"]["b"]["ransac"]
        assert (Rotation.from_quat(quaternion).inv() * Rotation.from_matrix(rotation)).magnitude() < 1e-4
        np.testing.assert_allclose([x, y, z], translation, atol=1e-4)
        projected = seen(points3d, rotation, translation)
        np.testing.assert_allclose(projected[line["match3d"]], points2d, atol=1e-4)
        assert line["poses"]["a"]["pnp"] is None


def test_poses_of_points_far_from_the_origin_project_them() -> None:
    """Such as the coordinates of a national grid, in metres."""
    original, shift = planted(1)[0], np.array([5e5, 5.2e6, 100.0])
    rotation, translation = original.estimates["ransac"]
    moved = replace(
        original,
        points3d=original.points3d + shift,
        estimates={"ransac": (rotation, translation - rotation @ shift)},
    )
    _, (line,) = read(page_points({"a": results([moved])}, {"a": [moved]}))
    *quaternion, x, y, z = line["poses"]["a"]["ransac"]
    projected = seen(np.array(line["points3d"]), Rotation.from_quat(quaternion).as_matrix(), np.array([x, y, z]))
    np.testing.assert_allclose(projected[line["match3d"]], line["points2d"], atol=1e-4)


def test_the_page_keeps_the_problems_with_the_largest_errors() -> None:
    error = np.random.default_rng(0).random(PROBLEMS + 50)
    problems = [replace(own, error=float(error[own.index])) for own in planted(len(error))]
    places, lines = read(page_points({"a": results(problems)}, {"a": problems}))
    assert len(lines) == PROBLEMS
    assert set(np.flatnonzero(np.array(places["a"]) >= 0)) == set(np.argsort(-error)[:PROBLEMS])
