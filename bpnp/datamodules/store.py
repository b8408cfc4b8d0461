"""The data store: a folder of .npy columns, memory-mapped, and a manifest; and how a data set is made one.

A row is one problem or one mesh. Its points lie in the bulk columns, one row after the other; `<bulk>_start.npy` says
where the rows begin. All other columns have one entry a row. A store is complete or not there at all, and every file is
compared with the manifest's checksum when the store is opened.
"""

import json
import os
import shutil
import warnings
import zlib
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import torch
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track
from torch.utils.data import DataLoader, Dataset

from bpnp.files import cache_folder, claimed, fingerprint, interruptions_later, written_whole

MANIFEST = "manifest.json"
FORMAT = 4  # raised whenever a column changes its meaning
BULK = np.dtype("<f4")
Row = tuple[str, Mapping[str, NDArray[Any]], Mapping[str, Any]]  # name, points by bulk column, entries of the others
Made = tuple[list[Row], dict[str, str]]  # rows, and by name what was left out and why


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
        return _mapped, (self.folder, self.kind)  # another process maps the files itself

    def counts(self, bulk: str) -> NDArray[np.int64]:
        """Points of each row (k,) in a bulk column."""
        return np.diff(self.starts[bulk])

    def name(self, row: int) -> str:
        return bytes(self.columns["name"][row]).decode()

    def row(self, row: int) -> dict[str, NDArray[np.float32]]:
        """The points of a row, views of the mapped files."""
        return {name: self.bulk[name][start[row] : start[row + 1]] for name, start in self.starts.items()}


def open_store(folder: str | Path, kind: str) -> Store:
    """Open what `new_store` wrote, and read it once, to compare it with its checksums.

    Raises StoreError that names the folder or the file: no manifest, another kind or format, a file that is missing,
    cut, or not the one that was written.
    """
    path = Path(folder)
    for name, (size, checksum) in _manifest(path, kind)["files"].items():
        file = path / name
        if not file.is_file() or file.stat().st_size != size:
            got = f"{file.stat().st_size} bytes" if file.is_file() else "no such file"
            raise StoreError(f"expected {file} of {size} bytes, got {got}; try copying or preparing again")
        if _checksum(file) != checksum:
            raise StoreError(f"expected {file} as it was written, got other bytes; try copying or preparing again")
    return _mapped(path, kind)


def _mapped(folder: Path, kind: str) -> Store:
    manifest = _manifest(folder, kind)
    bulk = {name: np.asarray(np.load(folder / f"{name}.npy", mmap_mode="r")) for name in manifest["bulk"]}
    starts = {name: np.load(folder / f"{name}_start.npy") for name in manifest["bulk"]}
    columns = {name: np.load(folder / f"{name}.npy") for name in manifest["columns"]}
    return Store(folder, kind, bulk, starts, columns, manifest["parameters"], manifest["skipped"])


def _manifest(folder: Path, kind: str) -> dict[str, Any]:
    """The manifest of a store. Raises StoreError if it is missing, cut or edited, or of another kind or format."""
    try:
        manifest = dict(json.loads((folder / MANIFEST).read_text(encoding="utf-8")))
        whole = manifest.pop("checksum") == fingerprint(manifest)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise StoreError(f"expected a folder made by `bpnp prepare`, got {folder} ({error})") from error
    if (manifest.get("format"), manifest.get("kind")) != (FORMAT, kind):
        raise StoreError(
            f"expected {kind} in format {FORMAT}, got {manifest.get('kind')} in format {manifest.get('format')} in "
            f"{folder}; try the other data module, or preparing again with this version"
        )
    if not whole:
        raise StoreError(f"expected an unchanged {folder / MANIFEST}, got an edited or cut one; try preparing again")
    columns = {f"{name}.npy" for name in (*manifest["bulk"], *(f"{name}_start" for name in manifest["bulk"]))}
    columns |= {f"{name}.npy" for name in manifest["columns"]}
    if columns != manifest["files"].keys() or any(Path(name).name != name for name in columns):
        raise StoreError(
            f"{folder / MANIFEST} names files other than the columns in its folder: {', '.join(manifest['files'])}. "
            "Prepare the data set again."
        )
    return manifest


