"""Data store: a folder of memory-mapped .npy columns and a manifest; and recipes that make one from a data set.

A row is one problem or one mesh. Its points are in the bulk columns, row after row; `<bulk>_start.npy` has the first
index of each row. Every other column has one entry a row. A store is written atomically, and every file is compared
with its checksum in the manifest when the store is opened.
"""

import json
import os
import shutil
import sys
import time
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

from bpnp.bounded_files import read_json, read_npy
from bpnp.files import cache_folder, delay_interrupts, fingerprint, lock_folder, name_bytes, write_atomically

MANIFEST = "manifest.json"
FORMAT = 4  # raised whenever the meaning of a column changes
QUIET_SECONDS = 10.0  # between lines on the progress where there is no terminal
BULK = np.dtype("<f4")
StoreRow = tuple[
    str, Mapping[str, NDArray[Any]], Mapping[str, Any]
]  # name, points by bulk column, other entries by column
JobResult = tuple[list[StoreRow], dict[str, str]]  # rows, and the reason for each item left out, by its name


class StoreError(ValueError):
    """Store that cannot be used or made. The message names its folder."""


def is_store(folder: str | Path) -> bool:
    """Return True if a folder has the manifest of a store."""
    return (Path(folder) / MANIFEST).is_file()


@dataclass(frozen=True)
class Store:
    """Open store, from `open_store`."""

    folder: Path
    kind: str
    bulk: dict[str, NDArray[np.float32]]  # columns of points (total, width), float32
    starts: dict[str, NDArray[np.int64]]  # first index of each row of a bulk column, and its length, (k + 1,)
    columns: dict[str, NDArray[Any]]  # columns with one entry a row
    parameters: dict[str, Any]  # parameters that the store was made with
    skipped: dict[str, str]  # reason for each item that is not in the store

    def __len__(self) -> int:
        return len(self.columns["name"])

    def __reduce__(self) -> tuple[Any, ...]:
        return _map_file, (self.folder, self.kind)  # unpickled in another process by mapping the files there

    def counts(self, bulk: str) -> NDArray[np.int64]:
        """Return the number of points of each row (k,) in a bulk column."""
        return np.diff(self.starts[bulk])

    def name(self, row: int) -> str:
        return bytes(self.columns["name"][row]).decode()

    def row(self, row: int) -> dict[str, NDArray[np.float32]]:
        """Return the points of a row by bulk column, as views of the mapped files."""
        return {name: self.bulk[name][start[row] : start[row + 1]] for name, start in self.starts.items()}


def open_store(folder: str | Path, kind: str, *, check: bool = True) -> Store:
    """Open a store, and read it once to compare it with its checksums; without this check a large store opens at once.

    Raise StoreError, which names the folder or the file, if there is no manifest, the kind or the format differs, the
    store has no rows, or a file is missing or changed.
    """
    path = Path(folder)
    for name, (size, checksum) in _manifest(path, kind)["files"].items() if check else ():
        file = path / name
        if not file.is_file() or file.stat().st_size != size:
            problem = f"has {file.stat().st_size} bytes instead of {size}" if file.is_file() else "is missing"
            raise StoreError(f"{file} {problem}; copy or prepare the store again")
        if _checksum(file) != checksum:
            raise StoreError(f"{file} has changed since it was written; copy or prepare it again")
    return _map_file(path, kind)


def _map_file(folder: Path, kind: str) -> Store:
    manifest = _manifest(folder, kind)
    bulk = {name: np.asarray(np.load(folder / f"{name}.npy", mmap_mode="r")) for name in manifest["bulk"]}
    starts = {name: read_npy(folder / f"{name}_start.npy") for name in manifest["bulk"]}
    columns = {name: read_npy(folder / f"{name}.npy") for name in manifest["columns"]}
    return Store(folder, kind, bulk, starts, columns, manifest["parameters"], manifest["skipped"])


