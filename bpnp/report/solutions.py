"""The view of one solved pair: of the object that `bpnp.solve` returns, or of the file that `bpnp solve` writes."""

import json
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np

from bpnp.report.samples import Array, PairView

NEEDED = ("points2d", "points3d", "rotation", "translation")


@runtime_checkable
class Solved(Protocol):
    """What a view needs of a solution: points (m, 2) and (n, 3), pose camera = R p + t, matches (k, 2).

    A 2D point of NaN, which the camera could not undistort, is not drawn.
    """

    @property
    def points2d(self) -> Any: ...
    @property
    def points3d(self) -> Any: ...
    @property
    def rotation(self) -> Any: ...
    @property
    def translation(self) -> Any: ...
    @property
    def matches(self) -> Any: ...


def solution_view(solution: Solved, *, id: str | None = None) -> PairView:
    """The view of a solution. A pose that was not found, None or NaN, is none. Raises ValueError for missing points."""
    parts = {name: getattr(solution, name, None) for name in (*NEEDED, "matches", "point_ids")}
    verdict, ratio = getattr(solution, "verdict", None), getattr(solution, "inlier_ratio", None)
    return _view(parts, id=id or _title("solution", verdict, ratio))


def read_solution(path: Path | str) -> PairView:
    """The view of a solution's JSON file. Raises ValueError that names the file and what is wrong in it."""
    path = Path(path)
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ValueError(f"expected the JSON of a solution in {path}, got {error}") from error
    if not isinstance(content, dict) or any(name not in content for name in NEEDED):
        if isinstance(content, dict) and "images" in content:
            raise ValueError(
                f"expected one solution in {path}, got the results of `bpnp localize`; its pictures are in "
                f"{path.parent / 'pictures'}"
            )
        missing = [name for name in NEEDED if not isinstance(content, dict) or name not in content]
        raise ValueError(f"expected a solution in {path}, got no {', '.join(missing)}; try `bpnp solve` again")
    try:
        return _view(content, id=_title(path.stem, content.get("verdict"), content.get("inlier_ratio")))
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


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


def _view(parts: dict[str, Any], *, id: str) -> PairView:
    points2d, points3d = _array(parts, "points2d", (-1, 2)), _array(parts, "points3d", (-1, 3))
    rotation, translation = (
        np.full(shape, np.nan) if parts[name] is None else _array(parts, name, shape)
        for name, shape in (("rotation", (3, 3)), ("translation", (3,)))
    )
    matches = parts.get("matches")
    if matches is not None:
        matches = _array(parts, "matches", (-1, 2)).astype(np.int64) if len(matches) else None
    if matches is not None and parts.get("point_ids") is not None:  # of a map: places of the points from their ids
        ids = np.asarray(parts["point_ids"])
        order = np.argsort(ids)
        matches[:, 1] = order[np.searchsorted(ids, matches[:, 1], sorter=order)]
    finite = np.isfinite(points2d[:, 0]) & np.isfinite(points2d[:, 1])
    if not finite.all():
        if not finite.any():
            raise ValueError("expected finite `points2d`, got none")
        if matches is not None and matches[:, 0].max() < len(finite):
            matches = matches[finite[matches[:, 0]]]
            matches[:, 0] = (np.cumsum(finite) - 1)[matches[:, 0]]
        points2d = points2d[finite]
    return view_of(points2d, points3d, rotation, translation, matches=matches, id=id)


def _array(parts: dict[str, Any], name: str, shape: tuple[int, ...]) -> Array:
    try:
        found = np.asarray(parts[name], np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"expected numbers in `{name}`, got {parts[name]!r:.60}") from error
    wanted = tuple(size if size >= 0 else (len(found) if found.ndim else 0) for size in shape)
    if found.shape != wanted or found.size == 0:
        raise ValueError(f"expected `{name}` of shape {str(shape).replace('-1', 'k')}, got {found.shape}")
    return found


def _title(name: str, verdict: Any, ratio: Any) -> str:
    said = [str(getattr(verdict, "value", verdict))] if verdict is not None else []
    if isinstance(ratio, (int, float)):
        said.append(f"{100 * ratio:.0f} % inliers")
    return f"{name}: {', '.join(said)}" if said else name
