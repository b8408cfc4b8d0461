"""The numbers and the points of pairs in the form of the page: compressed JSON, as many points as there is room for."""

import base64
import gzip
import json
import math
from collections.abc import Hashable, Iterable, Mapping, Sequence
from itertools import chain
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from bpnp.report.results import CAUSES, PairRow, Results
from bpnp.report.runs import series_of
from bpnp.report.samples import FEW, Array, PairView, spread_key, thin

VIEW_POINTS = 300  # most points a side of a pair
DIGITS = 5  # significant ones of errors; of points and poses, of their extent
ERRORS = ("rotation_error_deg", "translation_error", "centre_error", "reprojection_error_deg", "seconds")
COUNTS = ("inliers", "m", "n", "true_pairs", "iterations")


def compressed(text: str) -> str:
    """gzip in base64, which the page's `inflated` reads."""
    return base64.b64encode(gzip.compress(text.encode(), 6, mtime=0)).decode()


def shown_id(id: str) -> str:
    """A pair's name with replacements for bytes that are no UTF-8."""
    return id.encode("utf-8", "replace").decode() or "(no name)"


def page_numbers(runs: Mapping[str, Results]) -> dict[str, Any]:
    """The numbers of all pairs: a series for each run and estimate. Columns of several series are kept once."""
    columns: dict[tuple[Any, ...], int] = {}

    def place(values: Iterable[Any]) -> int:
        return columns.setdefault(tuple(values), len(columns))

    series = [
        {
            "run": own.run, "estimate": own.estimate, "name": own.label, "colour": f"c{own.colour}",
            "ids": place(shown_id(row.id) for row in runs[own.run].of(own.estimate)),
            "numbers": {key: place(values) for key, values in _columns(runs[own.run].of(own.estimate)).items()},
        }
        for own in series_of(runs)
    ]  # fmt: skip
    return {"series": series, "columns": list(columns)}


def page_points(runs: Mapping[str, Results], views: Mapping[str, Sequence[PairView]], *, room: int) -> str:
    """The points of pairs in about `room` characters at most: compressed lines of JSON.

    The first line has, by run, the number of the line after it for each of the run's pairs, -1 for none. Runs on the
    same points share lines. Where not all pairs have room, half of those that have are the worst and half are spread
    over the data set.
    """
    keys: dict[str, list[Hashable]] = {}  # of each run's pairs, in the order of the page
    shared: dict[Hashable, dict[str, PairView]] = {}
    for name, results in runs.items():
        own = {view.index: view for view in views.get(name, ())}
        pairs = results.of(next(iter(results.estimates)))
        keys[name] = [_key(own[row.index], row) if row.index in own else None for row in pairs]
        for key, row in zip(keys[name], pairs, strict=True):
            if key is not None:
                shared.setdefault(key, {})[name] = own[row.index]
    error = {key: max(view.error for view in own.values()) for key, own in shared.items()}
    spread = [key for _, key in sorted(enumerate(shared), key=lambda numbered: spread_key(numbered[0]))]
    order = list(dict.fromkeys(chain.from_iterable(zip(sorted(error, key=lambda k: -error[k]), spread, strict=True))))
    lines = [json.dumps(_line(shared[key]), separators=(",", ":")) for key in order]
    count = len(order)
    while True:
        place = {key: k for k, key in enumerate(order[:count])}
        places = {name: [place.get(key, -1) for key in own] for name, own in keys.items()}
        text = compressed("\n".join([json.dumps(places), *lines[:count]]))
        if len(text) <= room or not count:
            return text
        count = int(0.99 * count * max(room, 0) / len(text))


def _key(view: PairView, row: PairRow) -> Hashable:
    """The same for pairs of the same points: the name, the numbers of points and the true pose."""
    return view.id, row.m, row.n, None if view.pose is None else np.c_[view.pose].tobytes()


def _columns(rows: Sequence[PairRow]) -> dict[str, list[Any]]:
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


def _line(runs: Mapping[str, PairView]) -> dict[str, Any]:
    """Points, true matches and pose, and of each run the poses and, of pairs of many points, the assigned matches."""
    view = thin(max(runs.values(), key=lambda own: len(own.points2d) + len(own.points3d)), VIEW_POINTS)
    ids2d, ids3d = (ids.tolist() for ids in view.numbers())
    decimals = _decimals(view.points3d)
    place = {own: i for i, own in enumerate(ids2d)}
    assigned = {}
    for name, own in runs.items():
        if len(own.points3d) > FEW and (own.assigned3d >= 0).any():
            own2d, own3d = own.numbers()
            matched = own.assigned3d >= 0
            partner = dict(zip(own3d[matched].tolist(), own2d[own.assigned3d[matched]].tolist(), strict=True))
            assigned[name] = [place.get(partner.get(j), -1) for j in ids3d]
    found = [pose for own in runs.values() for pose in own.estimates.values()]
    truth, *poses = _poses([view.pose, *found], decimals)
    left = iter(poses)
    return {
        "points2d": np.round(view.points2d.astype(float), _decimals(view.points2d)).tolist(),
        "points3d": np.round(view.points3d.astype(float), decimals).tolist(),
        "ids2d": ids2d, "ids3d": ids3d, "match3d": view.match3d.tolist(), "assigned": assigned, "truth": truth,
        "poses": {name: dict(zip(own.estimates, left, strict=False)) for name, own in runs.items()},
    }  # fmt: skip


def _decimals(points: Array) -> int:
    """Decimal places of `DIGITS` digits of the points' extent."""
    extent = float(np.ptp(points, axis=0).max()) if len(points) else 0.0
    return DIGITS - math.floor(math.log10(extent)) if extent > 0 else DIGITS


def _poses(poses: Sequence[tuple[Array, Array] | None], decimals: int) -> list[list[float] | None]:
    """Quaternions (x, y, z, w) and translations; none without a pose."""
    missing = np.full((3, 4), np.nan)
    matrices = np.array([missing if pose is None else np.c_[pose] for pose in poses], float)
    known = np.isfinite(matrices).all((1, 2))
    matrices[~known] = np.eye(3, 4)
    quaternions = np.round(Rotation.from_matrix(matrices[:, :, :3]).as_quat(), DIGITS)
    numbers = np.c_[quaternions, np.round(matrices[:, :, 3], decimals)].tolist()
    return [own if there else None for own, there in zip(numbers, known.tolist(), strict=True)]
