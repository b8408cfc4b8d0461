"""Where a data set of meshes comes from: a folder, a zip that stays packed, or HDF5 files of sampled points."""

import importlib
import os
import re
import zipfile
import zlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bpnp.datamodules.meshes.surfaces import (
    SUFFIXES,
    Mesh,
    MeshError,
    Normalisation,
    normalise,
    parse_mesh,
    read_mesh,
    sample_surface,
)  # fmt: skip
from bpnp.files import files_as_they_are, fingerprint

SPLITS = ("train", "test")
LAYOUT = f"<class>/{{train,test}}/*.{{{','.join(suffix[1:] for suffix in SUFFIXES)}}}"
ENTRY = re.compile(rf"(?:.*/)?([^/]+)/(train|test)/([^/.][^/]*)(?:{'|'.join(map(re.escape, SUFFIXES))})", re.I)


@dataclass(frozen=True)
class MeshFiles:
    """Meshes in files: each in its own (`place` None), as an entry of a zip, or as a row of an HDF5 file of sampled
    points (``modelnet40_ply_hdf5_2048``). places: (file, place) of each name, ``<class>/<split>/<stem>``; the training
    meshes come first."""

    places: dict[str, tuple[Path, str | int | None]]

    @property
    def names(self) -> Sequence[str]:
        return list(self.places)

    @property
    def identity(self) -> str:
        """Another one if a mesh is another."""
        return fingerprint([self.names, files_as_they_are(dict.fromkeys(path for path, _ in self.places.values()))])

    def part(self, start: int, stop: int) -> "MeshFiles":
        """The meshes of names[start:stop]."""
        return MeshFiles(dict(list(self.places.items())[start:stop]))

    def samples(self, name: str, count: int, mode: Normalisation) -> NDArray[np.float64]:
        """`count` normalised surface samples (count, 3), a function of the mesh and its name. Raises MeshError."""
        (path, place), rng = self.places[name], np.random.default_rng(zlib.crc32(name.encode()))
        if isinstance(place, int):
            return normalise(rng.permutation(_sampled(path, place, count))[:count], mode)
        mesh = read_mesh(path) if place is None else _packed(path, place)
        return normalise(sample_surface(mesh, count, rng), mode)


def _packed(archive: Path, entry: str) -> Mesh:
    try:
        return parse_mesh(_open(archive).read(entry), Path(entry).suffix)
    except (MeshError, zipfile.BadZipFile, zlib.error, EOFError, RuntimeError, NotImplementedError) as error:
        raise MeshError(f"{archive}/{entry}: {error}") from error


def _sampled(path: Path, row: int, count: int) -> NDArray[np.float64]:
    points = np.asarray(_open(path)["data"][row], np.float64)
    if points.shape[0] < count or points.shape[1:] != (3,) or not np.isfinite(points).all():
        raise MeshError(f"{path}: expected {count} finite points, got shape {points.shape} in row {row}")
    return points


def open_archive(source: Path) -> MeshFiles:
    """The meshes of `source`: ModelNet40.zip, its folder, the folder of its HDF5 files, or any folder in its layout.

    Raises ValueError that names the file or folder: missing, empty, foreign, or h5py not installed.
    """
    if source.is_file():
        try:
            entries = _named(_open(source).namelist())
        except (zipfile.BadZipFile, OSError) as error:
            raise ValueError(f"expected a zip of meshes, got {source} ({error}); try downloading it again") from error
        if not entries:
            raise ValueError(f"expected meshes {LAYOUT} in {source}, got none; try ModelNet40.zip")
        return MeshFiles({name: (source, entry) for name, entry in entries.items()})
    if not source.is_dir():
        raise ValueError(f"expected a folder with {LAYOUT}, or ModelNet40.zip, got {source}, which is not there")
    inside = sorted(path for path in source.iterdir() if path.is_dir())
    for folder in (source, *inside):
        if list(folder.glob("ply_data_*.h5")):
            return _sampled_archive(folder)
        if entries := _named(str(path) for path in folder.glob("*/*/*") if path.is_file()):
            return MeshFiles({name: (Path(entry), None) for name, entry in entries.items()})
    raise ValueError(f"expected a folder with {LAYOUT}, or ply_data_*.h5, got {source} without; try its parent")


def _named(paths: Iterable[str]) -> dict[str, str]:
    """Path of each mesh by its name, ``<class>/<split>/<stem>``; the training meshes first. Others are no meshes."""
    meshes = (ENTRY.fullmatch(path) for path in paths if "__MACOSX" not in path)
    entries = {f"{mesh[1]}/{mesh[2].lower()}/{mesh[3]}": mesh[0] for mesh in meshes if mesh}
    order = sorted(entries, key=lambda name: (SPLITS.index(name.split("/")[-2]), name))
    return {name: entries[name] for name in order}


def _sampled_archive(folder: Path) -> MeshFiles:
    shapes = folder / "shape_names.txt"
    if not shapes.is_file():
        raise ValueError(f"expected {shapes} beside the HDF5 files, got none; try unpacking the archive again")
    classes = shapes.read_text(encoding="utf-8").split()
    rows: dict[str, tuple[Path, str | int | None]] = {}
    for split in SPLITS:
        for path in sorted(folder.glob(f"ply_data_{split}*.h5")):
            try:
                file = _open(path)
                labels, data = np.asarray(file["label"]).reshape(-1), file["data"]
                names = [f"{classes[label]}/{split}/{path.stem}-{row:04d}" for row, label in enumerate(labels)]
            except (OSError, KeyError, IndexError) as error:
                raise ValueError(
                    f"expected `data` and `label` in {path}, got a file that has none or cannot be read ({error}); try "
                    "unpacking the archive again"
                ) from error
            if data.ndim != 3 or len(data) != len(names):
                raise ValueError(f"expected a label for each shape, got {len(names)} for {data.shape} in {path}")
            rows |= {name: (path, row) for row, name in enumerate(names)}
    return MeshFiles(rows)


def _open(path: Path) -> Any:
    """A file of many meshes, kept open for the next one of this process; a file that has changed is another."""
    return _opened(path, os.getpid(), *files_as_they_are([path]))


@lru_cache(maxsize=8)
def _opened(path: Path, process: int, stamp: tuple[str, int, int]) -> Any:
    if path.suffix != ".h5":
        return zipfile.ZipFile(path)
    try:
        return importlib.import_module("h5py").File(path, "r")  # optional
    except ImportError as error:
        raise ValueError("expected the package h5py, to read HDF5 files, got none; try `pip install h5py`") from error
