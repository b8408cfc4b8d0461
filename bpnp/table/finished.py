"""What is finished of a table: a file per method and pair, written whole, so that a kill loses no finished pair."""

import json
import math
import os
from collections.abc import Iterable, Sequence
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

from bpnp.files import written_whole
from bpnp.report.folder import write_results
from bpnp.report.results import PairRow, Results

IDENTITY = "method.json"


class Finished:
    """The finished pairs of one method on one data set, in a folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def claim(self, identity: dict[str, Any]) -> None:
        """Start or resume. Raises ValueError if the folder holds pairs of another method or of other data."""
        path = self.folder / IDENTITY
        identity = json.loads(json.dumps(identity, default=str))
        if path.is_file():
            kept = json.loads(path.read_text(encoding="utf-8"))
            differing = sorted(key for key in identity.keys() | kept.keys() if identity.get(key) != kept.get(key))
            if differing:
                raise ValueError(
                    f"expected {self.folder} of the same method and data, got other {', '.join(differing)}; "
                    "try another --output"
                )
            return
        _write(path, json.dumps(identity, indent=2) + "\n")

    def indices(self) -> set[int]:
        return {int(path.stem) for path in (self.folder / "pairs").glob("*.json")}

    def add(self, index: int, rows: Sequence[PairRow]) -> None:
        content = [{name: _plain(value) for name, value in asdict(row).items()} for row in rows]
        _write(self.folder / "pairs" / f"{index}.json", json.dumps(content) + "\n")

    def rows(self, indices: Iterable[int]) -> list[PairRow]:
        """The rows of these pairs, as far as they are finished."""
        found = []
        for index in indices:
            path = self.folder / "pairs" / f"{index}.json"
            if path.is_file():
                found += [_row(values) for values in json.loads(path.read_text(encoding="utf-8"))]
        return found

    def summarise(self, indices: Iterable[int]) -> Results:
        """Write `pairs.csv` and `summary.json` beside the pairs, for `bpnp report`."""
        return write_results(self.folder, self.rows(indices), settings={"method": str(self.folder.name)})


def _row(values: dict[str, Any]) -> PairRow:
    parse: dict[Any, Any] = {int: int, float: float, str: str, bool: bool}
    return PairRow(**{field.name: parse[field.type](values[field.name]) for field in fields(PairRow)})


def _plain(value: Any) -> Any:
    """Infinity and NaN as text, which JSON lacks."""
    return str(value) if isinstance(value, float) and not math.isfinite(value) else value


def _write(path: Path, text: str) -> None:
    with written_whole(path) as temporary, temporary.open("w", encoding="utf-8") as file:
        file.write(text)
        file.flush()
        os.fsync(file.fileno())
