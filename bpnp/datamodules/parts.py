"""Long work in parts: several processes, a progress bar, and parts that a killed run has finished are kept."""

import fcntl
import hashlib
import multiprocessing
import os
import shutil
import signal
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing.connection import wait
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from bpnp.datamodules.manifest import StoreError, is_store, read_parameters

Work = Callable[[Any, Path], None]  # writes the store of one part, complete or not at all


@contextmanager
def workplace(output: Path, inputs: Mapping[str, Any]) -> Iterator[Path]:
    """The folder ``.<output>.unfinished`` for the parts, locked; parts made from other `inputs` are removed first.

    When the body ends it is removed; when it raises, or the process is killed, it stays for the next run to go on.
    Raises StoreError if another process is preparing the same output.
    """
    folder = _folder(output)
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / "lock").open("w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise StoreError(f"expected one process to prepare {output}, got another at work; try later") from error
        key = _digest(sorted(inputs.items()))
        key_file = folder / "key"
        if not key_file.exists() or key_file.read_text() != key:
            _empty(folder, keep=("lock",))
            key_file.write_text(key)
        for leftover in folder.glob(".*.unfinished"):
            shutil.rmtree(leftover)
        yield folder
        _empty(folder, keep=())
    folder.rmdir()


def make_once(output: Path, parameters: Mapping[str, Any], make: Callable[[Path], None]) -> None:
    """Let `make(folder)` write the store `folder / "store"` and move it to `output`, unless that is there already.

    Raises StoreError if `output` is not a store, or one of other `parameters`.
    """
    if is_store(output):
        made = read_parameters(output)
        if different := sorted(key for key in parameters if made.get(key) != parameters[key]):
            raise StoreError(
                f"expected a new folder, or one made in the same way, got {output} of another {', '.join(different)}; "
                "try another --output, or remove it"
            )
        shutil.rmtree(_folder(output), ignore_errors=True)  # of a run that was killed when it had all but finished
        return
    if output.exists():
        raise StoreError(f"expected a new folder as output, got {output}, which is no store of bpnp; try another name")
    with workplace(output, parameters) as folder:
        make(folder)
        os.rename(folder / "store", output)


def make_parts(folder: Path, jobs: Sequence[Any], work: Work, *, processes: int, label: str) -> list[Path]:
    """The stores of all jobs, in their order: `work(job, path)` for each that `folder` does not have yet.

    work and the jobs must be picklable if there are several processes; these end when this one does.
    Raises whatever `work` raises.
    """
    paths = [folder / f"{i:06d}-{_digest(job)}" for i, job in enumerate(jobs)]  # parts of other jobs do not count
    missing = [i for i, path in enumerate(paths) if not path.exists()]
    columns = (TextColumn(label), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task(label, total=len(jobs), completed=len(jobs) - len(missing))
        if processes == 1:
            for i in missing:
                work(jobs[i], paths[i])
                progress.advance(task)
            return paths
        context = multiprocessing.get_context("forkserver")  # a fork of this process would copy its threads' locks
        context.set_forkserver_preload([work.__module__])
        with ProcessPoolExecutor(processes, context, initializer=_end_with_parent) as pool:
            try:
                with _interrupts_later():
                    futures: list[Future[None]] = [pool.submit(work, jobs[i], paths[i]) for i in missing]
                for future in as_completed(futures):
                    future.result()
                    progress.advance(task)
            except BrokenProcessPool as error:
                raise OSError(
                    f"a process that was {label} ended without a word, perhaps for want of memory; the finished parts "
                    "are kept: try again with fewer --processes"
                ) from error
            finally:
                pool.shutdown(cancel_futures=True)
    return paths


@contextmanager
def _interrupts_later() -> Iterator[None]:
    """Ctrl-C, which the terminal sends to all processes, reaches this one afterwards, and those started meanwhile
    never: this one ends them."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _end_with_parent() -> None:
    """A worker of a killed process would wait for work for ever."""

    def watch() -> None:
        parent = multiprocessing.parent_process()
        if parent is not None:
            wait([parent.sentinel])
            os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def _folder(output: Path) -> Path:
    return output.with_name(f".{output.name}.unfinished")


def _digest(job: Any) -> str:
    return hashlib.blake2b(repr(job).encode(), digest_size=8).hexdigest()


def _empty(folder: Path, *, keep: tuple[str, ...]) -> None:
    (folder / "key").unlink(missing_ok=True)  # first: without it, what a kill leaves of the rest is not used
    for path in folder.iterdir():
        if path.name in keep:
            continue
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink()
