"""Points of the problems of a test, `points.npz`: up to `MOST` points on each side, enough to draw them."""

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from bpnp.arrays import AnyArray
from bpnp.bounded_files import read_npz
from bpnp.cameras import Camera
from bpnp.files import write_atomically
from bpnp.metrics import PoseErrors, prediction_errors
from bpnp.types import Batch, Prediction

FORMAT = 2
FILE = "points.npz"
MOST = 100  # largest number of points on a side
IDS = ("ids2d", "ids3d")
POINTS: dict[str, tuple[Any, ...]] = {  # type and width of the columns, with all problems one after the other
    "points2d": (np.float32, 2),
    "points3d": (np.float32, 3),
    **dict.fromkeys(("match3d", "assigned3d", *IDS), (np.int32,)),
}


@dataclass(frozen=True)
class ProblemPoints:
    """Problem to draw. Conventions are those of `bpnp.types`: camera = R p + t, normalised image coordinates."""

    index: int
    id: str
    points2d: AnyArray  # image points (m, 2)
    points3d: AnyArray  # scene points (n, 3)
    match3d: AnyArray  # index of the true 2D point of each 3D point (n,), -1 for none
    assigned3d: AnyArray  # index of each 3D point's likeliest 2D point in the assignment (n,), -1 for none
    pose: tuple[AnyArray, AnyArray] | None = None  # true R (3, 3) and t (3,), None if unknown
    # R (3, 3) and t (3,) by the name of the estimate; NaN without a pose.
    estimates: dict[str, tuple[AnyArray, AnyArray]] = field(default_factory=dict)
    error: float = 180.0  # rotation error of the first estimate, degrees
    ids2d: AnyArray | None = None  # indices of the 2D points in the whole problem, None if all points are here
    ids3d: AnyArray | None = None  # indices of the 3D points in the whole problem, None if all points are here
    # Camera in whose pixels the problem is drawn, None for normalised coordinates; not stored on disk.
    camera: Camera | None = None
    normals3d: AnyArray | None = None  # outward normals (n, 3), None for points without normals; not stored on disk

    def numbers(self) -> tuple[AnyArray, AnyArray]:
        """Return `ids2d` and `ids3d`, counted where they are None."""
        count2d, count3d = np.arange(len(self.points2d)), np.arange(len(self.points3d))
        return count2d if self.ids2d is None else self.ids2d, count3d if self.ids3d is None else self.ids3d


def utf8(name: str) -> str:
    """Replace bytes of a problem's name that are not UTF-8 and appear as surrogates."""
    return name.encode("utf-8", "replace").decode()


def points_from(
    prediction: Prediction, batch: Batch, errors: Mapping[str, PoseErrors] | None = None
) -> list[ProblemPoints]:
    """Return the points of each problem, at most 100 on each side, evenly spaced, matched ones first.

    The batch may be without true poses. `errors` are those of `prediction_errors`, if computed before.
    """
    points2d, points3d, mask2d, mask3d = map(_host, (batch.points2d, batch.points3d, batch.mask2d, batch.mask3d))
    unknown = np.full(mask3d.shape, -1)
    match3d = unknown if batch.match3d is None else _host(batch.match3d)
    assignment = prediction.assignment if prediction.rematched is None else prediction.rematched
    assigned3d = unknown if assignment is None else _host(assignment.argmax(-2))
    poses = {name: (_host(pose.rotation), _host(pose.translation)) for name, pose in prediction.poses.items()}
    truth, rotation_errors = None, [180.0] * len(batch)
    if batch.rotation is not None and batch.translation is not None:
        truth = (_host(batch.rotation), _host(batch.translation))
        errors = prediction_errors(prediction, batch) if errors is None else errors
        for name in list(prediction.poses)[:1]:
            rotation_errors = errors[name].rotation_deg.tolist()
    problems = []
    for i in range(len(batch)):
        problem = ProblemPoints(
            index=int(batch.index[i]),
            id=batch.ids[i],
            points2d=points2d[i][mask2d[i]].astype(np.float32),
            points3d=points3d[i][mask3d[i]].astype(np.float32),
            match3d=match3d[i][mask3d[i]].astype(np.int32),
            assigned3d=assigned3d[i][mask3d[i]].astype(np.int32),
            pose=None if truth is None else (truth[0][i], truth[1][i]),
            estimates={name: (rotation[i], translation[i]) for name, (rotation, translation) in poses.items()},
            error=rotation_errors[i],
        )
        problems.append(thin(problem))
    return problems


def thin(problem: ProblemPoints, most: int = MOST) -> ProblemPoints:
    """Return the problem with at most `most` points on each side, evenly spaced, matched ones first."""
    count2d = len(problem.points2d)
    keep3d = _first_then_rest(problem.match3d >= 0, most)
    keep2d = _first_then_rest(np.isin(np.arange(count2d), problem.match3d[keep3d]), most)
    ids2d, ids3d = problem.numbers()
    return replace(
        problem,
        points2d=problem.points2d[keep2d],
        points3d=problem.points3d[keep3d],
        match3d=_renumber_targets(problem.match3d[keep3d], keep2d, count2d),
        assigned3d=_renumber_targets(problem.assigned3d[keep3d], keep2d, count2d),
        ids2d=ids2d[keep2d].astype(np.int32),
        ids3d=ids3d[keep3d].astype(np.int32),
    )


