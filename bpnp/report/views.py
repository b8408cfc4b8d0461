"""The points of a few pairs of a test, `views.npz`: enough to draw what the cameras see, for the worst and some others.

A test of ten thousand pairs keeps a few dozen. Which ones does not depend on the order of batches or on processes.
"""

import io
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from torch import Tensor

from bpnp.files import written_whole
from bpnp.metrics import rotation_error
from bpnp.types import Batch, Prediction

FORMAT = 1
FILE = "views.npz"
MOST_POINTS = 1000

Array = npt.NDArray[Any]


@dataclass(frozen=True)
class PairView:
    """One pair, ready to draw. Conventions as in `bpnp.types`: camera = R p + t, normalised image coordinates.

    points2d: (m, 2). points3d: (n, 3). match3d: (n,) the 2D point that each 3D point truly is, -1 for none.
    assigned3d: (n,) the 2D point to which the solver's assignment gives most of each 3D point, -1 if it has none.
    pose: true rotation (3, 3) and translation (3,), None if unknown. estimates: the same by name; NaN without a pose.
    error: rotation error of the first estimate in degrees, by which the worst are chosen.
    """

    index: int
    id: str
    points2d: Array
    points3d: Array
    match3d: Array
    assigned3d: Array
    pose: tuple[Array, Array] | None = None
    estimates: dict[str, tuple[Array, Array]] = field(default_factory=dict)
    error: float = 180.0


def views_from(prediction: Prediction, batch: Batch, *, most_points: int = MOST_POINTS) -> list[PairView]:
    """The views of a batch. Of larger sets `most_points` are kept on each side, evenly spaced, matched ones first."""
    points2d, points3d, mask2d, mask3d = map(_host, (batch.points2d, batch.points3d, batch.mask2d, batch.mask3d))
    unknown = np.full(mask3d.shape, -1)
    match3d = unknown if batch.match3d is None else _host(batch.match3d)
    assignment = prediction.assignment if prediction.rematched is None else prediction.rematched
    assigned3d = unknown if assignment is None else _host(assignment.argmax(-2))
    poses = {name: (_host(pose.rotation), _host(pose.translation)) for name, pose in prediction.poses.items()}
    truth = None
    if batch.rotation is not None and batch.translation is not None:
        truth = (_host(batch.rotation), _host(batch.translation))
    errors = _first_errors(prediction, batch)
    views = []
    for i in range(len(batch)):
        real3d = mask3d[i]
        match = match3d[i][real3d]
        keep2d, keep3d = _kept(int(mask2d[i].sum()), match, most_points)
        views.append(
            PairView(
                index=int(batch.index[i]),
                id=batch.ids[i],
                points2d=points2d[i][mask2d[i]][keep2d].astype(np.float32),
                points3d=points3d[i][real3d][keep3d].astype(np.float32),
                match3d=_renumbered(match[keep3d], keep2d),
                assigned3d=_renumbered(assigned3d[i][real3d][keep3d], keep2d),
                pose=None if truth is None else (truth[0][i], truth[1][i]),
                estimates={name: (rotation[i], translation[i]) for name, (rotation, translation) in poses.items()},
                error=errors[i],
            )
        )
    return views


def view_of(
    points2d: Array, points3d: Array, rotation: Array, translation: Array, *, matches: Array | None = None, id: str = ""
) -> PairView:
    """The view of one solved pair: points (m, 2) and (n, 3), pose camera = R p + t.

    matches: (k, 2) indices of a 2D and a 3D point. Raises ValueError if one of them is no point.
    """
    assigned = np.full(len(points3d), -1, np.int32)
    if matches is not None and len(matches):
        most = np.max(matches, axis=0)
        if np.min(matches) < 0 or most[0] >= len(points2d) or most[1] >= len(points3d):
            sizes = f"{len(points2d)} 2D and {len(points3d)} 3D points"
            raise ValueError(f"expected `matches` of {sizes}, got indices up to {most.tolist()}")
        assigned[matches[:, 1]] = matches[:, 0]
    none = np.full(len(points3d), -1, np.int32)
    pose = (np.asarray(rotation), np.asarray(translation))
    return PairView(0, id, np.asarray(points2d), np.asarray(points3d), none, assigned, None, {"solution": pose})


def select_views(views: Iterable[PairView], *, worst: int = 12, others: int = 12) -> tuple[PairView, ...]:
    """The `worst` pairs and `others` spread over the data set, by index.

    Choosing from what was chosen of the parts gives the same as choosing from the whole, so that views can be selected
    batch by batch and process by process: `kept = select_views([*kept, *views_from(prediction, batch)])`.
    """
    if worst < 0 or others < 0:
        raise ValueError(f"expected `worst` and `others` >= 0, got {worst} and {others}")
    once = {view.index: view for view in views}
    by_error = sorted(once.values(), key=lambda view: (-view.error, view.index))
    # Multiplying by the golden ratio modulo 1 spreads indices evenly, whatever their number.
    spread = sorted(once.values(), key=lambda view: (view.index * 2654435769) % 2**32)
    chosen = {view.index: view for view in [*by_error[:worst], *spread[:others]]}
    return tuple(chosen[index] for index in sorted(chosen))


