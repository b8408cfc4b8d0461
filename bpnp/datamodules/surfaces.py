"""Triangle meshes, read from files, zips and HDF5 files or made of primitives, and uniform samples of their surface."""

import importlib
import io
import os
import re
import zipfile
import zlib
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cache, lru_cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
import trimesh
from numpy.typing import NDArray

from bpnp.files import files_as_they_are, fingerprint
from bpnp.geometry import random_rotations

SUFFIXES = (".glb", ".obj", ".off", ".ply", ".stl")

VERSION = 1  # of procedural shapes, raised whenever the same seed makes another one
Normalisation = Literal["unit_sphere", "unit_cube", "none"]


class MeshError(ValueError):
    """A file that is no usable mesh. The message names the file."""


@dataclass(frozen=True)
class Mesh:
    """Triangles: vertices (v, 3) and the vertex indices (f, 3) of the faces. MeshError if they are no surface."""

    vertices: NDArray[np.float64]
    faces: NDArray[np.int64]

    def __post_init__(self) -> None:
        if len(self.faces) == 0:
            raise MeshError("expected a mesh with faces, got none")
        if not np.isfinite(self.vertices).all():
            raise MeshError("expected finite vertices, got NaN or infinity")
        if self.faces.min() < 0 or self.faces.max() >= len(self.vertices):
            used = f"{self.faces.min()} to {self.faces.max()}"
            raise MeshError(f"expected faces of the vertices 0 to {len(self.vertices) - 1}, got {used}")
        area = self.areas.sum()
        if not 0 < area < np.inf:
            raise MeshError(f"expected a surface of positive area, got {area}")

    @property
    def areas(self) -> NDArray[np.float64]:
        """Area of each face (f,)."""
        a, b, c = (self.vertices[self.faces[:, i]] for i in range(3))
        return np.linalg.norm(np.cross(b - a, c - a), axis=-1) / 2


def read_mesh(path: Path) -> Mesh:
    """Read an .off, .ply, .obj, .stl or .glb file; the parts of a scene become one mesh. Polygons become fans.

    Raises MeshError that names the file: truncated, foreign or empty file, no faces, no area, NaN, a face of missing
    vertices.
    """
    return _of_file(path, parse_mesh)


def _of_file(path: Path, parse: Callable[[bytes, str], Any]) -> Any:
    """What `parse` makes of the bytes and the suffix of a file; its errors name the file."""
    try:
        return parse(path.read_bytes(), path.suffix.lower())
    except MeshError as error:
        raise MeshError(f"{path}: {error}") from error


def parse_mesh(content: bytes, suffix: str) -> Mesh:
    """The mesh in the bytes of a file with this suffix, as `read_mesh`; the MeshError names no file."""
    if suffix.lower() == ".off":
        return _parse_off(content)
    mesh = _load(content, suffix.lower())
    if not isinstance(mesh, trimesh.Trimesh):
        raise MeshError(f"expected a mesh, got a {type(mesh).__name__}")
    return Mesh(np.asarray(mesh.vertices, np.float64).reshape(-1, 3), np.asarray(mesh.faces, np.int64).reshape(-1, 3))


def read_vertices(path: Path) -> NDArray[np.float64]:
    """The points (v, 3) of a cloud in the order of the file, or the different vertices of a mesh.

    Reads the files of `read_mesh`. Raises MeshError that names the file: truncated, foreign or empty.
    """
    return _of_file(path, _vertices)


