"""Files and folders written whole or not at all, locks, the packaged configurations, the user's cache."""

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

CONFIGS = Path(__file__).parent / "configs"  # in a checkout a link to the folder `configs` at its top


@contextmanager
def write_atomically(path: Path) -> Iterator[Path]:
    """A temporary name beside `path` for a file or a folder; renamed to `path` on success, deleted on error.

    Makes the folders above it. An error of the disk names `path`.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        yield temporary
        os.replace(temporary, path)
    except OSError as error:
        if error.filename is None and error.errno is not None:  # a write to a full disk does not say to which file
            raise OSError(error.errno, error.strerror, str(path)) from error
        raise
    finally:
        if temporary.is_dir():
            shutil.rmtree(temporary)
        else:
            temporary.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> Path:
    """Write a text whole or not at all, with line ends as they are."""
    with write_atomically(path) as temporary:
        temporary.write_text(text, encoding="utf-8", newline="")
    return path


@contextmanager
def lock_folder(folder: Path, *, wait: bool = False) -> Iterator[None]:
    """Hold a folder for this process; it is made if it is not there.

    Raises ValueError if it is a file, or if another process holds it, unless told to wait. The lock ends with the
    process, however it ends.
    """
    lock = FileLock(folder / ".lock", timeout=-1 if wait else 0)
    while not lock.is_locked:
        try:
            folder.mkdir(parents=True, exist_ok=True)
            lock.acquire()
        except FileNotFoundError:
            continue  # another process has just removed the folder
        except (FileExistsError, NotADirectoryError) as error:
            raise ValueError(f"expected a folder to write to, got {folder}, which is or lies in a file") from error
        except Timeout:
            message = f"expected a folder that no other process writes to, got {folder}; try another, or later"
            raise ValueError(message) from None
    try:
        yield
    finally:
        (folder / ".lock").unlink(missing_ok=True)
        lock.release()


@contextmanager
def delay_interrupts() -> Iterator[None]:
    """Hold Ctrl-C back until the block ends; a thread other than the main one never gets it."""
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


def fingerprint(content: Any) -> str:
    """A name for JSON content, 32 hexadecimal digits: different content has a different one."""
    return hashlib.blake2b(json.dumps(content, sort_keys=True).encode(), digest_size=16).hexdigest()


def file_states(files: Iterable[Path]) -> list[tuple[str, int, int]]:
    """Names, sizes and times of files, for a `fingerprint` that changes when one of them does."""
    return [(file.name, (stat := file.stat()).st_size, stat.st_mtime_ns) for file in files]


def cache_folder() -> Path:
    """Where data that can be made again is kept: BPNP_CACHE, else the user's cache, ``~/.cache/bpnp``."""
    return Path(os.environ.get("BPNP_CACHE") or user_cache_path("bpnp"))


def packaged_config(name: str) -> str:
    """The file of a configuration: a path that is a file as it is, or of a name such as `quickstart` the packaged one.

    >>> Path(packaged_config("quickstart")).name
    'quickstart.yaml'
    """
    inside = name.removeprefix("configs/").removesuffix(".yaml")
    path = CONFIGS / f"{inside}.yaml"
    return str(path) if path.is_file() and not Path(name).is_file() else name


def config_names() -> list[str]:
    """The names that `packaged_config` takes."""
    return sorted(str(path.relative_to(CONFIGS).with_suffix("")) for path in CONFIGS.rglob("*.yaml"))


def config_content(file: Path) -> dict[str, Any]:
    """The content of a configuration file. Raises ValueError that names a file without options."""
    import yaml

    try:
        content = yaml.safe_load(file.read_text(encoding="utf-8"))
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ValueError(f"expected YAML in {file}, got {' '.join(str(error).split())}") from error
    if not isinstance(content, dict):
        raise ValueError(f"expected options such as `model:` and `data:` in {file}, got {content!r:.60}")
    return content
