"""Folders of binary files that are whole or not there: a manifest, written last, says what must be in them."""

import hashlib
import json
import os
import shutil
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

NAME = "manifest.json"
FORMAT = 2  # raised whenever a file of a store changes its meaning


class StoreError(ValueError):
    """A store that cannot be used or made; the message names its folder."""


def is_store(folder: str | Path) -> bool:
    """Whether `bpnp prepare` made this folder."""
    return (Path(folder) / NAME).is_file()


@contextmanager
def new_store(folder: Path) -> Iterator[Path]:
    """A folder to fill; at the end, if nothing was raised, it is renamed to `folder` in one step.

    Until then it is ``.<name>.<process>.unfinished`` beside it, and only that is left by a process that is killed.
    Raises StoreError if `folder` exists.
    """
    if folder.exists():
        raise StoreError(f"expected a new folder to write to, got {folder}, which exists; try another or remove it")
    temporary = folder.with_name(f".{folder.name}.{os.getpid()}.unfinished")
    temporary.mkdir(parents=True)
    try:
        yield temporary
        os.rename(temporary, folder)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def write_manifest(folder: Path, content: Mapping[str, Any], *, digested: tuple[str, ...]) -> None:
    """Write the manifest of a folder: `content`, the size of every file, and the digests of those in `digested`."""
    files: dict[str, dict[str, Any]] = {}
    for path in sorted(folder.iterdir()):
        with path.open("rb") as file:
            os.fsync(file.fileno())
        files[path.name] = {"bytes": path.stat().st_size}
        if path.name in digested:
            files[path.name]["digest"] = _file_digest(path)
    manifest = {"format": FORMAT, **content, "files": files}
    with (folder / NAME).open("w", encoding="utf-8") as file:
        json.dump(manifest | {"digest": _digest(manifest)}, file, indent=1)
        file.flush()
        os.fsync(file.fileno())


def read_parameters(folder: Path) -> dict[str, Any]:
    """How a store was made, of whatever kind it is. Raises StoreError for a broken manifest."""
    return dict(_parsed(folder)["parameters"])


def read_manifest(folder: Path, *, kind: str) -> dict[str, Any]:
    """The manifest of a folder, after the sizes of its files and the digests it holds were compared.

    Raises StoreError that names the folder or the file: no manifest, another kind or format, a file that is missing,
    cut, or not the one that was written.
    """
    manifest = _parsed(folder)
    if (manifest["format"], manifest["kind"]) != (FORMAT, kind):
        raise StoreError(
            f"expected {kind} in format {FORMAT}, got {manifest['kind']} in format {manifest['format']} in {folder}; "
            "try the other data module, or preparing again with this version"
        )
    for name, entry in manifest["files"].items():
        path = folder / name
        size = path.stat().st_size if path.is_file() else None
        if size != entry["bytes"]:
            found = "no such file" if size is None else f"{size} bytes"
            raise StoreError(f"expected {path} of {entry['bytes']} bytes, got {found}; try copying or preparing again")
        if "digest" in entry and _file_digest(path) != entry["digest"]:
            raise StoreError(f"expected {path} as it was written, got other bytes; try copying or preparing again")
    return manifest


def _parsed(folder: Path) -> dict[str, Any]:
    try:
        manifest = json.loads((folder / NAME).read_text(encoding="utf-8"))
        digest = manifest.pop("digest")
        whole = digest == _digest(manifest)
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise StoreError(f"expected a folder made by `bpnp prepare`, got {folder} ({error})") from error
    if not whole:
        raise StoreError(f"expected an unchanged {folder / NAME}, got one that was edited or cut; try preparing again")
    return manifest


def fingerprint(files: Iterable[Path]) -> str:
    """A digest of the names, sizes and times of files: whether they are still the same."""
    stats = [(path.name, path.stat().st_size, path.stat().st_mtime_ns) for path in files]
    return hashlib.blake2b(json.dumps(stats).encode(), digest_size=16).hexdigest()


def _file_digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "blake2b").hexdigest()


def _digest(content: Mapping[str, Any]) -> str:
    return hashlib.blake2b(json.dumps(content, sort_keys=True).encode()).hexdigest()