def _parse_off(content: bytes) -> Mesh:
    """The counts may stand on the header line (``OFF490 518 0``), as in many files of ModelNet40.

    trimesh reads OFF too, but five times slower, and takes a file that ends early for one with fewer faces.
    """
    text = content.decode("utf-8-sig", errors="replace")
    lines = [stripped for line in text.splitlines() if (stripped := line.partition("#")[0].strip())]
    header = re.match(r"(?:ST)?C?N?OFF\b|OFF(?=\d)", lines[0]) if lines else None
    if header is None:
        raise MeshError(f"expected `OFF` in the first line, got {text[:20]!r}")
    rest = lines[0][header.end() :].split()
    counts, body = (rest, lines[1:]) if rest else (lines[1].split() if len(lines) > 1 else [], lines[2:])
    if len(counts) < 2 or not all(count.isdecimal() for count in counts[:2]):
        raise MeshError(f"expected the numbers of vertices and faces after `OFF`, got {' '.join(counts)[:40]!r}")
    num_vertices, num_faces = int(counts[0]), int(counts[1])
    if len(body) < num_vertices + num_faces:
        raise MeshError(
            f"expected {num_vertices} vertices and {num_faces} faces, got {len(body)} lines: the file is truncated"
        )
    try:
        vertices = np.loadtxt(body[:num_vertices], usecols=(0, 1, 2), ndmin=2) if num_vertices else np.empty((0, 3))
        faces = _triangles(body[num_vertices : num_vertices + num_faces])
    except (ValueError, IndexError) as error:
        raise MeshError(f"expected vertices and faces as numbers, got something else ({error})") from error
    return Mesh(vertices, faces)


def _triangles(rows: Sequence[str]) -> NDArray[np.int64]:
    """Fans of the polygons in rows ``k i_1 ... i_k [colour]``; points and edges (k < 3) have no surface."""
    corners = np.array([int(row.split(None, 1)[0]) for row in rows])
    fans = [np.empty((0, 3), np.int64)]
    for count in np.unique(corners[corners >= 3]):
        same = [row for row, k in zip(rows, corners, strict=True) if k == count]
        polygons = np.loadtxt(same, usecols=range(1, count + 1), dtype=np.int64, ndmin=2)
        middle, last = polygons[:, 1:-1], polygons[:, 2:]
        fans.append(np.stack([np.broadcast_to(polygons[:, :1], middle.shape), middle, last], -1).reshape(-1, 3))
    return np.concatenate(fans)


def _vertices(content: bytes, suffix: str) -> NDArray[np.float64]:
    if suffix == ".off":
        return _different(_parse_off(content).vertices)
    vertices = _different(np.asarray(_load(content, suffix).vertices, np.float64))
    if not len(vertices):  # as a mesh, a cloud of points is empty
        vertices = np.asarray(getattr(_load(content, suffix, force=None), "vertices", ()), np.float64).reshape(-1, 3)
        declared = re.search(rb"^element vertex (\d+)", content, re.MULTILINE)
        expected = 1 if declared is None else int(declared[1])
        if len(vertices) < expected:  # trimesh takes a text file that ends early for one with fewer points
            raise MeshError(f"expected {expected} points, got {len(vertices)}")
    return vertices


def _different(vertices: NDArray[np.float64]) -> NDArray[np.float64]:
    _, first = np.unique(vertices, axis=0, return_index=True)
    return vertices[np.sort(first)]


def _load(content: bytes, suffix: str, *, force: Literal["mesh"] | None = "mesh") -> Any:
    """trimesh's mesh, or what it makes of the file."""
    if not content:
        raise MeshError("expected a mesh, got an empty file")
    try:
        # force: one mesh of all parts, each where the scene puts it; process: no search for equal vertices
        file = io.BytesIO(content)
        return trimesh.load(file, file_type=suffix[1:], force=force, process=False, skip_materials=True)
    except Exception as error:
        raise MeshError(f"expected a {suffix} mesh, got a file that trimesh cannot read ({error})") from error


@cache
def primitives() -> tuple[Mesh, ...]:
    """Solids of about unit radius: box, wedge, cylinder, cone, capsule, two tori, ball, tube, vase."""
    create = trimesh.creation
    profile = np.array([[0.0, -1.0], [0.7, -1.0], [0.3, -0.2], [0.9, 0.5], [0.5, 1.0], [0.0, 1.0]])
    solids = [
        create.box(extents=(2, 2, 2)),
        create.extrude_triangulation(np.array([[-1.0, -1.0], [1.0, -1.0], [-1.0, 1.0]]), np.array([[0, 1, 2]]), 1.5),
        create.cylinder(radius=1, height=2, sections=24),
        create.cone(radius=1, height=2, sections=24),
        create.capsule(radius=0.6, height=1, count=(12, 12)),
        create.torus(0.75, 0.25, 24, 10),
        create.torus(0.9, 0.1, 24, 8),
        create.icosphere(subdivisions=2),
        create.annulus(r_min=0.7, r_max=1, height=1.5, sections=24),
        create.revolve(profile, sections=24),
    ]
    return tuple(Mesh(np.asarray(s.vertices, np.float64), np.asarray(s.faces, np.int64)) for s in solids)


