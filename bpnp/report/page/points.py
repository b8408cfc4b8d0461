"""The points of pairs in the form of the page: packed columns, as many pairs as there is room for."""

import base64
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from bpnp.report.samples import FEW, Array, PairView, thin

FORMATS = {"f4": "<f4", "i4": "<i4", "u2": "<u2", "i2": "<i2", "u1": "u1"}
VIEW_POINTS = 300  # most points a side of a pair
STEPS = 65535  # coordinates are multiples of 1/65535 of their box
POSE_BYTES = 20  # a quaternion of int16 and a translation of float32
PAIR_BYTES = FEW * (2 + 3 + 2) * 2 + 6 + 40 + 4 + POSE_BYTES


@dataclass
class Group:
    """Runs on the same points. places: the place of each pair's index in the page's lists."""

    places: Mapping[int, int]
    views: dict[str, dict[int, PairView]]


def packed(values: npt.ArrayLike, kind: str) -> dict[str, str]:
    """Numbers as {kind: base64}; kinds as in `FORMATS`."""
    return {kind: base64.b64encode(np.asarray(values, dtype=FORMATS[kind]).tobytes()).decode()}


def whole(values: npt.ArrayLike) -> dict[str, str]:
    """Whole numbers in 2 bytes each where they fit, else 4."""
    array = np.asarray(values)
    fits = array.size == 0 or (array.min() >= 0 and array.max() < 2**16)
    return packed(array, "u2" if fits else "i4")


def page_points(
    views: Mapping[str, Sequence[PairView]], places: Mapping[str, Mapping[int, int]], *, room: int
) -> list[dict[str, Any]]:
    """The points of the pairs of all runs, in no more than about `room` characters.

    Runs on the same points share them. Where not all pairs have room, half of those that have are the worst and half
    are spread over the data set.
    """
    groups: list[Group] = []
    for name, own in views.items():
        if own:
            by_index = {view.index: view for view in own if view.index in places[name]}
            known = [group for group in groups if group.places == places[name] and _same(group, by_index)]
            (known[0].views if known else _new(groups, places[name])).update({name: by_index})
    costs = [_cost(group) for group in groups]
    total = sum(map(sum, costs))
    share = min(1.0, max(0.0, room / total)) if total else 0.0
    return [_packed_group(group, _chosen(group, share)) for group in groups]


def _new(groups: list[Group], places: Mapping[int, int]) -> dict[str, dict[int, PairView]]:
    groups.append(Group(places, {}))
    return groups[-1].views


def _same(group: Group, own: Mapping[int, PairView]) -> bool:
    """Whether a run has the points of the group: the same pairs, true poses and, of equally thinned pairs, points."""
    other = next(iter(group.views.values()))
    return other.keys() == own.keys() and all(
        np.array_equal(np.c_[a.pose or ([], [])], np.c_[own[i].pose or ([], [])])
        and (len(a.points2d) != len(own[i].points2d) or np.array_equal(a.points2d, own[i].points2d))
        and (len(a.points3d) != len(own[i].points3d) or np.array_equal(a.points3d, own[i].points3d))
        for i, a in other.items()
    )


def _cost(group: Group) -> list[float]:
    """Characters of each pair."""
    poses = POSE_BYTES * sum(len(next(iter(own.values())).estimates) for own in group.views.values())
    return [4 / 3 * (PAIR_BYTES + poses)] * len(next(iter(group.views.values())))