def _checksum(file: Path) -> int:
    return zlib.crc32(np.memmap(file, mode="r").data)


class StoreWriter:
    """Appends rows to the columns of a new store; made by `new_store`.

    parameters: kept in the manifest, must be JSON. skipped: what was left out, and why; may be added to.
    """

    def __init__(self, files: Mapping[str, BinaryIO], widths: Mapping[str, int]) -> None:
        self._files, self._widths = files, widths
        self._columns: dict[str, list[Any]] = defaultdict(list, {f"{name}_start": [0] for name in widths}, name=[])
        self.parameters: dict[str, Any] = {}
        self.skipped: dict[str, str] = {}
        for name, width in widths.items():
            _write_header(files[name], BULK, (0, width))

    def __len__(self) -> int:
        return len(self._columns["name"])

    def add(self, name: str, points: Mapping[str, NDArray[Any]], columns: Mapping[str, Any]) -> None:
        """Append one row: its points by bulk column, and its entries of the other columns."""
        for key in self._widths:
            part = np.ascontiguousarray(points[key], BULK)
            self._files[key].write(part.data)
            self._columns[f"{key}_start"].append(self._columns[f"{key}_start"][-1] + len(part))
        for key, value in {"name": name.encode(), **columns}.items():
            self._columns[key].append(value.encode() if isinstance(value, str) else value)

    def finish(self, folder: Path, kind: str) -> None:
        """Write what is left: the small columns, and the manifest last."""
        for key, file in self._files.items():
            file.seek(0)
            _write_header(file, BULK, (self._columns[f"{key}_start"][-1], self._widths[key]))
            file.flush()
        for key, values in self._columns.items():
            column = np.array(values) if values else np.empty(0, "S1")
            with (folder / f"{key}.npy").open("wb") as file:  # np.save hides the reason why a write fails
                _write_header(file, column.dtype, column.shape)
                file.write(column.data)
        files = {path.name: [path.stat().st_size, _checksum(path)] for path in sorted(folder.glob("*.npy"))}
        small = [key for key in self._columns if key.removesuffix("_start") not in self._widths]
        manifest = {"format": FORMAT, "kind": kind, "rows": len(self), "bulk": list(self._widths), "columns": small}
        manifest |= {"files": files, "parameters": self.parameters, "skipped": self.skipped}
        content = json.dumps(manifest | {"checksum": fingerprint(manifest)}, indent=1)
        (folder / MANIFEST).write_text(content, encoding="utf-8")


@contextmanager
def new_store(folder: Path, kind: str, widths: Mapping[str, int]) -> Iterator[StoreWriter]:
    """A writer of the new `folder`, which is there, complete, when the block has ended without an error.

    widths: coordinates of a point in each bulk column. Points are written as they come; memory holds the other columns.
    Raises StoreError if the folder exists, OSError that names it if the disk is full.
    """
    if folder.exists():
        raise StoreError(f"expected a new folder to write to, got {folder}, which exists; try another or remove it")
    with written_whole(folder) as temporary:
        temporary.mkdir()
        with ExitStack() as stack:
            files = {name: stack.enter_context((temporary / f"{name}.npy").open("wb")) for name in widths}
            writer = StoreWriter(files, widths)
            yield writer
            writer.finish(temporary, kind)


def _write_header(file: BinaryIO, dtype: np.dtype[Any], shape: tuple[int, ...]) -> None:
    """Write the header of a .npy file; numpy pads it to the same size for any number of rows."""
    np.lib.format.write_array_header_1_0(file, {"descr": dtype.str, "fortran_order": False, "shape": shape})


@dataclass(frozen=True)
class Recipe(Dataset[Made]):
    """How a store is made: of the rows that `work(*job)` gives for one job after the other.

    kind, widths: as in `new_store`. parameters: kept in the store; what was made with others is another store.
    work and the jobs must be picklable if there are several processes. what, source: for messages.
    """

    kind: str
    widths: Mapping[str, int]
    parameters: Mapping[str, Any]
    jobs: Sequence[tuple[Any, ...]]
    work: Callable[..., Made]
    what: str
    source: str

    def __len__(self) -> int:
        return len(self.jobs)

    def __getitem__(self, number: int) -> Made:
        return self.work(*self.jobs[number])