def sample_surface(mesh: Mesh, count: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """`count` points (count, 3) drawn uniformly by area from the triangles of a mesh.

    A triangle is drawn with probability proportional to its area, a point in it as a + u (b - a) + v (c - a) with
    (u, v) uniform in the unit square, folded over its diagonal.
    """
    cumulative = mesh.areas.cumsum()
    # side="right": a triangle without area is never drawn
    face = np.searchsorted(cumulative, rng.random(count) * cumulative[-1], side="right")
    a, b, c = (mesh.vertices[mesh.faces[face, i]] for i in range(3))
    u, v = rng.random((2, count, 1))
    over = u + v > 1
    u, v = np.where(over, 1 - u, u), np.where(over, 1 - v, v)
    return a + u * (b - a) + v * (c - a)


def normalise(points: NDArray[np.float64], mode: Normalisation) -> NDArray[np.float64]:
    """Put the surface samples (k, 3) of a mesh into a frame that does not depend on its units.

    unit_sphere: their mean at the origin, the farthest at distance 1. unit_cube: their bounding box centred, its
    longest side 1. none: as in the file.
    """
    if mode == "none":
        return points
    if mode == "unit_sphere":
        centred = points - points.mean(0)
        return centred / np.linalg.norm(centred, axis=-1).max()
    if mode == "unit_cube":
        low, high = points.min(0), points.max(0)
        return (points - (low + high) / 2) / (high - low).max()
    raise ValueError(f"expected `normalisation` unit_sphere, unit_cube or none, got {mode!r}")


def procedural_shape(rng: np.random.Generator) -> Mesh:
    """2 to 6 primitives, each stretched, tapered, turned and centred on the surface of an earlier one.

    Nothing is mirrored or repeated, so that a shape has one pose only, up to chance.
    """
    parts = [_part(rng, 1.0)]
    for _ in range(rng.integers(1, 6)):
        host = parts[rng.integers(len(parts))]
        part = _part(rng, rng.uniform(0.4, 0.9))
        parts.append(Mesh(part.vertices + sample_surface(host, 1, rng), part.faces))
    offsets = np.cumsum([0] + [len(part.vertices) for part in parts[:-1]])
    return Mesh(
        np.concatenate([part.vertices for part in parts]),
        np.concatenate([part.faces + offset for part, offset in zip(parts, offsets, strict=True)]),
    )


def _part(rng: np.random.Generator, size: float) -> Mesh:
    solid = primitives()[rng.integers(len(primitives()))]
    vertices = size * rng.uniform(0.2, 1.0, 3) * solid.vertices
    along = vertices[:, 2:] / np.abs(vertices[:, 2]).max()
    vertices = np.hstack([vertices[:, :2] * (1 + rng.uniform(-0.6, 0.6) * along), vertices[:, 2:]])
    return Mesh(vertices @ random_rotations(1, rng)[0].numpy().T, solid.faces)


@dataclass(frozen=True)
class ProceduralShapes:
    """The shapes of a split, read as `MeshFiles` are. No shape belongs to two splits or two seeds.

    Shape i does not depend on their number. Raises ValueError for none.
    """

    split: str
    seed: int
    numbers: range

    def __post_init__(self) -> None:
        if not self.numbers:
            raise ValueError(f"expected at least one procedural {self.split} shape, got {len(self.numbers)}")

    @property
    def names(self) -> Sequence[str]:
        return [f"procedural/{self.split}/{i:06d}" for i in self.numbers]

    @property
    def identity(self) -> str:
        return fingerprint(["procedural", VERSION, self.split, self.seed, list(self.numbers)])

    def part(self, start: int, stop: int) -> "ProceduralShapes":
        return replace(self, numbers=self.numbers[start:stop])

    def samples(self, name: str, count: int, mode: Normalisation) -> NDArray[np.float64]:
        rng = np.random.default_rng([self.seed, ("train", "val", "test").index(self.split), int(name[-6:])])
        return normalise(sample_surface(procedural_shape(rng), count, rng), mode)


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
