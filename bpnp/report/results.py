"""What a test found, in memory and in its folder: a row per problem and estimate, and the aggregates of the rows.

`problems.csv` has the rows, `summary.json` the aggregates. Angles in degrees, lengths in scene units, as in
`bpnp.metrics`. Infinite and undefined numbers are "inf" and "nan" in both files (strings in the JSON, which has no such
numbers).
"""

import json
import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, astuple, dataclass, fields
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from scipy.spatial import cKDTree

from bpnp import __version__
from bpnp.files import write_atomically, write_text
from bpnp.geometry import project, transform
from bpnp.metrics import PoseErrors, pose_quartiles, pose_recalls, prediction_errors
from bpnp.types import Batch, Pose, Prediction

if TYPE_CHECKING:
    from pandas import DataFrame

FORMAT = 2  # 1 had pairs.csv
ROWS, SUMMARY = "problems.csv", "summary.json"
PIPELINE = ("ransac", "pnp", "refined")  # estimates are listed in this order, others after them
SOLVED_DEG = 5.0  # largest rotation error of a solved problem
INLIER_THRESHOLD = 0.01  # largest distance of an inlier, normalised image units
PLAUSIBLE_INLIERS = 0.5  # share of the 2D points from which a wrong pose counts as fitting the image
CAUSES = ("solved", "no pose", "wrong, not converged", "wrong, but fits the image", "wrong")


@dataclass(frozen=True)
class ProblemRow:
    """One estimate of one problem.

    index, id: the problem in its data set. Errors: see `bpnp.metrics`. inliers: see `count_inliers`. m, n: 2D and 3D
    points. matches: 3D points with a known match. iterations, residual, converged: the solver's `SolveStats`. found:
    whether there is a pose. seconds: share of the time until the estimates of the problem's batch were found.
    """

    index: int
    id: str
    estimate: str
    rotation_error_deg: float
    translation_error: float
    centre_error: float
    reprojection_error_deg: float
    inliers: int
    m: int
    n: int
    matches: int
    iterations: int
    residual: float
    converged: bool
    found: bool
    seconds: float

    @property
    def cause(self) -> str:
        """One of `CAUSES`: the first of these that holds.

        - "no pose": the solver gave none;
        - "solved": rotation error up to `SOLVED_DEG` degrees, whether the solver reports convergence or not;
        - "wrong, not converged": the solver itself reports that it did not converge;
        - "wrong, but fits the image": `PLAUSIBLE_INLIERS` of the 2D points have a reprojected 3D point beside them:
          another minimum, or a symmetric scene, that the solver cannot tell from the true pose;
        - "wrong": none of these.
        """
        if not self.found:
            return "no pose"
        if self.rotation_error_deg <= SOLVED_DEG:
            return "solved"
        if not self.converged:
            return "wrong, not converged"
        return "wrong, but fits the image" if self.inliers >= PLAUSIBLE_INLIERS * self.m else "wrong"


TYPES: dict[Any, Any] = {int: int, float: float, str: str, bool: {"True": True, "False": False}.__getitem__}
PARSE = {field.name: TYPES[field.type] for field in fields(ProblemRow)}


@dataclass(frozen=True)
class Results:
    """The rows of a test and, by estimate, what `summarise` makes of them; `settings` is what the caller recorded."""

    rows: tuple[ProblemRow, ...]
    estimates: dict[str, dict[str, float]]
    correspondence_loss: float | None
    settings: dict[str, Any]
    bpnp_version: str
    written: str

    def of(self, estimate: str) -> list[ProblemRow]:
        """The rows of one estimate, in the order of the data set."""
        return [row for row in self.rows if row.estimate == estimate]

    def errors(self, estimate: str) -> PoseErrors:
        """Errors of one estimate in the order of the rows."""
        return _errors(self.of(estimate))

    @property
    def problems(self) -> int:
        """Number of problems."""
        return len({row.index for row in self.rows})

    def frame(self) -> "DataFrame":
        """The rows as a DataFrame for notebooks: the columns of `ProblemRow`, and "cause".

        `read_results("runs/quickstart/test").frame().groupby("estimate").rotation_error_deg.median()`
        """
        from pandas import DataFrame

        return DataFrame([asdict(row) | {"cause": row.cause} for row in self.rows])