def _manifest(folder: Path, kind: str) -> dict[str, Any]:
    """Read the manifest of a store.

    Raise StoreError if it is missing, truncated, edited, of another kind or format, names files other than the columns,
    or has no rows.
    """
    try:
        manifest = dict(read_json(folder / MANIFEST))
        whole = manifest.pop("checksum") == fingerprint(manifest)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise StoreError(f"{folder} is no store made by `bpnp prepare` ({error})") from error
    if (manifest.get("format"), manifest.get("kind")) != (FORMAT, kind):
        raise StoreError(
            f"{folder} holds {manifest.get('kind')} in format {manifest.get('format')}, not {kind} in format {FORMAT}; "
            "use the other data module, or prepare it again with this version"
        )
    if not whole:
        raise StoreError(f"{folder / MANIFEST} was edited or truncated; prepare the store again")
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
    """Writer that appends rows to the columns of a new store; made by `new_store`."""

    def __init__(self, files: Mapping[str, BinaryIO], widths: Mapping[str, int]) -> None:
        self._files, self._widths = files, widths
        self._columns: dict[str, list[Any]] = defaultdict(list, {f"{name}_start": [0] for name in widths}, name=[])
        self.parameters: dict[str, Any] = {}  # JSON content for the manifest
        self.skipped: dict[str, str] = {}  # reason for each item that is left out
        for name, width in widths.items():
            _write_header(files[name], BULK, (0, width))

    def __len__(self) -> int:
        return len(self._columns["name"])

    def add(self, name: str, points: Mapping[str, NDArray[Any]], columns: Mapping[str, Any]) -> None:
        """Append one row; raise StoreError if points do not have the width of their column."""
        for key, width in self._widths.items():
            part = np.ascontiguousarray(points[key], BULK)
            if part.ndim != 2 or part.shape[1] != width:
                raise StoreError(f"`{key}` of {name} has the shape {part.shape}; (k, {width}) is needed")
            self._files[key].write(part.data)
            self._columns[f"{key}_start"].append(self._columns[f"{key}_start"][-1] + len(part))
        for key, value in {"name": name, **columns}.items():
            self._columns[key].append(name_bytes(value) if isinstance(value, str) else value)

    def finish(self, folder: Path, kind: str) -> None:
        """Write the small columns, and the manifest last."""
        for key, file in self._files.items():
            file.seek(0)
            _write_header(file, BULK, (self._columns[f"{key}_start"][-1], self._widths[key]))
            file.flush()
        for key, values in self._columns.items():
            column = np.array(values) if values else np.empty(0, "S1")
            with (folder / f"{key}.npy").open("wb") as file:  # np.save hides why a write failed
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
    """Yield a writer of a new folder, which appears, complete, when the block ends without an error.

    `widths` are the numbers of coordinates of a point in the bulk columns. Points are written at once; memory holds the
    other columns. Raise StoreError if the folder exists, and OSError, which names it, if the disk is full.
    """
    if folder.exists():
        raise StoreError(f"{folder} exists; remove it, or give a new folder")
    with write_atomically(folder) as temporary:
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
class Recipe(Dataset[JobResult]):
    """Jobs that make a store; `work(*job)` returns rows."""

    kind: str  # of the rows, as for `new_store`
    widths: Mapping[str, int]  # of the columns of points, as for `new_store`
    parameters: Mapping[str, Any]  # saved in the store; other parameters make another store
    jobs: Sequence[tuple[Any, ...]]  # arguments of `work`; picklable for several processes
    work: Callable[..., JobResult]  # function that does a job; picklable for several processes
    what: str  # name of an item, for messages
    source: str  # source of the items, for messages

    def __len__(self) -> int:
        return len(self.jobs)

    def __getitem__(self, number: int) -> JobResult:
        return self.work(*self.jobs[number])


def prepare(
    recipe: Recipe, output: Path, *, processes: int = 1, wait_for_others: bool = False, replace_damaged: bool = False
) -> Store:
    """Open the store `output`, or make it; an interrupted run leaves no store.

    The store is made in the folder `.<output>.unfinished` of the same parent, which only this function writes to. Files
    that a killed process has left there are removed. It waits for another process that is making the store, or raises
    ValueError; it makes a damaged store again with a warning, or raises. Raise StoreError if `output` is something
    else, is damaged or was made with other parameters, or no job gives a row.
    """
    try:
        if is_store(output):
            return _open_made(recipe, output)
    except (StoreError, FileNotFoundError):  # a file is not found while another process replaces the store
        if not replace_damaged:
            raise
    else:
        if output.exists() and not is_store(output):  # unless another process has just made it
            raise StoreError(f"{output} exists and is no store of bpnp; give a new folder")
    work = output.with_name(f".{output.name}.unfinished")
    try:
        with lock_folder(work, wait=wait_for_others):
            if replace_damaged and is_store(output):
                _remove_damaged(recipe, output, work / "damaged")
            if not is_store(output):  # another process may have made it
                _make(recipe, work / "store", processes)
                os.replace(work / "store", output)
    finally:
        with suppress(OSError):  # another process uses the folder, or made it
            work.rmdir()
    return _open_made(recipe, output)


