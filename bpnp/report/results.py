"""Results of a test, in memory and in its folder: a row per problem and estimate, and their aggregates.

`problems.csv` has the rows, `summary.json` the aggregates. Angles are in degrees, lengths in scene units, as in
`bpnp.metrics`. Infinite and undefined numbers are "inf" and "nan" in both files (as strings in the JSON, which has no
such numbers).
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
from bpnp.bounded_files import read_json
from bpnp.files import write_atomically, write_text
from bpnp.geometry import project, transform
from bpnp.metrics import PoseErrors, pose_quartiles, pose_recalls, prediction_errors
from bpnp.types import Batch, Pose, Prediction

if TYPE_CHECKING:
    from pandas import DataFrame

FORMAT = 2  # format 1 had pairs.csv
ROWS, SUMMARY = "problems.csv", "summary.json"
PIPELINE = ("ransac", "pnp", "refined")  # order of the estimates; others follow
SOLVED_DEG = 5.0  # largest rotation error of a solved problem
INLIER_THRESHOLD = 0.01  # largest distance of an inlier, normalised image units
PLAUSIBLE_INLIERS = 0.5  # least fraction of inlier 2D points of a wrong pose that fits the image
CAUSES = ("solved", "no pose", "wrong, not converged", "wrong, but fits the image", "wrong")


@dataclass(frozen=True)
class ProblemRow:
    """One estimate of one problem.

    Attributes:
        index: Index of the problem in its data set.
        id: Name of the problem.
        estimate: Name of the estimate.
        rotation_error_deg: See `bpnp.metrics`, as the other errors.
        translation_error: Scene units.
        centre_error: Scene units.
        reprojection_error_deg: Degrees.
        inliers: See `count_inliers`.
        m: Number of 2D points.
        n: Number of 3D points.
        matches: Number of 3D points with a true match.
        iterations: Number of iterations of the solver, see `SolveStats`.
        residual: Residual of the solver, see `SolveStats`.
        converged: True if the solver converged.
        found: True if there is a pose.
        seconds: Time until the estimates of the problem's batch were found, divided by the number of its problems.
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
        """Outcome, the first of `CAUSES` that holds.

        - "no pose": the solver returned none;
        - "solved": rotation error up to 5 degrees, whether the solver converged or not;
        - "wrong, not converged": the solver did not converge;
        - "wrong, but fits the image": at least half of the 2D points are inliers (`count_inliers`): another minimum, or
          a symmetric scene, whose image does not differ from that of the true pose;
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
    """Results of a test.

    Attributes:
        rows: Rows of all problems and estimates.
        estimates: Result of `summarise`, by estimate.
        correspondence_loss: Mean of L_c (paper Eq. 11), None if unknown.
        settings: Settings recorded by the caller.
        bpnp_version: Version that wrote the results.
        written: Time, ISO 8601.
    """

    rows: tuple[ProblemRow, ...]
    estimates: dict[str, dict[str, float]]
    correspondence_loss: float | None
    settings: dict[str, Any]
    bpnp_version: str
    written: str

    def of(self, estimate: str) -> list[ProblemRow]:
        """Return the rows of one estimate, in the order of the data set.

        Args:
            estimate: Name of the estimate, such as "pnp"; an unknown name has no rows.
        """
        return [row for row in self.rows if row.estimate == estimate]

    def errors(self, estimate: str) -> PoseErrors:
        """Return the errors of one estimate, in the order of its rows.

        Args:
            estimate: Name of the estimate, such as "pnp".
        """
        return _errors(self.of(estimate))

    @property
    def problems(self) -> int:
        """Number of problems."""
        return len({row.index for row in self.rows})

    def frame(self) -> "DataFrame":
        """Return the rows as a DataFrame with the columns of `ProblemRow`, and "cause".

        `read_results("runs/quickstart/test").frame().groupby("estimate").rotation_error_deg.median()`
        """
        from pandas import DataFrame

        return DataFrame([asdict(row) | {"cause": row.cause} for row in self.rows])


def rows_from(
    prediction: Prediction, batch: Batch, seconds: float, errors: Mapping[str, PoseErrors] | None = None
) -> list[ProblemRow]:
    """Return one row per problem and estimate of a batch with true poses.

    `seconds` of the whole batch are divided equally among its problems, unless the prediction has its own for an
    estimate. `errors` are those of `prediction_errors`, if computed before.
    """
    matches = torch.zeros_like(batch.index) if batch.match3d is None else (batch.match3d >= 0).sum(-1)
    sizes = torch.stack([batch.count2d, batch.count3d, matches], -1).tolist()
    indices = batch.index.tolist()
    errors = prediction_errors(prediction, batch) if errors is None else errors
    rows = []
    for estimate, pose in prediction.poses.items():
        error, stats = errors[estimate], pose.stats
        columns = (error.rotation_deg, error.translation, error.centre, error.reprojection_deg)
        figures, inliers = torch.stack(columns, -1).tolist(), count_inliers(pose, batch)
        state_columns = (stats.iterations, stats.residual.double(), stats.converged, pose.found)
        states = zip(*(values.tolist() for values in state_columns), strict=True)
        each = prediction.seconds.get(estimate, seconds) / len(batch)
        for i, state in enumerate(states):
            values: Any = (indices[i], batch.ids[i], estimate, *figures[i], inliers[i], *sizes[i], *state, each)
            rows.append(ProblemRow(*values))
    return rows


def count_inliers(pose: Pose, batch: Batch, *, threshold: float = INLIER_THRESHOLD) -> list[int]:
    """Count the 2D points of each problem with a projected 3D point nearer than `threshold`, in normalised image units.

    No true match is needed, so a user of the pose can compute it. Points behind the camera do not count; there are no
    inliers without a pose.
    """
    rotation, translation = pose.rotation.detach().double(), pose.translation.detach().double()
    camera = transform(rotation, translation, batch.points3d.double())
    projected = project(camera)
    visible = batch.mask3d & (camera[..., 2] > 0) & projected.isfinite().all(-1)
    counts = []
    for i in range(len(batch)):
        targets, image = projected[i, visible[i]].cpu().numpy(), batch.points2d[i, batch.mask2d[i]].cpu().numpy()
        # An empty tree returns infinity.
        distance, _ = cKDTree(targets).query(image, distance_upper_bound=threshold)
        counts.append(int((distance < math.inf).sum()))
    return counts


def cause_fractions(rows: Iterable[ProblemRow]) -> dict[str, float]:
    """Return the fraction of the rows with each cause, in the order of `CAUSES`; they sum to one."""
    causes = [row.cause for row in rows]
    if not causes:
        raise ValueError("there are no rows to count causes of")
    return {cause: causes.count(cause) / len(causes) for cause in CAUSES}


def summarise(rows: Sequence[ProblemRow]) -> dict[str, dict[str, float]]:
    """Return quartiles, recalls, the fraction that converged and the mean seconds per problem, by estimate."""
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
    """Return the sort key of an estimate: its step of the pipeline, then its name."""
    return PIPELINE.index(estimate) if estimate in PIPELINE else len(PIPELINE), estimate


def write_results(
    folder: Path | str,
    rows: Iterable[ProblemRow],
    *,
    correspondence_loss: float | None = None,
    settings: Mapping[str, Any] | None = None,
) -> Results:
    """Write `problems.csv` and `summary.json` atomically.

    A problem that several processes tested is written once, its first row. Rows are sorted by index, so that the files
    do not depend on the order of batches or processes.

    Args:
        folder: Results folder.
        rows: Rows.
        correspondence_loss: Mean of L_c; None if it is unknown.
        settings: Settings to record (the command, the configuration); values that JSON cannot hold become text. None
            for no settings.

    Returns:
        The results.

    Raises:
        ValueError: There is no row, an estimate is missing for a problem, or one index has two ids, as when two data
            sets are mixed.
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
    # Remove the old aggregates first, in case the process ends between the two files.
    (folder / SUMMARY).unlink(missing_ok=True)
    with write_atomically(folder / ROWS) as temporary:
        # File names that are not UTF-8 are read and written as surrogates.
        frame.to_csv(temporary, index=False, na_rep="nan", lineterminator="\r\n", errors="surrogateescape")
    write_text(folder / SUMMARY, json.dumps(plain(summary), indent=2, allow_nan=False) + "\n")
    return results