def prepare(recipe: Recipe, output: Path, *, processes: int = 1, wait_for_others: bool = False) -> Store:
    """Open the store `output`, or make it; a run that is stopped leaves nothing.

    The store is made in a folder beside `output`, which only this function writes to; what a killed process has left
    there is removed.

    Args:
        recipe: how the store is made.
        output: folder of the store.
        processes: that read the source.
        wait_for_others: whether to wait for another process that is making the store.

    Raises:
        StoreError: `output` is something else or was made with other parameters, or no job gives a row.
        ValueError: another process is making the store, and `wait_for_others` is False.
    """
    if not is_store(output):
        if output.exists() and not is_store(output):  # unless another process has just made it
            raise StoreError(f"expected a new folder as output, got {output}, which is no store of bpnp; try another")
        work = output.with_name(f".{output.name}.unfinished")
        try:
            with claimed(work, wait=wait_for_others):
                if not is_store(output):  # another process may have made it
                    _make(recipe, work / "store", processes)
                    os.replace(work / "store", output)
        finally:
            with suppress(OSError):  # another process is using it, or it is not ours
                work.rmdir()
    store = open_store(output, recipe.kind)
    if different := sorted(key for key, value in recipe.parameters.items() if store.parameters.get(key) != value):
        raise StoreError(
            f"expected a new folder, or one made in the same way, got {output} of another {', '.join(different)}; "
            "try another --output, or remove it"
        )
    return store


def cached(recipe: Recipe, label: str, cache_dir: str | None) -> Store:
    """The store of a recipe in the cache folder, made if it is not there, and made again if it is damaged.

    Warns once about what was left out. Raises as `prepare`.
    """
    folder = Path(cache_dir) if cache_dir is not None else cache_folder()
    output = folder / f"{label}-{fingerprint([recipe.kind, dict(recipe.parameters)])[:16]}"
    try:
        store = prepare(recipe, output, wait_for_others=True)
    except StoreError as error:
        if not is_store(output):
            raise
        warnings.warn(f"the cached store {output} is damaged ({error}); making it again", stacklevel=2)
        shutil.rmtree(output)
        store = prepare(recipe, output, wait_for_others=True)
    if store.skipped:
        some = "; ".join(list(store.skipped.values())[:3])  # the reasons name the files
        warnings.warn(
            f"left out {len(store.skipped)} of {len(store.skipped) + len(store)}, all listed in "
            f"{output / MANIFEST}: {some}",
            stacklevel=2,
        )
    return store


def _make(recipe: Recipe, output: Path, processes: int) -> None:
    for left in (output, *output.parent.glob(f".{output.name}.[0-9]*")):  # by a process that was killed
        shutil.rmtree(left, ignore_errors=True)
    made, console = _made(recipe, processes), Console(stderr=True)
    with new_store(output, recipe.kind, recipe.widths) as writer:
        writer.parameters |= recipe.parameters
        for rows, skipped in track(made, f"reading {recipe.source}", len(recipe), console=console, transient=True):
            writer.skipped |= skipped
            for row in rows:
                writer.add(*row)
        if not len(writer):
            first = next(iter(writer.skipped.values()), "none found")
            raise StoreError(
                f"expected at least one usable {recipe.what} in {recipe.source}, got {len(writer.skipped)} "
                f"that are not; the first: {first}"
            )


def _made(recipe: Recipe, processes: int) -> Iterator[Made]:
    """What the jobs give, in their order. A loader's workers end with this process, however it ends."""
    workers = 0 if processes == 1 else min(processes, len(recipe))
    generator = torch.Generator()  # else the seeds of the workers are drawn from the global one
    loader = DataLoader(recipe, batch_size=None, num_workers=workers, collate_fn=tuple, generator=generator)
    with interruptions_later():  # the workers leave Ctrl-C to this process
        made = iter(loader)
    try:
        yield from made
    except RuntimeError as error:
        raise OSError(
            f"a process that was reading {recipe.source} ended, possibly out of memory ({error}); try fewer --processes"
        ) from error
