"""Numbers and points of problems in the form of the page: compressed JSON, as many points as there is room for."""

import base64
import gzip
import json
import math
from collections.abc import Hashable, Iterable, Mapping, Sequence
from itertools import chain
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from bpnp.report.points import FEW, Array, ProblemPoints, spread_key, thin, utf8
from bpnp.report.results import CAUSES, ProblemRow, Results
from bpnp.report.runs import lines_of

PAGE_POINTS = 300  # most points a side of a problem
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


def page_points(runs: Mapping[str, Results], points: Mapping[str, Sequence[ProblemPoints]], *, room: int) -> str:
    """The points of problems in about `room` characters at most: compressed lines of JSON.

    The first line has, by run, the number of the line after it for each of the run's problems, -1 for none. Runs on the
    same points share lines. Where not all problems have room, half of those that have are the worst and half are spread
    over the data set.
    """
    keys: dict[str, list[Hashable]] = {}  # of each run's problems, in the order of the page
    shared: dict[Hashable, dict[str, ProblemPoints]] = {}
    for name, results in runs.items():
        by_index = {problem.index: problem for problem in points.get(name, ())}
        rows = results.of(next(iter(results.estimates)))
        keys[name] = [_key(by_index[row.index], row) if row.index in by_index else None for row in rows]
        for key, row in zip(keys[name], rows, strict=True):
            if key is not None:
                shared.setdefault(key, {})[name] = by_index[row.index]
    error = {key: max(problem.error for problem in by_run.values()) for key, by_run in shared.items()}
    spread = [key for _, key in sorted(enumerate(shared), key=lambda numbered: spread_key(numbered[0]))]
    order = list(dict.fromkeys(chain.from_iterable(zip(sorted(error, key=lambda k: -error[k]), spread, strict=True))))
    lines = [json.dumps(_line(shared[key]), separators=(",", ":")) for key in order]
    count = len(order)
    while True:
        place = {key: k for k, key in enumerate(order[:count])}
        places = {name: [place.get(key, -1) for key in run_keys] for name, run_keys in keys.items()}
        text = compressed("\n".join([json.dumps(places), *lines[:count]]))
        if len(text) <= room or not count:
            return text
        count = int(0.99 * count * max(room, 0) / len(text))


def _key(problem: ProblemPoints, row: ProblemRow) -> Hashable:
    """The same for problems of the same points: the name, the numbers of points and the true pose."""
    return problem.id, row.m, row.n, None if problem.pose is None else np.c_[problem.pose].tobytes()


def _columns(rows: Sequence[ProblemRow]) -> dict[str, list[Any]]:
    return {
        **{key: [_shortened(getattr(row, key)) for row in rows] for key in ERRORS},
        **{key: [getattr(row, key) for row in rows] for key in COUNTS},
        "cause": [CAUSES.index(row.cause) for row in rows],
        "status": [2 if not row.found else 0 if row.converged else 1 for row in rows],
    }


def _shortened(value: float) -> float | str:
    """`DIGITS` significant digits; of what JSON has no number for, the name that JavaScript's `Number` reads."""
    if math.isfinite(value):
        return float(f"{value:.{DIGITS}g}")
    return "NaN" if math.isnan(value) else "Infinity"


def _line(runs: Mapping[str, ProblemPoints]) -> dict[str, Any]:
    """Points, true matches and pose; of each run the poses and, where there are many points, the assigned matches."""
    shown = thin(max(runs.values(), key=lambda problem: len(problem.points2d) + len(problem.points3d)), PAGE_POINTS)
    ids2d, ids3d = (ids.tolist() for ids in shown.numbers())
    decimals = _decimals(shown.points3d)
    place = {number: i for i, number in enumerate(ids2d)}
    assigned = {}
    for name, problem in runs.items():
        if len(problem.points3d) > FEW and (problem.assigned3d >= 0).any():
            numbers2d, numbers3d = problem.numbers()
            partner = {j: numbers2d[i] for j, i in zip(numbers3d.tolist(), problem.assigned3d, strict=True) if i >= 0}
            assigned[name] = [place.get(partner.get(j), -1) for j in ids3d]
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
