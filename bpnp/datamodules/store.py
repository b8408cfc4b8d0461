"""The data store: a folder of .npy columns, memory-mapped, and a manifest. It is complete or not there at all.

A row is one pair of point sets or one mesh. Its points lie in the bulk columns, one row after the other, with a
checksum for each row that is compared whenever the row is read; `<bulk>_start.npy` says where the rows begin. All
other columns have one entry a row and are compared with the manifest's checksums when the store is opened.
"""

import json
import os
from collections import defaultdict
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from bpnp.files import checksum, written_whole

MANIFEST = "manifest.json"
FORMAT = 3  # raised whenever a column changes its meaning
BULK = np.dtype("<f4")


class StoreError(ValueError):
    """A store that cannot be used or made; the message names its folder."""


def is_store(folder: str | Path) -> bool:
    """Whether there is a manifest of a store in this folder."""
    return (Path(folder) / MANIFEST).is_file()


@dataclass(frozen=True)
class Store:
    """An open store, see `open_store`.

    bulk: the columns of points (total, width), float32. columns: those with one entry a row; `starts` (k + 1,) is where
    the rows of each bulk column begin. parameters: how the store was made. skipped: what was left out, and why.
    """

    folder: Path
    kind: str
    bulk: dict[str, NDArray[np.float32]]
    starts: dict[str, NDArray[np.int64]]
    columns: dict[str, NDArray[Any]]
    parameters: dict[str, Any]
    skipped: dict[str, str]

    def __len__(self) -> int:
        return len(self.columns["name"])

    def __reduce__(self) -> tuple[Any, ...]:
        return open_store, (self.folder, self.kind)  # another process maps the files itself

    def counts(self, bulk: str) -> NDArray[np.int64]:
        """Points of each row (k,) in a bulk column."""
        return np.diff(self.starts[bulk])

    def name(self, row: int) -> str:
        return bytes(self.columns["name"][row]).decode()

    def row(self, row: int) -> dict[str, NDArray[np.float32]]:
        """The points of a row, views of the mapped files. StoreError if they are not what was written."""
        points = {name: self.bulk[name][start[row] : start[row + 1]] for name, start in self.starts.items()}
        if checksum(*(part.data for part in points.values())) != self.columns["checksum"][row]:
            raise StoreError(
                f"expected the points of {self.name(row)!r} as they were written, got other bytes in {self.folder}; "
                "try copying or preparing it again"
            )
        return points

    def verify(self) -> None:
        """Read every row once. Raises StoreError as `row`."""
        for row in range(len(self)):
            self.row(row)


def open_store(folder: str | Path, kind: str) -> Store:
    """Open what `new_store` wrote.

    Raises StoreError that names the folder or the file: no manifest, another kind or format, a column that is missing,
    cut, or not the one that was written.
    """
    path = Path(folder)
    manifest = read_manifest(path)
    if (manifest["format"], manifest["kind"]) != (FORMAT, kind):
        raise StoreError(
            f"expected {kind} in format {FORMAT}, got {manifest['kind']} in format {manifest['format']} in {path}; "
            "try the other data module, or preparing again with this version"
        )
    columns = {name: _column(path / f"{name}.npy", entry) for name, entry in manifest["columns"].items()}
    bulk = {name: columns.pop(name) for name, entry in manifest["columns"].items() if entry["bulk"]}
    starts = {name: columns.pop(f"{name}_start") for name in bulk}
    return Store(path, kind, bulk, starts, columns, manifest["parameters"], manifest["skipped"])


def _column(file: Path, entry: Mapping[str, Any]) -> NDArray[Any]:
    """A column as its entry of the manifest describes it."""
    size = file.stat().st_size if file.is_file() else None
    if size != entry["bytes"]:
        found = "no such file" if size is None else f"{size} bytes"
        raise StoreError(f"expected {file} of {entry['bytes']} bytes, got {found}; try copying or preparing again")
    with suppress(ValueError):  # of a broken header
        mapped = entry["bulk"] and entry["shape"][0]  # no file can be mapped that has no points
        column = np.asarray(np.load(file, mmap_mode="r" if mapped else None))  # no subclass: quicker
        described = (column.dtype.str, list(column.shape)) == (entry["dtype"], entry["shape"])
        if described and (entry["bulk"] or checksum(np.ascontiguousarray(column).data) == entry["checksum"]):
            return column
    raise StoreError(f"expected {file} as it was written, got other bytes; try copying or preparing again")


def read_manifest(folder: Path) -> dict[str, Any]:
    """The manifest of a store of any kind. Raises StoreError if it is missing, cut or edited."""
    try:
        manifest = json.loads((folder / MANIFEST).read_text(encoding="utf-8"))
        whole = manifest.pop("checksum") == _checksum(manifest)
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise StoreError(f"expected a folder made by `bpnp prepare`, got {folder} ({error})") from error
    if not whole:
        raise StoreError(
            f"expected an unchanged {folder / MANIFEST}, got one that was edited or cut; try preparing again"
        )
    return dict(manifest)


