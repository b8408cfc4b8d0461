"""Numbers and points of problems in the form of the page: compressed JSON."""

import base64
import gzip
import json
import math
from collections.abc import Hashable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from bpnp.report.points import Array, ProblemPoints, utf8
from bpnp.report.results import CAUSES, ProblemRow, Results
from bpnp.report.runs import lines_of

PROBLEMS = 500  # whose points are on the page
DIGITS = 5  # significant ones of errors; of points and poses, of their extent
ERRORS = ("rotation_error_deg", "translation_error", "centre_error", "reprojection_error_deg", "seconds")
COUNTS = ("inliers", "m", "n", "matches", "iterations")


def compressed(text: str) -> str:
    """gzip in base64, which the page's `inflated` reads."""
    return base64.b64encode(gzip.compress(text.encode(), 6, mtime=0)).decode()


def shown_id(id: str) -> str:
    """A problem's name as the page has it."""
    return utf8(id) or "(no name)"


def page_numbers(runs: Mapping[str, Results]) -> dict[str, Any]:
    """The numbers of all problems: a series for each run and estimate. Columns of several series are there once."""
    columns: dict[tuple[Any, ...], int] = {}

    def place(values: Iterable[Any]) -> int:
        return columns.setdefault(tuple(values), len(columns))

    series = []
    for line in lines_of(runs):
        rows = runs[line.run].of(line.estimate)
        names = {"run": line.run, "estimate": line.estimate, "name": line.label, "colour": f"c{line.colour}"}
        ids, numbers = place(shown_id(row.id) for row in rows), _columns(rows)
        series.append(names | {"ids": ids, "numbers": {key: place(values) for key, values in numbers.items()}})
    return {"series": series, "columns": list(columns)}


def page_points(runs: Mapping[str, Results], points: Mapping[str, Sequence[ProblemPoints]]) -> str:
    """The points of the `PROBLEMS` worst problems of all runs: compressed lines of JSON.

    The first line has, by run, the number of the line after it for each of the run's problems, -1 for none. Runs on the
    same points share lines.
    """
    keys = {name: {problem.index: _key(problem) for problem in points[name]} for name in runs}
    shared: dict[Hashable, dict[str, ProblemPoints]] = {}
    for name in runs:
        for problem in points[name]:
            shared.setdefault(keys[name][problem.index], {})[name] = problem
    error = {key: max(problem.error for problem in by_run.values()) for key, by_run in shared.items()}
    worst = sorted(error, key=lambda key: -error[key])[:PROBLEMS]
    place = {key: number for number, key in enumerate(worst)}
    places = {
        name: [place.get(keys[name].get(row.index), -1) for row in results.of(next(iter(results.estimates)))]
        for name, results in runs.items()
    }
    lines = [json.dumps(_line(shared[key]), separators=(",", ":")) for key in worst]
    return compressed("\n".join([json.dumps(places), *lines]))


def _key(problem: ProblemPoints) -> Hashable:
    """The same for problems of the same points: the name, the points that are there and the true pose."""
    pose = None if problem.pose is None else np.c_[problem.pose].tobytes()
    return problem.id, problem.points2d.tobytes(), problem.points3d.tobytes(), pose


def _columns(rows: Sequence[ProblemRow]) -> dict[str, list[Any]]:
    return {
        **{key: [_shortened(getattr(row, key)) for row in rows] for key in ERRORS},
        **{key: [getattr(row, key) for row in rows] for key in COUNTS},
        "cause": [CAUSES.index(row.cause) for row in rows],
    }


def _shortened(value: float) -> float | str:
    """`DIGITS` significant digits; of what JSON has no number for, the name that JavaScript's `Number` reads."""
    if math.isfinite(value):
        return float(f"{value:.{DIGITS}g}")
    return "NaN" if math.isnan(value) else "Infinity"


def _line(runs: Mapping[str, ProblemPoints]) -> dict[str, Any]:
    """Points, true matches and pose; of each run the poses and the assigned matches."""
    shown = next(iter(runs.values()))
    ids2d, ids3d = (ids.tolist() for ids in shown.numbers())
    decimals = _decimals(shown.points3d)
    assigned = {name: problem.assigned3d.tolist() for name, problem in runs.items() if (problem.assigned3d >= 0).any()}
    return {
        "points2d": np.round(shown.points2d.astype(float), _decimals(shown.points2d)).tolist(),
        "points3d": np.round(shown.points3d.astype(float), decimals).tolist(),
        "ids2d": ids2d,
        "ids3d": ids3d,
        "match3d": shown.match3d.tolist(),
        "assigned": assigned,
        "truth": _pose(shown.pose, decimals),
        "poses": {
            name: {estimate: _pose(pose, decimals) for estimate, pose in problem.estimates.items()}
            for name, problem in runs.items()
        },
    }


def _decimals(points: Array) -> int:
    """Decimal places of `DIGITS` digits of the points' extent."""
    extent = float(np.ptp(points, axis=0).max()) if len(points) else 0.0
    return DIGITS - math.floor(math.log10(extent)) if extent > 0 else DIGITS


def _pose(pose: tuple[Array, Array] | None, decimals: int) -> list[float] | None:
    """Quaternion (x, y, z, w) and translation; none without a pose."""
    if pose is None or not np.isfinite(np.c_[pose]).all():
        return None
    quaternion = Rotation.from_matrix(pose[0]).as_quat()
    return [*np.round(quaternion, DIGITS).tolist(), *np.round(np.asarray(pose[1], float), decimals).tolist()]