def write_points(folder: Path | str, problems: Iterable[ProblemPoints]) -> None:
    """Write `points.npz` atomically: columns with the points of all problems, one after the other.

    The problems have the same estimates. The first of several problems with one index is kept.
    """
    first: dict[int, ProblemPoints] = {}
    for problem in problems:
        first.setdefault(problem.index, problem)
    ordered = [first[index] for index in sorted(first)]
    names = list(ordered[0].estimates) if ordered else []
    if any(list(problem.estimates) != names for problem in ordered):
        raise ValueError(f"some problems have other estimates than {names}; use one folder for each solver")
    arrays = {
        "format": np.array(FORMAT),
        "ids": np.frombuffer(json.dumps([problem.id for problem in ordered]).encode(), np.uint8),
        "index": np.array([problem.index for problem in ordered], np.int64),
        "error": np.array([problem.error for problem in ordered], np.float64),
        "count2d": np.array([len(problem.points2d) for problem in ordered], np.int64),
        "count3d": np.array([len(problem.points3d) for problem in ordered], np.int64),
        "pose": _stack_poses([problem.pose for problem in ordered]),
    }
    for name, (kind, *width) in POINTS.items():
        parts = [problem.numbers()[name == "ids3d"] if name in IDS else getattr(problem, name) for problem in ordered]
        arrays[name] = np.concatenate([np.empty((0, *width), kind), *parts]).astype(kind)
    arrays |= {f"estimate.{name}": _stack_poses([problem.estimates[name] for problem in ordered]) for name in names}
    with write_atomically(Path(folder) / FILE) as temporary, temporary.open("wb") as file:
        np.savez(file, allow_pickle=False, **arrays)  # type: ignore[arg-type, unused-ignore]


def read_points(folder: Path | str) -> tuple[ProblemPoints, ...]:
    """Read the file of `write_points`.

    Args:
        folder: Results folder.

    Returns:
        The points of each problem; empty if the folder has no such file.

    Raises:
        ValueError: The file cannot be read.
    """
    path = Path(folder) / FILE
    if not path.is_file():
        return ()
    try:
        arrays = read_npz(path)
        version = int(arrays["format"])
        if version == FORMAT:
            return tuple(_unpack_problems(arrays))
    except Exception as error:  # noqa: BLE001 - zipfile, numpy and json have different errors
        raise ValueError(f"cannot read the points of a test in {path} ({error}); run `bpnp test` again") from error
    raise ValueError(f"{path} has format {version}, not {FORMAT}; use the version of bpnp that wrote it")


def _unpack_problems(arrays: dict[str, AnyArray]) -> Iterable[ProblemPoints]:
    ends = {side: arrays[f"count{side}"].cumsum()[:-1] for side in ("2d", "3d")}
    points: dict[str, Any] = {name: np.split(arrays[name], ends[name[-2:]]) for name in POINTS}
    prefix = "estimate."
    for i, name in enumerate(json.loads(arrays["ids"].tobytes())):
        truth = arrays["pose"][i]
        yield ProblemPoints(
            index=int(arrays["index"][i]),
            id=name,
            pose=_split(truth) if np.isfinite(truth).all() else None,
            estimates={key.removeprefix(prefix): _split(a[i]) for key, a in arrays.items() if key.startswith(prefix)},
            error=float(arrays["error"][i]),
            **{key: parts[i] for key, parts in points.items()},
        )


def _stack_poses(poses: Sequence[tuple[AnyArray, AnyArray] | None]) -> AnyArray:
    """Return [R | t] of each problem (k, 3, 4), NaN for none."""
    missing = np.full((3, 4), np.nan)
    return np.array([missing if pose is None else np.c_[pose] for pose in poses], np.float64).reshape(-1, 3, 4)


def _split(pose: AnyArray) -> tuple[AnyArray, AnyArray]:
    return pose[:, :3], pose[:, 3]


def _host(values: Tensor) -> AnyArray:
    return values.detach().cpu().numpy()


def _first_then_rest(first: AnyArray, most: int) -> AnyArray:
    """Return indices where `first` holds, then of the rest, each thinned evenly where there is no room; ascending."""
    head = _thin_rows(np.flatnonzero(first), most)
    return np.sort(np.r_[head, _thin_rows(np.flatnonzero(~first), most - len(head))]).astype(np.int64)


def _thin_rows(values: AnyArray, most: int) -> AnyArray:
    if len(values) <= most:
        return values
    return values[np.linspace(0, len(values) - 1, most).astype(np.int64)] if most else values[:0]


def _renumber_targets(targets: AnyArray, chosen: AnyArray, count: int) -> AnyArray:
    """Return the positions of `targets` in `chosen`, both indices of `count` points, or -1."""
    position = np.full(count + 1, -1, np.int32)  # the last entry is for targets of -1
    position[chosen] = np.arange(len(chosen))
    return position[targets]
