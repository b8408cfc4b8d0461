"""Bounded reading of files from elsewhere: bytes, text, JSON, YAML and NumPy arrays.

The readers refuse what has no end or states more than it holds, before memory is allocated for it.
"""

import io
import json
import math
import os
import stat
import time
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import IO, Any

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

MIB = 2**20
MOST_TEXT = 128 * MIB  # largest text, JSON or content of a pipe, which takes up to 25 times its size in memory [bytes]
MOST_BINARY = 1024 * MIB  # largest mesh or array that is read at once [bytes]
MOST_YAML = MIB  # largest YAML file; packaged ones have under 10 KiB [bytes]
MOST_NODES = 100_000  # most values of a YAML file, each alias counted as what it stands for
MOST_DEPTH = 100  # deepest nesting of a YAML file; libyaml ends the process at some 10,000
PIPE_SECONDS = 5.0  # how long a named pipe without a writer is waited for


@contextmanager
def open_input(path: Path, *, pipes: bool = True) -> Iterator[io.BufferedReader]:
    """Open a file or, unless excluded, a pipe or a terminal for reading.

    Raise ValueError for a folder, a device, a socket, or a pipe without a writer, and OSError if it does not exist, or
    cannot be read.
    """
    found = path.stat()
    if stat.S_ISREG(found.st_mode):
        with path.open("rb") as file:
            yield file
        return
    is_pipe = stat.S_ISFIFO(found.st_mode)
    if not (pipes and (is_pipe or _is_terminal(found))):
        kind = "folder" if stat.S_ISDIR(found.st_mode) else "pipe" if is_pipe else "device"
        raise ValueError(f"{path} is a {kind}; give a file")
    first = b""
    if is_pipe and path.resolve().is_fifo():  # a named one, whose opening would wait for a writer without end
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
        with os.fdopen(descriptor, "rb", buffering=0) as raw:
            first = _first_bytes(descriptor, path)
            os.set_blocking(descriptor, True)
            yield io.BufferedReader(_Prefixed(first, raw))
        return
    with path.open("rb") as file:
        yield file


class _Prefixed(io.RawIOBase):
    """Pipe whose first bytes have been read already."""

    def __init__(self, first: bytes, rest: IO[bytes]) -> None:
        self.first, self.rest = first, rest

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int:
        part, self.first = self.first[: len(buffer)], self.first[len(buffer) :]
        part = part or self.rest.read(len(buffer)) or b""
        buffer[: len(part)] = part
        return len(part)


def _is_terminal(found: os.stat_result) -> bool:
    """Return True for the terminal of standard input."""
    try:
        return stat.S_ISCHR(found.st_mode) and os.isatty(0) and os.path.samestat(found, os.fstat(0))
    except OSError:
        return False


def _first_bytes(descriptor: int, path: Path) -> bytes:
    """Return what a named pipe holds as soon as it has a writer."""
    deadline = time.monotonic() + PIPE_SECONDS
    while True:
        try:
            first = os.read(descriptor, io.DEFAULT_BUFFER_SIZE)
        except BlockingIOError:  # there is a writer, which has not written yet
            return b""
        if first:
            return first
        if time.monotonic() > deadline:
            raise ValueError(f"no program writes to the pipe {path}; start the one that does, or give a file")
        time.sleep(0.02)


def read_bytes(path: Path, most: int = MOST_TEXT) -> bytes:
    """Return the bytes of a file or of a pipe (`open_input`); raise ValueError if there are more than `most`."""
    with open_input(path) as file:
        return read_stream(file, str(path), most)


def read_stream(file: Any, name: str, most: int = MOST_TEXT) -> bytes:
    """Return the bytes of an open file, pipe or standard input up to its end.

    Raise ValueError if there are more than `most`, or it is a device other than a terminal.
    """
    found = _status(file)
    if found is not None and not stat.S_ISFIFO(found.st_mode):
        if (stat.S_ISCHR(found.st_mode) or stat.S_ISBLK(found.st_mode)) and not file.isatty():
            raise ValueError(f"{name} is a device; give a file")
        if stat.S_ISREG(found.st_mode) and found.st_size > most:
            raise ValueError(_too_large(name, most))
    content = bytearray()
    while part := file.read(min(MIB, most + 1 - len(content))):
        content += part
        if len(content) > most:
            raise ValueError(_too_large(name, most))
    return bytes(content)


def _status(file: Any) -> os.stat_result | None:
    """Return the status of an open file; None for one in memory."""
    try:
        return os.fstat(file.fileno())
    except (OSError, AttributeError):
        return None


def _too_large(name: str, most: int) -> str:
    return f"{name} has more than the {most // MIB} MiB that are read of such a file; give a smaller one"


def read_text(path: Path, most: int = MOST_TEXT) -> str:
    """Return a UTF-8 text, without a byte order mark, as `read_bytes`.

    Raise ValueError, which names the file, if it is not UTF-8.
    """
    try:
        return read_bytes(path, most).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError(f"{path} is no UTF-8 text: {error}") from error


def read_json(path: Path) -> Any:
    """Return the content of a JSON file, read by `read_bytes`; raise ValueError if it is no JSON."""
    return parse_json(read_bytes(path))


def parse_json(text: str | bytes) -> Any:
    """Return the content of a JSON text; raise ValueError for anything else, and for one that is nested too deeply."""
    try:
        return json.loads(text)
    except RecursionError as error:
        raise ValueError("it is nested too deeply") from error