def read_results(folder: Path | str) -> Results:
    """Read the files of `write_results`.

    Args:
        folder: Results folder.

    Returns:
        The results. Their rows are sorted, since another program may have changed the order in the file.

    Raises:
        ValueError: A file is missing, of another format, incomplete, or has a value that is no number. The message
            names it.
    """
    path, table = Path(folder) / SUMMARY, Path(folder) / ROWS
    for file in (path, table):
        if not file.is_file():
            raise ValueError(f"{folder} is no results folder: it has no {file.name}; run `bpnp test` first")
    rows = _read_rows(table)
    try:
        summary = dict(read_json(path))
        if (version := summary.pop("format", None)) != FORMAT:
            raise ValueError(f"format {version!r} in place of {FORMAT}; run `bpnp test` again")
        count, loss = summary.pop("problems"), summary.pop("correspondence_loss")
        estimates = {
            name: {k: float(v) for k, v in values.items()} for name, values in summary.pop("estimates").items()
        }
        results = Results(rows, estimates, None if loss is None else float(loss), **summary)
    except (KeyError, TypeError, AttributeError, ValueError) as error:
        raise ValueError(f"{path} is no summary of `bpnp test`: {type(error).__name__}: {error}") from error
    if len(rows) != count * len(estimates):
        raise ValueError(f"{table} has {len(rows)} rows, but {path} counts {count} x {len(estimates)}")
    return results