def _open_made(recipe: Recipe, output: Path) -> Store:
    """Open a store and compare its parameters with those of a recipe."""
    store = open_store(output, recipe.kind)
    if different := sorted(key for key, value in recipe.parameters.items() if store.parameters.get(key) != value):
        raise StoreError(f"{output} was made with another {', '.join(different)}; give another --output, or remove it")
    return store


def _remove_damaged(recipe: Recipe, output: Path, aside: Path) -> None:
    """Remove a store, with a warning, if it still cannot be used: another process may have made it again."""
    try:
        _open_made(recipe, output)
    except StoreError as error:
        warnings.warn(f"the cached store {output} is damaged ({error}); making it again", stacklevel=4)
        shutil.rmtree(aside, ignore_errors=True)  # left by a killed process
        os.replace(output, aside)  # at once: a folder without a manifest would never be made again
        shutil.rmtree(aside)


def open_or_prepare(recipe: Recipe, label: str, cache_dir: str | None) -> Store:
    """Return the store of a recipe in the cache folder (`cache_folder()`); make it if it is missing or damaged.

    `label` begins the folder's name. A warning names items that are left out. Errors are those of `prepare`.
    """
    folder = Path(cache_dir) if cache_dir is not None else cache_folder()
    # Versions with other formats have stores of their own, and do not replace each other's.
    output = folder / f"{label}-{fingerprint([FORMAT, recipe.kind, dict(recipe.parameters)])[:16]}"
    store = prepare(recipe, output, wait_for_others=True, replace_damaged=True)
    if store.skipped:
        some = "; ".join(list(store.skipped.values())[:3])  # the reasons name the files
        warnings.warn(
            f"left out {len(store.skipped)} of {len(store.skipped) + len(store)}, all listed in "
            f"{output / MANIFEST}: {some}",
            stacklevel=2,
        )
    return store


def _make(recipe: Recipe, output: Path, processes: int) -> None:
    for remnant in (output, *output.parent.glob(f".{output.name}.[0-9]*")):  # left by a killed process
        shutil.rmtree(remnant, ignore_errors=True)
    made, console = _make_store(recipe, processes), Console(stderr=True, force_jupyter=False)
    with new_store(output, recipe.kind, recipe.widths) as writer:
        writer.parameters |= recipe.parameters
        bar, began = sys.stderr.isatty(), time.monotonic()
        printed = began
        shown: Any = {"console": console, "transient": True, "disable": not bar}
        for done, (rows, skipped) in enumerate(track(made, f"reading {recipe.source}", len(recipe), **shown), 1):
            is_last_of_several = done == len(recipe) and printed > began
            if not bar and (time.monotonic() > printed + QUIET_SECONDS or is_last_of_several):
                printed = time.monotonic()
                print(f"reading {recipe.source}: {done} of {len(recipe)}", file=sys.stderr, flush=True)  # noqa: T201
            writer.skipped |= skipped
            for row in rows:
                writer.add(*row)
        if not len(writer):
            first = next(iter(writer.skipped.values()), "none found")
            raise StoreError(
                f"{recipe.source} has no usable {recipe.what}; {len(writer.skipped)} are unusable, the first: {first}"
            )


def _make_store(recipe: Recipe, processes: int) -> Iterator[JobResult]:
    """Run the jobs and yield their results in order; worker processes end with this process, even if it is killed."""
    workers = 0 if processes == 1 else min(processes, len(recipe))
    generator = torch.Generator()  # otherwise the seeds of the workers change the global generator
    loader = DataLoader(recipe, batch_size=None, num_workers=workers, collate_fn=tuple, generator=generator)
    with delay_interrupts():  # worker processes inherit the handler and ignore Ctrl-C
        made = iter(loader)
    try:
        yield from made
    except RuntimeError as error:
        raise OSError(
            f"a process that was reading {recipe.source} ended, possibly out of memory ({error}); try fewer --processes"
        ) from error