def read_yaml(path: Path) -> Any:
    """Return the content of a YAML file, read by `read_bytes`.

    Raise ValueError if it is not YAML, or its aliases stand for too many values.
    """
    text = read_text(path, MOST_YAML)
    try:
        return parse_yaml(text)
    except ValueError as error:
        raise ValueError(f"{path} is not YAML: {error}") from error


def parse_yaml(text: str) -> Any:
    """Return the content of a YAML text; raise ValueError for anything else, and for what `check_yaml` refuses."""
    import yaml

    try:
        check_yaml(text)
        return yaml.load(text, Loader=_yaml_loader())
    except yaml.YAMLError as error:
        raise ValueError(" ".join(str(error).split())) from error


def check_yaml(text: str) -> None:
    """Check the size of a YAML text with its aliases written out, and its depth, before anything walks through it.

    Raise yaml.YAMLError if the text is not YAML, refers to itself, is nested more than `MOST_DEPTH` deep, or has more
    than `MOST_NODES` values.
    """
    import yaml

    sizes: dict[str, int] = {}  # values below each anchor
    opened: list[tuple[str | None, int]] = []  # anchor of each open list or mapping, and the values before it
    count = 0
    for event in yaml.parse(text, Loader=_yaml_loader()):
        if isinstance(event, yaml.AliasEvent):
            if event.anchor in (anchor for anchor, _ in opened):
                raise yaml.YAMLError(f"the alias *{event.anchor} stands for itself")
            count += sizes.get(event.anchor, 1)
        elif isinstance(event, yaml.NodeEvent):
            opened.append((event.anchor, count))
            count += 1
        if isinstance(event, (yaml.CollectionEndEvent, yaml.ScalarEvent)):
            anchor, before = opened.pop()
            sizes |= {} if anchor is None else {anchor: count - before}
        if count > MOST_NODES:
            raise yaml.YAMLError(f"it has more than {MOST_NODES} values, aliases (*name) written out")
        if len(opened) > MOST_DEPTH:
            raise yaml.YAMLError(f"it is nested more than {MOST_DEPTH} deep")


def _yaml_loader() -> Any:
    import yaml

    return getattr(yaml, "CSafeLoader", yaml.SafeLoader)


def read_npy(path: Path, most: int = MOST_BINARY) -> NDArray[Any]:
    """Return the array of a .npy file of at most `most` bytes, as `parse_npy`; the message of an error names it."""
    content = read_bytes(path, most)
    try:
        return parse_npy(content)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def parse_npy(content: bytes) -> NDArray[Any]:
    """Return the array in the bytes of a .npy file.

    Raise ValueError for bytes of something else, with fewer values than the header says, Python objects or named
    fields.
    """
    _check_header(io.BytesIO(content), len(content))
    return np.asarray(npy.read_array(io.BytesIO(content), allow_pickle=False))


def read_npz(path: Path) -> dict[str, NDArray[Any]]:
    """Return the arrays of a .npz file that `numpy.savez` wrote, without compression, by name.

    Raise ValueError as `parse_npy`, or if the arrays are larger than the file, and OSError or zipfile.BadZipFile if the
    file cannot be read, or is no archive.
    """
    arrays = {}
    with open_input(path, pipes=False) as file, zipfile.ZipFile(file) as archive:
        members = archive.infolist()
        if sum(member.file_size for member in members) > os.fstat(file.fileno()).st_size:
            raise ValueError("its arrays are compressed; write them with numpy.savez")
        for member in members:
            with archive.open(member) as content:
                _check_header(content, member.file_size)
            with archive.open(member) as content:
                arrays[member.filename.removesuffix(".npy")] = npy.read_array(content, allow_pickle=False)
    return arrays


def _check_header(file: Any, size: int) -> None:
    """Raise ValueError unless a .npy file of `size` bytes holds plain values, and as many as its header says."""
    try:
        version = npy.read_magic(file)
        read = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
        shape, _, dtype = read(file)
    except Exception as error:  # numpy parses the header as Python, with any of its errors
        raise ValueError(f"no .npy file ({' '.join(str(error).split())[:200]})") from error
    if dtype.hasobject:
        raise ValueError("it holds Python objects, which are not read; save numbers, such as by .astype(float)")
    if dtype.names is not None:
        raise ValueError(
            f"it holds records with the fields {', '.join(dtype.names)[:80]}; save rows of numbers, such as by "
            "numpy.lib.recfunctions.structured_to_unstructured"
        )
    check_size("its header", shape, dtype, size - file.tell())


def check_size(name: str, shape: tuple[int, ...], dtype: np.dtype[Any], most: int) -> None:
    """Check the size of an array that a file states before it is made.

    `name` tells where it is stated. Raise ValueError if a side is negative, or the array has more than `most` bytes.
    """
    if any(side < 0 for side in shape):
        raise ValueError(f"{name} states the shape {shape}")
    if (needed := math.prod(shape) * dtype.itemsize) > most:
        raise ValueError(
            f"{name} states {dtype} of shape {shape}, {needed} bytes, and there are at most {max(most, 0)}; the file "
            "is truncated or damaged"
        )


def file_inside(folder: Path, name: str) -> Path | None:
    """Return the path of a file that another file names with slashes, in a folder; None if it is absolute or leads out.

    >>> from pathlib import Path
    >>> from bpnp.bounded_files import file_inside
    >>> file_inside(Path("images"), "left/1.jpg"), file_inside(Path("images"), "../1.jpg")
    (PosixPath('images/left/1.jpg'), None)
    """
    parts = PurePosixPath(name.replace("\\", "/")).parts
    leads_out = ".." in parts or "\0" in name or Path(name).is_absolute() or name.startswith(("/", "\\"))
    return None if leads_out or not parts else folder / name
