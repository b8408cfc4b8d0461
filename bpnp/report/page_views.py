"""What the page knows of single pairs: points of a few, a sketch of as many others as there is room for."""

import base64
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from bpnp.report.sketches import POINTS, Sketches
from bpnp.report.views import Array, PairView, thin

FORMATS = {"f4": "<f4", "i4": "<i4", "u2": "<u2", "i2": "<i2", "u1": "u1"}
VIEW_POINTS = 300
POSE_BYTES = 20
PAIR_BYTES = 5 * POINTS + 3 + 40 + POSE_BYTES + 4


def packed(values: npt.ArrayLike, kind: str) -> dict[str, str]:
    """Numbers as {kind: base64}; kinds as in `FORMATS`."""
    return {kind: base64.b64encode(np.asarray(values, dtype=FORMATS[kind]).tobytes()).decode()}


def page_view(view: PairView) -> dict[str, Any]:
    """Up to `VIEW_POINTS` points, coordinates in steps of 1/65535 of their box: finer than a screen shows."""
    view = thin(view, VIEW_POINTS)
    shown: dict[str, Any] = {
        "match3d": packed(view.match3d, "i2"),
        "assigned3d": packed(view.assigned3d, "i2"),
        "pose": None if view.pose is None else _numbers(view.pose),
        "estimates": {name: _numbers(pose) for name, pose in view.estimates.items()},
    }
    for name, points in (("points2d", view.points2d), ("points3d", view.points3d)):
        low, size = points.min(0), np.ptp(points, axis=0)
        steps = np.round((points - low) / np.where(size > 0, size, 1) * 65535)
        shown[name] = {"low": low.tolist(), "size": size.tolist(), **packed(steps.ravel(), "u2")}
    return shown


def page_sketches(
    sketches: Mapping[str, Sketches | None], places: Mapping[str, Mapping[int, int]], *, room: int
) -> tuple[dict[str, dict[str, Any]], list[dict[str, Any]]]:
    """(by run, its group and poses; the groups' points), in no more than about `room` characters.

    Runs on the same points share a group. places: by run, the place in its list of each pair's index. Where not all
    pairs have room, half of those that have are the worst of their group and half are spread over it.
    """
    groups: list[dict[str, Any]] = []
    for name, own in sketches.items():
        if own is None or not len(own):
            continue
        known = [group for group in groups if _same(group["points"], own, group["places"], places[name])]
        if not known:
            groups.append({"points": own, "places": places[name], "runs": {}})
        (known[0] if known else groups[-1])["runs"][name] = own
    costs = [4 / 3 * (PAIR_BYTES + POSE_BYTES * sum(len(s.estimates) for s in g["runs"].values())) for g in groups]
    total = sum(cost * len(group["points"]) for cost, group in zip(costs, groups, strict=True))
    share = max(0.0, min(1.0, room / total)) if total else 0.0
    runs: dict[str, dict[str, Any]] = {}
    shown = []
    for number, group in enumerate(groups):
        worst = np.max([own.error for own in group["runs"].values()], axis=0)
        rows = _chosen(worst, int(share * len(worst)))
        points: Sketches = group["points"]
        positions = [group["places"][int(i)] for i in points.index[rows]]
        shown.append(_points(points, rows) | {"rows": packed(positions, "i4")})
        for name, own in group["runs"].items():
            poses = {key: _poses(matrices[rows]) for key, matrices in own.estimates.items()}
            runs[name] = {"group": number, "all": len(rows) == len(places[name]), "poses": poses}
    return runs, shown


def _same(a: Sketches, b: Sketches, places: Mapping[int, int], others: Mapping[int, int]) -> bool:
    columns = ("index", "matched", "points2d", "points3d")
    return places == others and all(np.array_equal(getattr(a, name), getattr(b, name)) for name in columns)


def _chosen(error: Array, count: int) -> Array:
    """Rows, ascending: the worst and, by the golden ratio, others spread over the whole."""
    if count >= len(error):
        return np.arange(len(error))
    worst = np.argsort(-error, kind="stable")[: count - count // 2]
    spread = np.argsort(np.arange(len(error)) * 2654435769 % 2**32)
    return np.sort(np.r_[worst, spread[~np.isin(spread, worst)][: count // 2]])


def _points(own: Sketches, rows: Array) -> dict[str, Any]:
    shown: dict[str, Any] = {"points": POINTS, "truth": _poses(own.truth[rows])}
    boxes = []
    for name, count in (("points2d", own.count2d[rows]), ("points3d", own.count3d[rows])):
        values = getattr(own, name)[rows]
        real = np.arange(POINTS)[:, None] < count[:, None, None]
        low = np.where(real, values, np.inf).min(1, keepdims=True)
        size = np.where(real, values, -np.inf).max(1, keepdims=True) - low
        steps = np.round((values - low) / np.where(size > 0, size, 1) * 255)
        shown[name] = packed(np.where(real, steps, 0).ravel(), "u1")
        boxes += [low[:, 0], size[:, 0]]
    counts = np.stack([own.count2d[rows], own.count3d[rows], own.matched[rows]], -1)
    return shown | {"boxes": packed(np.concatenate(boxes, -1).ravel(), "f4"), "counts": packed(counts.ravel(), "u1")}


def _poses(matrices: Array) -> dict[str, dict[str, str]]:
    """Quaternions (x, y, z, w) in steps of 1/32767, all zero without a pose, and translations."""
    known: Array = np.asarray(np.isfinite(matrices).all((1, 2)))
    rotation = np.where(known[:, None, None], matrices[:, :, :3], np.eye(3))
    quaternion = Rotation.from_matrix(rotation).as_quat() if len(rotation) else np.empty((0, 4))
    steps = np.round(quaternion * 32767) * known[:, None]
    translation = np.where(known[:, None], matrices[:, :, 3], 0)
    return {"rotation": packed(steps.ravel(), "i2"), "translation": packed(translation.ravel(), "f4")}


def _numbers(pose: tuple[Any, Any]) -> list[float] | None:
    values = [*np.asarray(pose[0], float).ravel().tolist(), *np.asarray(pose[1], float).tolist()]
    return values if np.isfinite(values).all() else None
