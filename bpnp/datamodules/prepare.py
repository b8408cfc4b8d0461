"""From a data set as it was published to a data store: in parts, by several processes, resumed after a kill."""

import multiprocessing
import os
import shutil
import signal
import threading
import warnings
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing, contextmanager
from dataclasses import dataclass
from functools import partial
from multiprocessing.connection import wait
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import track

from bpnp.datamodules.store import MANIFEST, Store, StoreError, is_store, new_store, open_store, read_manifest
from bpnp.files import cache_folder, claimed, fingerprint, interruptions_later


@dataclass(frozen=True)
class Prepared:
    """What is in a new store: counts by kind, and what was left out and why, by name."""

    folder: Path
    counts: Mapping[str, int]
    skipped: Mapping[str, str]


@dataclass(frozen=True)
class Recipe:
    """How a store is made: part after part, each by `work(writer, *job)`, then all of them in one.

    kind, widths: as in `new_store`. parameters: kept in the store; what was made with others is another store.
    work and the jobs must be picklable if there are several processes. what, source: for messages.
    """

    kind: str
    widths: Mapping[str, int]
    parameters: Mapping[str, Any]
    jobs: Sequence[tuple[Any, ...]]
    work: Callable[..., None]
    what: str
    source: str


def prepare(recipe: Recipe, output: Path, *, processes: int = 1, wait_for_others: bool = False) -> Store:
    """The store `output`, made unless it is there already. A run that was stopped resumes after its finished parts.

    Raises StoreError if `output` is something else or was made with other parameters, or if no part gives a row;
    ValueError if another process is making it, unless `wait_for_others`; whatever `work` raises.
    """
    parts_folder = output.with_name(f".{output.name}.unfinished")
    if not is_store(output):
        if output.exists():
            raise StoreError(f"expected a new folder as output, got {output}, which is no store of bpnp; try another")
        with claimed(parts_folder, wait=wait_for_others):
            if not is_store(output):  # another process may have made it
                _make(recipe, output, parts_folder, processes)
    for path in parts_folder.glob(f"*/{MANIFEST}"):  # first: what a kill leaves of the rest is not used
        path.unlink()
    shutil.rmtree(parts_folder, ignore_errors=True)
    made = read_manifest(output)["parameters"]
    if different := sorted(key for key in recipe.parameters if made.get(key) != recipe.parameters[key]):
        raise StoreError(
            f"expected a new folder, or one made in the same way, got {output} of another {', '.join(different)}; "
            "try another --output, or remove it"
        )
    return open_store(output, recipe.kind)


def cached(recipe: Recipe, label: str, cache_dir: str | None) -> Store:
    """The store of a recipe in the cache folder, made if it is not there, and made again if it is damaged.

    Warns once about what was left out. Raises as `prepare`.
    """
    folder = Path(cache_dir) if cache_dir is not None else cache_folder()
    output = folder / f"{label}-{fingerprint([recipe.kind, dict(recipe.parameters)])[:16]}"
    if is_store(output):
        try:
            open_store(output, recipe.kind).verify()
        except StoreError as error:
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


def _make(recipe: Recipe, output: Path, folder: Path, processes: int) -> None:
    """Write the store `output` from one store for each job, in `folder`; only those that are not there are made."""
    # The names differ for other jobs and other parameters, whose parts a stopped run may have left.
    jobs = {
        folder / f"{i:06d}-{fingerprint([repr(job), dict(recipe.parameters)])[:16]}": job
        for i, job in enumerate(recipe.jobs)
    }
    missing = {path: job for path, job in jobs.items() if not is_store(path)}
    # What was being written or removed when a process was killed.
    for leftover in [*folder.glob(".[0-9]*"), *output.parent.glob(f".{output.name}.[0-9]*"), *missing]:
        shutil.rmtree(leftover, ignore_errors=True)
    console, finished = Console(stderr=True), len(jobs) - len(missing)
    with closing(_made(recipe, missing, processes)) as done:
        for _ in track(done, f"reading {recipe.source}", len(jobs), finished, console=console, transient=True):
            pass
    with new_store(output, recipe.kind, recipe.widths) as writer:
        writer.parameters |= recipe.parameters
        for path in jobs:
            writer.extend(open_store(path, recipe.kind))
        if not len(writer):
            first = next(iter(writer.skipped.values()), "none found")
            raise StoreError(
                f"expected at least one usable {recipe.what} in {recipe.source}, got {len(writer.skipped)} "
                f"that are not; the first: {first}"
            )


def _made(recipe: Recipe, jobs: Mapping[Path, Any], processes: int) -> Generator[None, None, None]:
    """Make the stores of jobs, and yield after each."""
    make = partial(_make_part, recipe.work, recipe.kind, recipe.widths)
    if processes == 1:
        for path, job in jobs.items():
            make(path, job)
            yield
        return
    context = multiprocessing.get_context("forkserver")  # a fork of this process would copy its threads' locks
    context.set_forkserver_preload([recipe.work.__module__])
    with ProcessPoolExecutor(processes, context, initializer=_end_with_parent) as pool:
        try:
            with _interruptions_masked():
                futures = [pool.submit(make, path, job) for path, job in jobs.items()]
            yield from (future.result() for future in as_completed(futures))
        except BrokenProcessPool as error:
            raise OSError(
                f"a process that was reading {recipe.source} was killed, possibly out of memory; the finished "
                "parts are kept: try again with fewer --processes"
            ) from error
        finally:
            pool.shutdown(cancel_futures=True)


def _make_part(
    work: Callable[..., None], kind: str, widths: Mapping[str, int], path: Path, job: tuple[Any, ...]
) -> None:
    with new_store(path, kind, widths, durable=False) as writer:
        work(writer, *job)


@contextmanager
def _interruptions_masked() -> Iterator[None]:
    """Hold Ctrl-C back while workers start, so that all of them are known and ended; it never reaches the workers.

    They inherit the mask. It is not enough here: a thread of another library may have the signal instead.
    """
    with interruptions_later():
        mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            yield
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, mask)


def _end_with_parent() -> None:
    """End this worker when its parent is killed; it would wait for work for ever."""
    if parent := multiprocessing.parent_process():
        threading.Thread(target=lambda: wait([parent.sentinel]) and os._exit(1), daemon=True).start()