def rows_from(
    prediction: Prediction, batch: Batch, seconds: float, errors: Mapping[str, PoseErrors] | None = None
) -> list[ProblemRow]:
    """Return one row per problem and estimate.

    Args:
        prediction: of the batch. Where it has the seconds until an estimate was found, these count.
        batch: problems with their true poses.
        seconds: time of the whole batch. Each problem has an equal share.
        errors: `prediction_errors`, if they are known.

    Raises:
        ValueError: The batch has no true pose.
    """
    matches = torch.zeros_like(batch.index) if batch.match3d is None else (batch.match3d >= 0).sum(-1)
    sizes = torch.stack([batch.count2d, batch.count3d, matches], -1).tolist()
    indices = batch.index.tolist()
    errors = prediction_errors(prediction, batch) if errors is None else errors
    rows = []
    for estimate, pose in prediction.poses.items():
        known, stats = errors[estimate], pose.stats
        columns = (known.rotation_deg, known.translation, known.centre, known.reprojection_deg)
        figures, inliers = torch.stack(columns, -1).tolist(), count_inliers(pose, batch)
        told = (stats.iterations, stats.residual.double(), stats.converged, pose.found)
        states = zip(*(values.tolist() for values in told), strict=True)
        share = prediction.seconds.get(estimate, seconds) / len(batch)
        for i, state in enumerate(states):
            values: Any = (indices[i], batch.ids[i], estimate, *figures[i], inliers[i], *sizes[i], *state, share)
            rows.append(ProblemRow(*values))
    return rows


def count_inliers(pose: Pose, batch: Batch, *, threshold: float = INLIER_THRESHOLD) -> list[int]:
    """2D points of each problem with a projected 3D point nearer than `threshold` (normalised image units).

    Needs no true match: it is what a user of the pose can check. Points behind the camera do not count; without a pose
    there is no inlier.
    """
    camera = transform(pose.rotation.double(), pose.translation.double(), batch.points3d.double())
    projected = project(camera)
    visible = batch.mask3d & (camera[..., 2] > 0) & projected.isfinite().all(-1)
    counts = []
    for i in range(len(batch)):
        shown, seen = projected[i, visible[i]].cpu().numpy(), batch.points2d[i, batch.mask2d[i]].cpu().numpy()
        # An empty tree answers infinity.
        distance, _ = cKDTree(shown).query(seen, distance_upper_bound=threshold)
        counts.append(int((distance < math.inf).sum()))
    return counts


def cause_shares(rows: Iterable[ProblemRow]) -> dict[str, float]:
    """Share of the rows with each cause, in the order of `CAUSES`; they sum to one.

    Raises ValueError if there is no row.
    """
    causes = [row.cause for row in rows]
    if not causes:
        raise ValueError("expected at least one row, got none")
    return {cause: causes.count(cause) / len(causes) for cause in CAUSES}


def summarise(rows: Sequence[ProblemRow]) -> dict[str, dict[str, float]]:
    """By estimate: quartiles and recalls of its rows, the share that converged and the mean seconds per problem."""
    summary = {}
    for estimate in sorted({row.estimate for row in rows}, key=pipeline_order):
        chosen = [row for row in rows if row.estimate == estimate]
        errors = _errors(chosen)
        figures = pose_quartiles(errors) | pose_recalls(errors)
        values = {key: float(value) for key, value in figures.items()}
        values["converged"] = sum(row.converged for row in chosen) / len(chosen)
        values["seconds_mean"] = math.fsum(row.seconds for row in chosen) / len(chosen)
        summary[estimate] = values
    return summary


def pipeline_order(estimate: str) -> tuple[int, str]:
    """Sorts estimates by the step of the pipeline that makes them."""
    return PIPELINE.index(estimate) if estimate in PIPELINE else len(PIPELINE), estimate