def _chosen(group: Group, share: float) -> list[int]:
    """Indices of pairs, ascending: the worst in any run and, by the golden ratio, others spread over the whole."""
    indices = np.array(sorted(next(iter(group.views.values()))))
    count = int(share * len(indices))
    if count == len(indices):
        return [int(index) for index in indices]
    error = np.max([[own[i].error for i in indices] for own in group.views.values()], axis=0)
    worst = np.argsort(-error, kind="stable")[: count - count // 2]
    spread = np.argsort(np.arange(len(indices)) * 2654435769 % 2**32)
    return sorted(indices[np.r_[worst, spread[~np.isin(spread, worst)][: count // 2]]].tolist())


def _packed_group(group: Group, indices: Sequence[int]) -> dict[str, Any]:
    """Matched points come first: 3D point j < matched is seen as 2D point j."""
    counts: list[tuple[int, int, int]] = []
    boxes: list[Array] = []
    steps2d: list[Array] = []
    steps3d: list[Array] = []
    ids2d: list[Array] = []
    ids3d: list[Array] = []
    truth: list[tuple[Array, Array] | None] = []
    assigned: dict[str, dict[str, Any]] = {name: {} for name in group.views}
    for index in indices:
        all_runs = {name: own[index] for name, own in group.views.items()}
        view = thin(max(all_runs.values(), key=lambda own: len(own.points2d) + len(own.points3d)), VIEW_POINTS)
        matched = np.flatnonzero(view.match3d >= 0)
        partners = view.match3d[matched]
        order2d = np.r_[partners, np.setdiff1d(np.arange(len(view.points2d)), partners)].astype(int)
        order3d = np.r_[matched, np.flatnonzero(view.match3d < 0)].astype(int)
        counts.append((len(order2d), len(order3d), len(matched)))
        for points, steps in ((view.points2d[order2d], steps2d), (view.points3d[order3d], steps3d)):
            low, size = points.min(0), np.ptp(points, axis=0)
            steps.append(np.round((points - low) / np.where(size > 0, size, 1) * STEPS).ravel())
            boxes += [low, size]
        numbers2d, numbers3d = view.numbers()
        ids2d.append(numbers2d[order2d])
        ids3d.append(numbers3d[order3d])
        truth.append(view.pose)
        for name, own in all_runs.items():
            if len(own.points3d) > FEW and (own.assigned3d >= 0).any():
                place = np.full(int(max(own.numbers()[0], default=0)) + 1, -1)
                place[numbers2d[order2d]] = np.arange(len(order2d))
                by_id = dict(zip(own.numbers()[1].tolist(), own.assigned3d.tolist(), strict=True))
                wanted = [by_id.get(int(i), -1) for i in numbers3d[order3d]]
                own2d = own.numbers()[0]
                shown = [place[own2d[k]] if k >= 0 else -1 for k in wanted]
                assigned[name][str(group.places[index])] = packed(shown, "i2")
    return {
        "rows": packed([group.places[i] for i in indices], "i4"),
        "counts": whole(np.ravel(counts)),
        "boxes": packed(_flat(boxes), "f4"),
        "points2d": packed(_flat(steps2d), "u2"),
        "points3d": packed(_flat(steps3d), "u2"),
        "ids2d": whole(_flat(ids2d)),
        "ids3d": whole(_flat(ids3d)),
        "truth": packed_poses(truth),
        "assigned": assigned,
        "poses": {
            name: {
                key: packed_poses([own[i].estimates[key] for i in indices])
                for key in next(iter(own.values())).estimates
            }
            for name, own in group.views.items()
        },
    }


def packed_poses(poses: Iterable[tuple[Array, Array] | None]) -> dict[str, dict[str, str]]:
    """Quaternions (x, y, z, w) in steps of 1/32767, all zero without a pose, and translations."""
    missing = np.full((3, 4), np.nan)
    matrices = np.array([missing if pose is None else np.c_[pose] for pose in poses]).reshape(-1, 3, 4)
    known = np.isfinite(matrices).all((1, 2))
    rotation = np.where(known[:, None, None], matrices[:, :, :3], np.eye(3))
    quaternion = Rotation.from_matrix(rotation).as_quat() if len(rotation) else np.empty((0, 4))
    translation = np.where(known[:, None], matrices[:, :, 3], 0)
    return {
        "rotation": packed(np.round(quaternion * 32767 * known[:, None]).ravel(), "i2"),
        "translation": packed(translation.ravel(), "f4"),
    }


def _flat(parts: Sequence[Array]) -> Array:
    return np.concatenate([np.empty(0), *parts])