class StoreWriter:
    """Appends rows to the columns of a new store; made by `new_store`.

    parameters: kept in the manifest, must be JSON. skipped: what was left out, and why; may be added to.
    """

    def __init__(self, folder: Path, files: Mapping[str, BinaryIO], widths: Mapping[str, int]) -> None:
        self.folder, self._files, self._widths = folder, files, widths
        self._columns: dict[str, list[NDArray[Any]]] = defaultdict(list)
        self.parameters: dict[str, Any] = {}
        self.skipped: dict[str, str] = {}
        for name, width in widths.items():
            self._columns[f"{name}_start"].append(np.zeros(1, np.int64))
            _write_header(files[name], BULK, (0, width))

    def __len__(self) -> int:
        return sum(len(part) for part in self._columns["name"])

    def add(self, name: str, bulk: Mapping[str, NDArray[Any]], **columns: Any) -> None:
        """Append one row: its points by bulk column, and its entries of the other columns."""
        points = {key: np.ascontiguousarray(bulk[key], BULK) for key in self._widths}
        columns |= {"checksum": np.uint32(checksum(*(part.data for part in points.values())))}
        columns |= {"name": np.bytes_(name.encode())}
        columns |= {f"{key}_start": self._end(key) + len(part) for key, part in points.items()}
        for key, value in columns.items():
            self._columns[key].append(np.asarray(value)[None])
        for key, part in points.items():
            self._files[key].write(part.data)

    def extend(self, part: Store) -> None:
        """Append all rows of another store, with their checksums."""
        columns = part.columns | {f"{key}_start": self._end(key) + start[1:] for key, start in part.starts.items()}
        for key, value in columns.items():
            if len(value):
                self._columns[key].append(value)
        for key, points in part.bulk.items():
            if len(points):
                self._files[key].write(points.data)
        self.skipped |= part.skipped

    def finish(self, kind: str) -> None:
        """Write what is left: the small columns, and the manifest last."""
        entries: dict[str, dict[str, Any]] = {}
        for name, file in self._files.items():
            file.seek(0)
            entries[name] = {"bulk": True, **_write_header(file, BULK, (int(self._end(name)), self._widths[name]))}
            entries[name]["bytes"] = file.seek(0, os.SEEK_END)
        self._columns.setdefault("name", [np.empty(0, "S1")])
        for name, parts in self._columns.items():
            column = np.concatenate(parts)
            with (self.folder / f"{name}.npy").open("wb") as file:
                entries[name] = {"bulk": False, **_write_header(file, column.dtype, column.shape)}
                file.write(column.data)  # np.save hides the reason why a write fails
                entries[name] |= {"checksum": checksum(column.data), "bytes": file.tell()}
        manifest = {"format": FORMAT, "kind": kind, "rows": entries["name"]["shape"][0], "columns": entries}
        manifest |= {"parameters": self.parameters, "skipped": self.skipped}
        content = json.dumps(manifest | {"checksum": _checksum(manifest)}, indent=1)
        (self.folder / MANIFEST).write_text(content, encoding="utf-8")

    def _end(self, bulk: str) -> np.int64:
        return np.int64(self._columns[f"{bulk}_start"][-1][-1])


@contextmanager
def new_store(folder: Path, kind: str, widths: Mapping[str, int], *, durable: bool = True) -> Iterator[StoreWriter]:
    """A writer of the new `folder`, which is there, complete, when the block has ended without an error.

    widths: coordinates of a point in each bulk column. Points are written as they come; memory holds the other columns.
    durable: wait until the disk has everything, so that not even a loss of power can cut the store.
    Raises StoreError if the folder exists, OSError that names it if the disk is full.
    """
    if folder.exists():
        raise StoreError(f"expected a new folder to write to, got {folder}, which exists; try another or remove it")
    with written_whole(folder) as temporary:
        temporary.mkdir()
        with ExitStack() as stack:
            files = {name: stack.enter_context((temporary / f"{name}.npy").open("wb")) for name in widths}
            writer = StoreWriter(temporary, files, widths)
            yield writer
            writer.finish(kind)
        for path in temporary.iterdir() if durable else ():
            with path.open("rb") as written:
                os.fsync(written.fileno())


def _write_header(file: BinaryIO, dtype: np.dtype[Any], shape: tuple[int, ...]) -> dict[str, Any]:
    """Write the header of a .npy file and describe it; numpy pads it to the same size for any number of rows."""
    np.lib.format.write_array_header_1_0(file, {"descr": dtype.str, "fortran_order": False, "shape": shape})
    return {"dtype": dtype.str, "shape": list(shape)}


def _checksum(content: Mapping[str, Any]) -> int:
    return checksum(json.dumps(content, sort_keys=True).encode())