def write_results(
    folder: Path | str,
    rows: Iterable[ProblemRow],
    *,
    correspondence_loss: float | None = None,
    settings: Mapping[str, Any] | None = None,
) -> Results:
    """Write `problems.csv` and `summary.json`, each whole or not at all, and return what was written.

    A problem that several processes tested is written once, its first row; rows are sorted by index, so that the files
    do not depend on the order of batches or processes. `settings` (the command, the configuration) are kept as they
    are; what JSON cannot hold becomes text. Raises ValueError if there is no row, if an estimate is missing for some
    problem, or if one index has two ids, as when two data sets are mixed.
    """
    from pandas import DataFrame

    ordered = _sort_rows(rows)
    written = datetime.now(UTC).isoformat(timespec="seconds")
    results = Results(
        ordered, summarise(ordered), correspondence_loss, plain(dict(settings or {})), __version__, written
    )
    summary = {"format": FORMAT, "problems": results.problems} | vars(results)
    del summary["rows"]
    frame = DataFrame(map(astuple, ordered), columns=list(PARSE), dtype=object)
    folder = Path(folder)
    # Old aggregates must not stand beside new rows, should the process end between the two files.
    (folder / SUMMARY).unlink(missing_ok=True)
    with write_atomically(folder / ROWS) as temporary:
        # File names that are not UTF-8 reach us, and leave, as surrogates.
        frame.to_csv(temporary, index=False, na_rep="nan", lineterminator="\r\n", errors="surrogateescape")
    write_text(folder / SUMMARY, json.dumps(plain(summary), indent=2, allow_nan=False) + "\n")
    return results


def read_results(folder: Path | str) -> Results:
    """Read what `write_results` wrote. Raises ValueError that names the file: missing, of another format, incomplete,
    or with a value that is no number."""
    path, table = Path(folder) / SUMMARY, Path(folder) / ROWS
    for file in (path, table):
        if not file.is_file():
            raise ValueError(f"expected a results folder with {file.name}, got no {file}; try `bpnp test` first")
    rows = _read_rows(table)
    try:
        summary = dict(json.loads(path.read_bytes()))
        if (version := summary.pop("format", None)) != FORMAT:
            raise ValueError(f"format {version!r} in place of {FORMAT}; try `bpnp test` again")
        count, loss = summary.pop("problems"), summary.pop("correspondence_loss")
        estimates = {
            name: {k: float(v) for k, v in values.items()} for name, values in summary.pop("estimates").items()
        }
        results = Results(rows, estimates, None if loss is None else float(loss), **summary)
    except (KeyError, TypeError, AttributeError, ValueError) as error:
        raise ValueError(f"expected what `bpnp test` writes in {path}, got {type(error).__name__}: {error}") from error
    if len(rows) != count * len(estimates):
        raise ValueError(f"expected {count} x {len(estimates)} rows in {ROWS}, as {path} says, got {len(rows)}")
    return results


def plain(value: Any) -> Any:
    """The same in the types of strict JSON."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if value is None or isinstance(value, (bool, int, str)) or (isinstance(value, float) and math.isfinite(value)):
        return value
    return str(value)


def _read_rows(path: Path) -> tuple[ProblemRow, ...]:
    from pandas import read_csv

    try:
        frame = read_csv(path, dtype=object, keep_default_na=False, encoding_errors="surrogateescape", index_col=False)
        columns = [[parse(text) for text in frame[name]] for name, parse in PARSE.items()]
    except (ValueError, KeyError) as error:
        raise ValueError(f"expected the rows of a test in {path}, got {error}") from error
    if frame.empty:
        raise ValueError(f"expected at least one row in {path}, got none")
    return tuple(ProblemRow(*values) for values in zip(*columns, strict=True))


def _sort_rows(rows: Iterable[ProblemRow]) -> tuple[ProblemRow, ...]:
    """The first row of each problem and estimate, sorted."""
    problems: dict[int, tuple[str, int, int]] = {}
    first: dict[tuple[int, str], ProblemRow] = {}
    for row in rows:
        described = row.id, row.m, row.n
        if (other := problems.setdefault(row.index, described)) != described:
            raise ValueError(
                f"expected one number in `Batch.index` for each problem, got {row.index} for {other} and {described} "
                "(id, 2D and 3D points); try Batch.from_arrays(..., index=...), and a folder for each data set"
            )
        first.setdefault((row.index, row.estimate), row)
    counts = Counter(row.estimate for row in first.values())
    if not counts:
        raise ValueError("expected at least one row, got none; try a test set with a problem in it")
    if len(first) != len(problems) * len(counts):
        raise ValueError(f"expected each estimate for all {len(problems)} problems, got {dict(counts)}")
    return tuple(sorted(first.values(), key=lambda row: (row.index, pipeline_order(row.estimate))))


def _errors(rows: Iterable[ProblemRow]) -> PoseErrors:
    columns = [
        (row.rotation_error_deg, row.translation_error, row.centre_error, row.reprojection_error_deg) for row in rows
    ]
    return PoseErrors(*torch.tensor(columns, dtype=torch.float64).reshape(-1, 4).unbind(-1))