def plain(value: Any) -> Any:
    """Convert a value to the types of strict JSON; others become text."""
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
        raise ValueError(f"cannot read the rows of a test in {path}: {error}") from error
    if frame.empty:
        raise ValueError(f"{path} has no rows")
    rows = (ProblemRow(*values) for values in zip(*columns, strict=True))
    return tuple(sorted(rows, key=_sort_key))


def _sort_rows(rows: Iterable[ProblemRow]) -> tuple[ProblemRow, ...]:
    """Return the first row of each problem and estimate, sorted."""
    problems: dict[int, tuple[str, int, int]] = {}
    first: dict[tuple[int, str], ProblemRow] = {}
    for row in rows:
        problem = row.id, row.m, row.n
        if (other := problems.setdefault(row.index, problem)) != problem:
            raise ValueError(
                f"`Batch.index` {row.index} is used for two problems, {other} and {problem} (id, 2D and 3D points); "
                "use Batch.from_arrays(..., index=...), and a folder for each data set"
            )
        first.setdefault((row.index, row.estimate), row)
    counts = Counter(row.estimate for row in first.values())
    if not counts:
        raise ValueError("there are no rows to write; the test set needs at least one problem")
    if len(first) != len(problems) * len(counts):
        raise ValueError(f"an estimate is missing for some of the {len(problems)} problems: {dict(counts)}")
    return tuple(sorted(first.values(), key=_sort_key))


def _sort_key(row: ProblemRow) -> tuple[int, tuple[int, str]]:
    return row.index, pipeline_order(row.estimate)


def _errors(rows: Iterable[ProblemRow]) -> PoseErrors:
    columns = [
        (row.rotation_error_deg, row.translation_error, row.centre_error, row.reprojection_error_deg) for row in rows
    ]
    return PoseErrors(*torch.tensor(columns, dtype=torch.float64).reshape(-1, 4).unbind(-1))
