"""The folder of a test: `pairs.csv`, one row per pair and estimate, and `summary.json`, their aggregates.

Infinite and undefined numbers are "inf" and "nan" in both files (strings in the JSON, which has no such numbers).
A test under way appends its finished rows to `unfinished.csv`, from which it can go on after an interruption.
"""

import csv
import fcntl
import io
import json
import math
import os
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import astuple, fields
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from bpnp import __version__
from bpnp.files import named, written_whole
from bpnp.metrics import RecallThresholds
from bpnp.report.results import PairRow, Results, pipeline_order, summarise

FORMAT = 1
UNFINISHED = "unfinished.csv"
PARSE: dict[Any, Any] = {int: int, float: float, str: str, bool: {"True": True, "False": False}.__getitem__}
COLUMNS = {field.name: PARSE[field.type] for field in fields(PairRow)}  # and what reads their texts


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
        settings=plain(dict(settings or {})),
        bpnp_version=__version__,
        written=datetime.now(UTC).isoformat(timespec="seconds"),
    )
    summary = {
        "format": FORMAT,
        "bpnp_version": results.bpnp_version,
        "written": results.written,
        "pairs": results.pairs,
        "estimates": results.estimates,
        "correspondence_loss": correspondence_loss,
        "settings": results.settings,
    }
    folder = Path(folder)
    # Old aggregates must not stand beside new rows, should the process end between the two files.
    (folder / "summary.json").unlink(missing_ok=True)
    for name, content in (
        ("pairs.csv", _encoded([COLUMNS, *map(astuple, ordered)])),
        ("summary.json", json.dumps(plain(summary), indent=2, allow_nan=False).encode() + b"\n"),
    ):
        with written_whole(folder / name) as temporary:
            temporary.write_bytes(content)
    (folder / UNFINISHED).unlink(missing_ok=True)
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
    rows = _rows(Path(folder) / "pairs.csv")
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


def append_rows(folder: Path, rows: Iterable[PairRow]) -> None:
    """Add the rows of finished pairs to `unfinished.csv` and wait until they are on the disk.

    Several processes may add to one folder. A last line that was cut short is removed first.
    """
    path = folder / UNFINISHED
    folder.mkdir(parents=True, exist_ok=True)
    with named(path), path.open("ab") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        if file.tell() and not path.read_bytes().endswith(b"\n"):
            file.truncate(len(_encoded([COLUMNS, *map(astuple, _rows(path, cut=True))])))
        file.write(_encoded([*([] if path.stat().st_size else [COLUMNS]), *map(astuple, rows)]))
        file.flush()
        os.fsync(file.fileno())


def finished_rows(folder: Path) -> list[PairRow]:
    """The rows of finished pairs in a folder: of `pairs.csv`, and of a test that was interrupted.

    A last line that was cut short by a kill or a full disk is left out.
    """
    known = [path for path in (folder / "pairs.csv", folder / UNFINISHED) if path.is_file()]
    return [row for path in known for row in _rows(path, cut=path.name == UNFINISHED)]


def plain(value: Any) -> Any:
    """The same in the types of strict JSON."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if value is None or isinstance(value, (bool, int, str)) or (isinstance(value, float) and math.isfinite(value)):
        return value
    return str(value)


def _rows(path: Path, *, cut: bool = False) -> tuple[PairRow, ...]:
    text = _read(path)
    reader = csv.reader(io.StringIO(text, newline=""))
    header = next(reader, [])
    missing = [name for name in COLUMNS if name not in header]
    if missing:
        raise ValueError(f"expected column {missing[0]!r} in {path}, got {header}")
    lines = [(reader.line_num, cells) for cells in reader]
    if cut and lines and not text.endswith("\n"):
        lines.pop()
    rows = []
    for number, cells in lines:
        if len(cells) != len(header):
            raise ValueError(f"expected {len(header)} columns in {path}, line {number}, got {len(cells)}")
        row = dict(zip(header, cells, strict=True))
        try:
            rows.append(PairRow(**{name: parse(row[name]) for name, parse in COLUMNS.items()}))
        except (ValueError, KeyError) as error:
            raise ValueError(f"expected numbers in {path}, line {number}, got {error}") from error
    if not rows and not cut:
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
    return tuple(sorted(first.values(), key=lambda row: (row.index, pipeline_order(row.estimate))))


def _encoded(rows: Iterable[Iterable[Any]]) -> bytes:
    """Rows as CSV. File names that are not UTF-8 reach us, and leave, as surrogates."""
    text = io.StringIO(newline="")
    csv.writer(text).writerows(rows)
    return text.getvalue().encode(errors="surrogateescape")


def _read(path: Path) -> str:
    if not path.is_file():
        raise ValueError(f"expected a results folder with {path.name}, got no {path}; try `bpnp test` first")
    with path.open(encoding="utf-8", errors="surrogateescape", newline="") as file:
        return file.read()
