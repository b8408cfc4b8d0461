"""What a test leaves in its folder: `pairs.csv`, one row per pair and estimate, and `summary.json`, their aggregates.

Angles in degrees, lengths in scene units, as in `bpnp.metrics`. Infinite and undefined numbers are "inf" and "nan" in
both files (strings in the JSON, which has no such numbers).
"""

import csv
import io
import json
import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import astuple, dataclass, fields
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import torch

from bpnp.files import written_whole
from bpnp.metrics import PoseErrors, RecallThresholds, quartiles, recalls

FORMAT = 1
PIPELINE = ("ransac", "pnp", "refined")  # estimates are listed in this order, others after them


@dataclass(frozen=True)
class PairRow:
    """One estimate of one pair.

    index, id: the pair in its data set. Errors: see `bpnp.metrics`. inliers: see `bpnp.report.rows`. m, n: 2D and 3D
    points. true_pairs: 3D points with a known match. iterations, residual, converged: the solver's `SolveStats`.
    found: whether there is a pose. seconds: share of the time that the pair's batch took.
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
    true_pairs: int
    iterations: int
    residual: float
    converged: bool
    found: bool
    seconds: float


@dataclass(frozen=True)
class Results:
    """The rows of a test and, by estimate, what `summarise` makes of them; `settings` is what the caller recorded."""

    rows: tuple[PairRow, ...]
    estimates: dict[str, dict[str, float]]
    correspondence_loss: float | None
    settings: dict[str, Any]
    bpnp_version: str
    written: str

    def errors(self, estimate: str) -> PoseErrors:
        """Errors of one estimate in the order of the rows."""
        return _errors(row for row in self.rows if row.estimate == estimate)


def summarise(rows: Sequence[PairRow], *, thresholds: RecallThresholds | None = None) -> dict[str, dict[str, float]]:
    """By estimate: `quartiles` and `recalls` of its rows, the share that converged and the mean seconds per pair."""
    summary = {}
    for estimate in sorted({row.estimate for row in rows}, key=_pipeline_order):
        chosen = [row for row in rows if row.estimate == estimate]
        errors = _errors(chosen)
        values = {key: float(value) for key, value in (quartiles(errors) | recalls(errors, thresholds)).items()}
        values["converged"] = sum(row.converged for row in chosen) / len(chosen)
        values["seconds_mean"] = math.fsum(row.seconds for row in chosen) / len(chosen)
        summary[estimate] = values
    return summary


def write_results(
    folder: Path | str,
    rows: Iterable[PairRow],
    *,
    correspondence_loss: float | None = None,
    settings: Mapping[str, Any] | None = None,
    thresholds: RecallThresholds | None = None,
) -> Results:
    """Write `pairs.csv` and `summary.json`, each whole or not at all, and return what was written.

    A pair that several processes tested is written once, its first row; rows are sorted by index, so that the files do
    not depend on the order of batches or processes. `settings` (the command, the configuration) are kept as given; what
    JSON cannot hold becomes text. Raises ValueError if there is no row, if an estimate is missing for some pair, or if
    one index has two ids, as when two data sets are mixed.
    """
    ordered = _ordered(rows)
    results = Results(
        rows=ordered,
        estimates=summarise(ordered, thresholds=thresholds),
        correspondence_loss=correspondence_loss,
        settings=_plain(dict(settings or {})),
        bpnp_version=_version(),
        written=datetime.now(UTC).isoformat(timespec="seconds"),
    )
    summary = {
        "format": FORMAT,
        "bpnp_version": results.bpnp_version,
        "written": results.written,
        "pairs": len({row.index for row in ordered}),
        "estimates": results.estimates,
        "correspondence_loss": correspondence_loss,
        "settings": results.settings,
    }
    table = io.StringIO(newline="")
    writer = csv.writer(table)
    writer.writerow(field.name for field in fields(PairRow))
    writer.writerows(astuple(row) for row in ordered)
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    # Old aggregates must not stand beside new rows, should the process end between the two files.
    (folder / "summary.json").unlink(missing_ok=True)
    _write(folder / "pairs.csv", table.getvalue())
    _write(folder / "summary.json", json.dumps(_plain(summary), indent=2, allow_nan=False) + "\n")
    return results


def read_results(folder: Path | str) -> Results:
    """Read what `write_results` wrote. Raises ValueError that names the file: missing, of another format, incomplete,
    or with a value that is no number."""
    path = Path(folder) / "summary.json"
    try:
        summary = json.loads(_read(path))
    except json.JSONDecodeError as error:
        raise ValueError(f"expected JSON in {path}, got {error}") from error
    found = summary.get("format") if isinstance(summary, dict) else None
    if found != FORMAT:
        raise ValueError(f"expected results of format {FORMAT} in {path}, got {found!r}; try the bpnp that wrote them")
    rows = _read_rows(Path(folder) / "pairs.csv")
    try:
        loss, pairs = summary["correspondence_loss"], summary["pairs"]
        results = Results(
            rows=rows,
            estimates={name: {k: float(v) for k, v in values.items()} for name, values in summary["estimates"].items()},
            correspondence_loss=None if loss is None else float(loss),
            settings=summary["settings"],
            bpnp_version=summary["bpnp_version"],
            written=summary["written"],
        )
    except (KeyError, TypeError, AttributeError, ValueError) as error:
        raise ValueError(f"expected what `bpnp test` writes in {path}, got {type(error).__name__}: {error}") from error
    if len(rows) != pairs * len(results.estimates):
        raise ValueError(
            f"expected {pairs} x {len(results.estimates)} rows in pairs.csv, as {path} says, got {len(rows)}"
        )
    return results


def _read_rows(path: Path) -> tuple[PairRow, ...]:
    parse: dict[Any, Any] = {int: int, float: float, str: str, bool: {"True": True, "False": False}.__getitem__}
    reader = csv.reader(io.StringIO(_read(path), newline=""))
    header = next(reader, [])
    missing = [field.name for field in fields(PairRow) if field.name not in header]
    if missing:
        raise ValueError(f"expected column {missing[0]!r} in {path}, got {header}")
    rows = []
    for cells in reader:
        if len(cells) != len(header):
            raise ValueError(f"expected {len(header)} columns in {path}, line {reader.line_num}, got {len(cells)}")
        row = dict(zip(header, cells, strict=True))
        try:
            rows.append(PairRow(**{field.name: parse[field.type](row[field.name]) for field in fields(PairRow)}))
        except (ValueError, KeyError) as error:
            raise ValueError(f"expected numbers in {path}, line {reader.line_num}, got {error}") from error
    if not rows:
        raise ValueError(f"expected at least one row in {path}, got none")
    return tuple(rows)


def _ordered(rows: Iterable[PairRow]) -> tuple[PairRow, ...]:
    ids: dict[int, str] = {}
    first: dict[tuple[int, str], PairRow] = {}
    for row in rows:
        if ids.setdefault(row.index, row.id) != row.id:
            raise ValueError(
                f"expected one id for index {row.index}, got {ids[row.index]!r}, {row.id!r}; try a folder per data set"
            )
        first.setdefault((row.index, row.estimate), row)
    counts = Counter(row.estimate for row in first.values())
    if not counts:
        raise ValueError("expected at least one row, got none; try a test set with a pair in it")
    if len(first) != len(ids) * len(counts):
        raise ValueError(f"expected each estimate for all {len(ids)} pairs, got {dict(counts)}")
    return tuple(sorted(first.values(), key=lambda row: (row.index, _pipeline_order(row.estimate))))


def _pipeline_order(estimate: str) -> tuple[int, str]:
    return PIPELINE.index(estimate) if estimate in PIPELINE else len(PIPELINE), estimate


def _errors(rows: Iterable[PairRow]) -> PoseErrors:
    columns = [
        (row.rotation_error_deg, row.translation_error, row.centre_error, row.reprojection_error_deg) for row in rows
    ]
    return PoseErrors(*torch.tensor(columns, dtype=torch.float64).reshape(-1, 4).unbind(-1))


def _plain(value: Any) -> Any:
    """The same in the types of strict JSON."""
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if value is None or isinstance(value, (bool, int, str)) or (isinstance(value, float) and math.isfinite(value)):
        return value
    return str(value)


def _version() -> str:
    try:
        return version("bpnp")
    except PackageNotFoundError:  # run from its source
        return "unknown"


def _write(path: Path, text: str) -> None:
    with written_whole(path) as temporary:
        # File names that are not UTF-8 reach us, and leave, as surrogates.
        temporary.write_text(text, encoding="utf-8", errors="surrogateescape", newline="")


def _read(path: Path) -> str:
    if not path.is_file():
        raise ValueError(f"expected a results folder with {path.name}, got no {path}; try `bpnp test` first")
    with path.open(encoding="utf-8", errors="surrogateescape", newline="") as file:
        return file.read()