def thin(view: PairView, most: int) -> PairView:
    """The view with at most `most` points on each side, matched ones first."""
    keep2d, keep3d = _kept(len(view.points2d), view.match3d, most)
    return replace(
        view,
        points2d=view.points2d[keep2d],
        points3d=view.points3d[keep3d],
        match3d=_renumbered(view.match3d[keep3d], keep2d),
        assigned3d=_renumbered(view.assigned3d[keep3d], keep2d),
    )


def write_views(folder: Path | str, views: Iterable[PairView]) -> None:
    """Write `views.npz` whole or not at all. Float32, uncompressed, no pickles."""
    arrays: dict[str, Array] = {"format": np.array(FORMAT)}
    for number, view in enumerate(views):
        fields = ("points2d", "points3d", "match3d", "assigned3d", "index", "id", "error")
        parts: dict[str, Any] = {name: getattr(view, name) for name in fields}
        if view.pose is not None:
            parts["pose"] = _stacked(view.pose)
        for order, (name, pose) in enumerate(view.estimates.items()):
            parts |= {f"estimate{order}": name, f"estimate{order}.pose": _stacked(pose)}
        arrays |= {f"{number}.{name}": np.asarray(value) for name, value in parts.items()}
    content = io.BytesIO()
    np.savez(content, allow_pickle=False, **arrays)  # type: ignore[arg-type, unused-ignore]
    with written_whole(Path(folder) / FILE) as temporary:
        temporary.write_bytes(content.getvalue())


def read_views(folder: Path | str) -> tuple[PairView, ...]:
    """Read what `write_views` wrote; empty if the folder has none. Raises ValueError that names an unreadable file."""
    path = Path(folder) / FILE
    if not path.is_file():
        return ()
    try:
        with np.load(path, allow_pickle=False) as archive:
            arrays = dict(archive)
        found = int(arrays.pop("format"))
        if found == FORMAT:
            numbers = sorted({int(name.split(".")[0]) for name in arrays})
            return tuple(_view(arrays, f"{number}.") for number in numbers)
    except (KeyError, ValueError, OSError, EOFError) as error:
        raise ValueError(f"expected views of a test in {path}, got {error}; try `bpnp test` again") from error
    raise ValueError(f"expected views of format {FORMAT} in {path}, got {found}; try the bpnp that wrote them")


def _view(arrays: dict[str, Array], prefix: str) -> PairView:
    own = {name.removeprefix(prefix): value for name, value in arrays.items() if name.startswith(prefix)}
    estimates: dict[str, tuple[Array, Array]] = {}
    while (key := f"estimate{len(estimates)}") in own:
        estimates[str(own[key])] = _split(own[f"{key}.pose"])
    return PairView(
        index=int(own["index"]),
        id=str(own["id"]),
        points2d=own["points2d"],
        points3d=own["points3d"],
        match3d=own["match3d"],
        assigned3d=own["assigned3d"],
        pose=_split(own["pose"]) if "pose" in own else None,
        estimates=estimates,
        error=float(own["error"]),
    )


def _stacked(pose: tuple[Array, Array]) -> Array:
    rotation, translation = pose
    return np.c_[rotation, translation].astype(np.float64)


def _split(pose: Array) -> tuple[Array, Array]:
    return pose[:, :3], pose[:, 3]


def _host(values: Tensor) -> Array:
    return values.detach().cpu().numpy()


def _first_errors(prediction: Prediction, batch: Batch) -> list[float]:
    pose = next(iter(prediction.poses.values()), None)
    if pose is None or batch.rotation is None:
        return [180.0] * len(batch)
    error = rotation_error(pose.rotation, batch.rotation)
    return [float(value) for value in error.where(pose.found, 180.0).tolist()]


def _kept(m: int, match: Array, most: int) -> tuple[Array, Array]:
    """Indices of the 2D and 3D points that are kept, ascending."""
    matched = match >= 0
    keep3d = _first_then_rest(np.flatnonzero(matched), np.flatnonzero(~matched), most)
    partners = np.unique(match[keep3d][match[keep3d] >= 0])
    rest = np.setdiff1d(np.arange(m), partners)
    return _first_then_rest(partners, rest, most), keep3d


def _first_then_rest(first: Array, rest: Array, most: int) -> Array:
    """All of `first` and then of `rest`, each thinned evenly where there is no room; ascending."""
    head = _thinned(first, most)
    return np.sort(np.r_[head, _thinned(rest, most - len(head))]).astype(np.int64)


def _thinned(values: Array, most: int) -> Array:
    if len(values) <= most:
        return values
    return values[np.linspace(0, len(values) - 1, most).astype(np.int64)] if most else values[:0]


def _renumbered(targets: Array, kept: Array) -> Array:
    """Positions of `targets` in the sorted indices `kept`; -1 for those that are not kept."""
    if len(kept) == 0:
        return np.full(len(targets), -1, np.int32)
    position = np.searchsorted(kept, targets).clip(max=len(kept) - 1)
    return np.where(kept[position] == targets, position, -1).astype(np.int32)
