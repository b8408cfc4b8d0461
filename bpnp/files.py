"""Atomic writes, folder locks, fingerprints, the packaged configurations and the user's cache."""

import hashlib
import json
import os
import shutil
import signal
import threading
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout
from platformdirs import user_cache_path

from bpnp.bounded_files import read_text, read_yaml

CONFIGS = Path(__file__).parent / "configs"  # in a checkout, a link to the folder `configs` at the top
REMOVALS = 100  # times that a folder to lock may have been removed by another process


@contextmanager
def write_atomically(path: Path) -> Iterator[Path]:
    """Yield a temporary path next to a file or folder, renamed to it on success and deleted on error.

    Parent folders are created. An OSError without a file name gets `path`. A device or a pipe, such as /dev/stdout, is
    yielded itself: it is written to, not replaced.
    """
    if _is_device(path):
        yield path
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        yield temporary
        os.replace(temporary, path)
    except OSError as error:
        if error.filename is None and error.errno is not None:  # such as a write to a full disk
            raise OSError(error.errno, error.strerror, str(path)) from error
        raise
    finally:
        if temporary.is_dir():
            shutil.rmtree(temporary)
        else:
            temporary.unlink(missing_ok=True)


def _is_device(path: Path) -> bool:
    """Return True for a device or a pipe, such as /dev/stdout."""
    return path.exists() and (path.parent == Path("/dev") or not (path.is_file() or path.is_dir()))


def write_text(path: Path, text: str, *, errors: str = "strict") -> Path:
    """Write a text file as UTF-8 atomically, with its line ends unchanged, and return its path.

    The handler of errors "surrogateescape" writes the bytes of file names unchanged.
    """
    with write_atomically(path) as temporary:
        temporary.write_text(text, encoding="utf-8", errors=errors, newline="")
    return path


def check_outputs(outputs: Iterable[Path | None], inputs: Iterable[Path | None] = ()) -> None:
    """Check that files, or None, can be written, before the work whose results they get, and create their folders.

    Raise ValueError if an output is a folder, a file that is also an input or another output, or in a folder that
    cannot be created or written to. An input may be a folder.
    """
    input_files = {path.resolve() for path in inputs if path is not None and path.is_file()}
    output_files: set[Path] = set()
    for path in outputs:
        if path is None:
            continue
        if path.resolve() in output_files:
            raise ValueError(f"{path} is the file of two outputs; name another file for one of them")
        output_files.add(path.resolve())
        if path.is_dir():
            raise ValueError(f"{path} is a folder; give a file name to write to")
        if path.resolve() in input_files:
            raise ValueError(f"{path} is an input and would be overwritten; name another file")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            reason = error.strerror or error
            raise ValueError(f"{path} cannot be written: {reason}; name a file in another folder") from error
        if not os.access(path if _is_device(path) else path.parent, os.W_OK):
            raise ValueError(f"{path} cannot be written: no permission; name a file in another folder")


def require_new_folder(folder: Path) -> None:
    """Raise ValueError unless a folder can be written: it does not exist, or it is empty."""
    if folder.exists() and not (folder.is_dir() and not any(folder.iterdir())):
        raise ValueError(f"{folder} exists and would be replaced; name a new folder")


@contextmanager
def lock_folder(folder: Path, *, wait: bool = False) -> Iterator[None]:
    """Lock a folder for this process until the block ends; create it if it does not exist.

    The operating system releases the lock when the process ends, however it ends. It waits for another process that
    holds the lock, or raises ValueError, as for a folder that is or lies in a file, or cannot be created.
    """
    lock = FileLock(folder / ".lock", timeout=-1 if wait else 0)
    tries = 0
    while not lock.is_locked:
        try:
            folder.mkdir(parents=True, exist_ok=True)
            lock.acquire()
        except FileNotFoundError as error:
            tries += 1
            if tries == REMOVALS:  # such as in /proc
                raise ValueError(f"cannot create the folder {folder}; name another one") from error
            # another process has just removed the folder
        except (FileExistsError, NotADirectoryError) as error:
            raise ValueError(f"cannot write to {folder}: it is a file, or lies in one") from error
        except Timeout:
            message = f"another process writes to {folder}; try another folder, or try again later"
            raise ValueError(message) from None
    try:
        yield
    finally:
        (folder / ".lock").unlink(missing_ok=True)
        lock.release()


@contextmanager
def delay_interrupts() -> Iterator[None]:
    """Delay Ctrl-C until the block ends.

    Only the main thread receives Ctrl-C; in another thread nothing is done.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    held: list[int] = []
    handler = signal.signal(signal.SIGINT, lambda number, _: held.append(number))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, handler)
        if held:
            signal.raise_signal(signal.SIGINT)


def read_lines(path: Path) -> list[str]:
    """Return the lines of a UTF-8 file without white space around them; empty ones are left out."""
    return [line for text in read_text(path).splitlines() if (line := text.strip())]


def name_bytes(name: str) -> bytes:
    r"""Return a name as UTF-8; bytes of a file name that are not UTF-8 become backslash escapes.

    >>> from bpnp.files import name_bytes
    >>> name_bytes("caf\udce9")
    b'caf\\udce9'
    """
    return name.encode(errors="backslashreplace")


def fingerprint(content: Any) -> str:
    """Return a hash of JSON content, 32 hexadecimal digits."""
    return hashlib.blake2b(json.dumps(content, sort_keys=True).encode(), digest_size=16).hexdigest()


def file_states(files: Iterable[Path]) -> list[tuple[str, int, int]]:
    """Return the name, size and modification time of each file, for a `fingerprint` that changes with any of them."""
    return [(file.name, (stat := file.stat()).st_size, stat.st_mtime_ns) for file in files]


def cache_folder() -> Path:
    """Return the folder for data that can be made again: `BPNP_CACHE`, else the user's cache, ``~/.cache/bpnp``."""
    return Path(os.environ.get("BPNP_CACHE") or user_cache_path("bpnp"))


def packaged_config(name: str) -> str:
    """Return the file of a packaged configuration, such as `quickstart`; the path of a file is returned unchanged.

    >>> from pathlib import Path
    >>> from bpnp.files import packaged_config
    >>> Path(packaged_config("quickstart")).name
    'quickstart.yaml'
    """
    inside = name.removeprefix("configs/").removesuffix(".yaml")
    path = CONFIGS / f"{inside}.yaml"
    return str(path) if path.is_file() and not Path(name).is_file() else name


def config_names() -> list[str]:
    """Return the names of the packaged configurations, sorted."""
    return sorted(str(path.relative_to(CONFIGS).with_suffix("")) for path in CONFIGS.rglob("*.yaml"))


def config_content(file: Path) -> dict[str, Any]:
    """Read the options of a configuration file; raise ValueError if it is not YAML, or holds no options."""
    content = read_yaml(file)
    if not isinstance(content, dict):
        raise ValueError(f"{file} has no options such as `model:` and `data:`; its content is {content!r:.60}")
    return content
