"""A few points of every pair of a test, `sketches.npz`: enough to see what went wrong with any of ten thousand pairs.

`views.npz` keeps up to a thousand points of a few pairs; this keeps `POINTS` of each, 0.7 kB a pair.
"""

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bpnp.files import written_whole
from bpnp.report.views import Array, PairView

FORMAT = 1
FILE = "sketches.npz"
POINTS = 24
COLUMNS = ("index", "count2d", "count3d", "matched", "points2d", "points3d", "truth", "error")


@dataclass(frozen=True)
class Sketches:
    """k pairs. 3D point j < matched was seen as 2D point j; the rest of the first count2d and count3d points match
    nothing that was kept; zeros follow.

    index, count2d, count3d, matched, error (k,); points2d (k, POINTS, 2); points3d (k, POINTS, 3); truth (k, 3, 4) and
    each of the estimates: [R | t], NaN for no pose. error: as in `PairView`.
    """

    index: Array
    count2d: Array
    count3d: Array
    matched: Array
    points2d: Array
    points3d: Array
    truth: Array
    error: Array
    estimates: dict[str, Array]

    def __len__(self) -> int:
        return len(self.index)

    def view(self, row: int, id: str) -> PairView:
        """The pair of a row, ready to draw."""
        match = np.arange(self.count3d[row])
        match = np.where(match < self.matched[row], match, -1).astype(np.int32)
        truth = self.truth[row]
        return PairView(
            index=int(self.index[row]),
            id=id,
            points2d=self.points2d[row, : self.count2d[row]],
            points3d=self.points3d[row, : self.count3d[row]],
            match3d=match,
            assigned3d=np.full_like(match, -1),
            pose=_split(truth) if np.isfinite(truth).all() else None,
            estimates={name: _split(poses[row]) for name, poses in self.estimates.items()},
            error=float(self.error[row]),
        )


def sketches_of(views: Sequence[PairView]) -> Sketches:
    """Sketches of views that have the same estimates. Matched points come first, thinned evenly."""
    k = len(views)
    counts = np.zeros((3, k), np.int64)
    points2d, points3d = np.zeros((k, POINTS, 2), np.float32), np.zeros((k, POINTS, 3), np.float32)
    for i, view in enumerate(views):
        true3d = _thinned(np.flatnonzero(view.match3d >= 0), POINTS)
        true2d = view.match3d[true3d]
        free2d = np.setdiff1d(np.arange(len(view.points2d)), view.match3d)
        free3d = np.flatnonzero(view.match3d < 0)
        kept2d = np.r_[true2d, _thinned(free2d, POINTS - len(true2d))].astype(np.int64)
        kept3d = np.r_[true3d, _thinned(free3d, POINTS - len(true3d))].astype(np.int64)
        counts[:, i] = len(kept2d), len(kept3d), len(true3d)
        points2d[i, : len(kept2d)], points3d[i, : len(kept3d)] = view.points2d[kept2d], view.points3d[kept3d]
    names = list(views[0].estimates) if views else []
    return Sketches(
        index=np.array([view.index for view in views], np.int64),
        count2d=counts[0],
        count3d=counts[1],
        matched=counts[2],
        points2d=points2d,
        points3d=points3d,
        truth=_stacked([view.pose for view in views]),
        error=np.array([view.error for view in views], np.float64),
        estimates={name: _stacked([view.estimates[name] for view in views]) for name in names},
    )


def joined(parts: Sequence[Sketches]) -> Sketches:
    """The sketches of all parts with the same estimates, sorted by index, each pair once."""
    columns = {name: np.concatenate([getattr(part, name) for part in parts]) for name in COLUMNS}
    _, first = np.unique(columns["index"], return_index=True)
    names = list(parts[0].estimates)
    estimates = {name: np.concatenate([part.estimates[name] for part in parts])[first] for name in names}
    return Sketches(**{name: values[first] for name, values in columns.items()}, estimates=estimates)


def write_sketches(folder: Path | str, sketches: Sketches) -> None:
    """Write `sketches.npz` whole or not at all; no pickles."""
    arrays: dict[str, Array] = {name: getattr(sketches, name) for name in COLUMNS}
    arrays |= {f"estimate.{name}": poses for name, poses in sketches.estimates.items()}
    content = io.BytesIO()
    np.savez(content, allow_pickle=False, format=np.array(FORMAT), **arrays)  # type: ignore[arg-type, unused-ignore]
    with written_whole(Path(folder) / FILE) as temporary:
        temporary.write_bytes(content.getvalue())


def read_sketches(folder: Path | str) -> Sketches | None:
    """Read what `write_sketches` wrote; None if the folder has none. Raises ValueError that names a broken file."""
    path = Path(folder) / FILE
    if not path.is_file():
        return None
    try:
        with np.load(path, allow_pickle=False) as archive:
            arrays: Mapping[str, Array] = dict(archive)
        found = int(arrays["format"])
        if found == FORMAT:
            prefix = "estimate."
            estimates = {name.removeprefix(prefix): a for name, a in arrays.items() if name.startswith(prefix)}
            return Sketches(**{name: arrays[name] for name in COLUMNS}, estimates=estimates)
    except Exception as error:
        raise ValueError(f"expected sketches of a test in {path}, got {error}; try `bpnp test` again") from error
    raise ValueError(f"expected sketches of format {FORMAT} in {path}, got {found}; try the bpnp that wrote them")


def _thinned(values: Array, most: int) -> Array:
    if len(values) <= most:
        return values
    return values[np.linspace(0, len(values) - 1, most).astype(np.int64)] if most else values[:0]


def _stacked(poses: Sequence[tuple[Array, Array] | None]) -> Array:
    missing = np.full((3, 4), np.nan)
    rows = [missing if pose is None else np.c_[pose[0], pose[1]] for pose in poses]
    return np.array(rows, np.float32).reshape(-1, 3, 4)


def _split(pose: Array) -> tuple[Array, Array]:
    return pose[:, :3].astype(np.float64), pose[:, 3].astype(np.float64)
