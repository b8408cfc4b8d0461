"""Triangle meshes, from files or drawn; uniform samples of their surface; and collections of shapes to sample."""

import io
import math
import re
import zlib
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import trimesh
from numpy.typing import NDArray

from bpnp.bounded_files import MOST_BINARY, read_bytes
from bpnp.checks import check_within
from bpnp.files import fingerprint, name_bytes
from bpnp.geometry import random_rotations

SUFFIXES = (".glb", ".obj", ".off", ".ply", ".stl")
ProceduralKind = Literal["turned", "aligned"]
Normalisation = Literal["unit_sphere", "unit_cube", "none"]
VERSION = 1  # version of procedural shapes, raised whenever the same seed makes another one
PARTS = ("train", "val", "test")
Sampler = Callable[[int], NDArray[np.float64]]


class MeshError(ValueError):
    """File that is no usable mesh. The message names the file."""


@dataclass(frozen=True)
class Mesh:
    """Triangle mesh; triangles that are no surface are a MeshError."""

    vertices: NDArray[np.float64]  # (v, 3)
    faces: NDArray[np.int64]  # vertex indices of the triangles (f, 3)

    def __post_init__(self) -> None:
        if len(self.faces) == 0:
            raise MeshError("the mesh has no faces")
        if not np.isfinite(self.vertices).all():
            raise MeshError("a vertex is NaN or infinite")
        if self.faces.min() < 0 or self.faces.max() >= len(self.vertices):
            used = f"{self.faces.min()} to {self.faces.max()}"
            raise MeshError(f"the faces use the vertices {used}, but there are only {len(self.vertices)}")
        area = self.areas.sum()
        if not 0 < area < np.inf:
            raise MeshError(f"the surface needs a positive area; it has {area}")

    @property
    def areas(self) -> NDArray[np.float64]:
        """Area of each face (f,)."""
        a, b, c = (self.vertices[self.faces[:, i]] for i in range(3))
        return np.linalg.norm(np.cross(b - a, c - a), axis=-1) / 2


def read_mesh(path: Path) -> Mesh:
    """Read an .off, .ply, .obj, .stl or .glb file.

    The parts of a scene become one mesh; polygons become fans of triangles. An .obj file does not declare its number of
    faces, so that a truncated one is read as far as it goes. Raise MeshError if the file is truncated, foreign or
    empty, or the mesh has no faces, no area, NaN, or a face of missing vertices.
    """
    with open_mesh(path) as (content, suffix):
        if suffix == ".off":
            return _parse_off(content)
        mesh = _load(content, suffix)
        if not isinstance(mesh, trimesh.Trimesh):
            raise MeshError(f"the file holds a {type(mesh).__name__}, not a mesh")
        corners, faces = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64)
        return Mesh(corners.reshape(-1, 3), faces.reshape(-1, 3))


@contextmanager
def open_mesh(path: Path) -> Iterator[tuple[bytes, str]]:
    """Yield the bytes and the suffix of a file; a MeshError of the block gets its name."""
    try:
        yield read_bytes(path, MOST_BINARY), path.suffix.lower()
    except MeshError as error:
        raise MeshError(f"{path}: {error}") from error


def read_vertices(path: Path) -> tuple[NDArray[np.float64], dict[str, NDArray[np.float64]]]:
    """Read the points (v, 3) of a cloud in the order of the file, or the distinct vertices of a mesh (`read_mesh`).

    The properties of the points of a .ply cloud (v,) are returned by name. Raise MeshError if the file is truncated,
    foreign or empty.
    """
    with open_mesh(path) as (content, suffix):
        mesh = _parse_off(content) if suffix == ".off" else _load(content, suffix)
        vertices = np.asarray(mesh.vertices, np.float64)
        if len(vertices):
            return vertices[np.sort(np.unique(vertices, axis=0, return_index=True)[1])], {}
        return parse_cloud(content, suffix)  # trimesh reads a point cloud as an empty mesh


def parse_cloud(content: bytes, suffix: str) -> tuple[NDArray[np.float64], dict[str, NDArray[np.float64]]]:
    """Parse a file of points without faces: points (v, 3) in its order and, of a .ply, their properties (v,) by name.

    Raise MeshError if the file is truncated, foreign or empty.
    """
    cloud = _load(content, suffix, force=None)
    vertices = np.asarray(getattr(cloud, "vertices", ()), np.float64).reshape(-1, 3)
    if not len(vertices):
        raise MeshError("the file has 0 points")
    raw = getattr(cloud, "metadata", {}).get("_ply_raw", {}).get("vertex")
    if raw is None:
        return vertices, {}
    names = [name for name, kind in raw["properties"].items() if isinstance(kind, str)]  # a list has a tuple
    return vertices, {name: np.asarray(raw["data"][name], np.float64).reshape(len(vertices)) for name in names}


def _parse_off(content: bytes) -> Mesh:
    """Parse an OFF file. The counts may stand on the header line (``OFF490 518 0``), as in many files of ModelNet40.

    trimesh reads OFF too, but takes five times longer and reads a truncated file without an error.
    """
    text = content.decode("utf-8-sig", errors="replace")
    lines = [stripped for line in text.splitlines() if (stripped := line.partition("#")[0].strip())]
    header = re.match(r"(?:ST)?C?N?OFF\b|OFF(?=\d)", lines[0]) if lines else None
    if header is None:
        raise MeshError(f"the first line is {text[:20]!r}; an OFF file begins with `OFF`")
    rest = lines[0][header.end() :].split()
    counts, body = (rest, lines[1:]) if rest else (lines[1].split() if len(lines) > 1 else [], lines[2:])
    if len(counts) < 2 or not all(count.isdecimal() for count in counts[:2]):
        raise MeshError(f"after `OFF` stands {' '.join(counts)[:40]!r} instead of the numbers of vertices and faces")
    num_vertices, num_faces = int(counts[0]), int(counts[1])
    if len(body) < num_vertices + num_faces:
        raise MeshError(
            f"the file is truncated: it declares {num_vertices} vertices and {num_faces} faces in {len(body)} lines"
        )
    try:
        vertices = np.loadtxt(body[:num_vertices], usecols=(0, 1, 2), ndmin=2) if num_vertices else np.empty((0, 3))
        faces = _triangles(body[num_vertices : num_vertices + num_faces])
    except (ValueError, IndexError) as error:
        raise MeshError(f"vertices and faces are not numbers ({error})") from error
    return Mesh(vertices, faces)


def _triangles(rows: Sequence[str]) -> NDArray[np.int64]:
    """Split the polygons in rows ``k i_1 ... i_k [colour]`` into fans; points and edges (k < 3) have no surface."""
    corners = np.array([int(row.split(None, 1)[0]) for row in rows])
    fans = [np.empty((0, 3), np.int64)]
    for count in np.unique(corners[corners >= 3]):
        same = [row for row, k in zip(rows, corners, strict=True) if k == count]
        if any(len(row.split()) <= count for row in same):
            raise ValueError(f"a face states {count} corners, and has fewer")
        polygons = np.loadtxt(same, usecols=range(1, count + 1), dtype=np.int64, ndmin=2)
        second, third = polygons[:, 1:-1], polygons[:, 2:]
        fans.append(np.stack([np.broadcast_to(polygons[:, :1], second.shape), second, third], -1).reshape(-1, 3))
    return np.concatenate(fans)


def _load(content: bytes, suffix: str, *, force: Literal["mesh"] | None = "mesh") -> Any:
    """Return trimesh's mesh, or whatever else trimesh makes of the file."""
    if not content:
        raise MeshError("the file is empty")
    if suffix == ".ply":
        _check_ply_rows(content)
    try:
        # force: merge all parts, each at its position in the scene; process: do not merge equal vertices
        file = io.BytesIO(content)
        return trimesh.load(file, file_type=suffix[1:], force=force, process=False, skip_materials=True)
    except Exception as error:
        reason = str(error) or type(error).__name__
        raise MeshError(f"trimesh cannot read it as a {suffix} mesh ({reason})") from error


def _check_ply_rows(content: bytes) -> None:
    """Raise MeshError if a text .ply file has fewer rows than its header declares; trimesh leaves out what is missing.

    The last row may be cut too, but not within its last number, which no count can show.
    """
    header, _, body = content.partition(b"end_header")
    if not re.search(rb"^format\s+ascii", header, re.MULTILINE):
        return  # trimesh compares the size of a binary file
    elements: list[tuple[str, int, list[bool]]] = []  # name, rows, and whether each property is a list
    for line in header.decode(errors="replace").splitlines():
        match line.split():
            case ["element", name, count] if count.isdecimal():
                elements.append((name, int(count), []))
            case ["property", kind, *_] if elements:
                elements[-1][2].append(kind == "list")
    elements = [element for element in elements if element[1]]
    declared = sum(count for _, count, _ in elements)
    rows = [row for row in body.splitlines() if row.strip()][:declared]
    whole = len(rows) - (bool(rows) and len(rows) == declared and not _is_whole(rows[-1].split(), elements[-1][2]))
    if whole < declared:
        parts = ", ".join(f"{count} {name}" for name, count, _ in elements)
        raise MeshError(f"the file is truncated: its header declares {declared} rows ({parts}), and it has {whole}")


def _is_whole(row: Sequence[bytes], lists: Sequence[bool]) -> bool:
    """Return True if a row of a .ply file has a number for each property, and all entries of its lists."""
    needed = 0
    for is_list in lists:
        if is_list and not (needed < len(row) and row[needed].isdigit()):
            return False
        needed += 1 + (int(row[needed]) if is_list else 0)
    return len(row) >= needed


def sample_surface(mesh: Mesh, count: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """Draw points (count, 3) uniformly by area from the triangles of a mesh.

    A triangle is drawn with probability proportional to its area, a point in it as a + u (b - a) + v (c - a) with (u,
    v) uniform in the unit square, folded over its diagonal.
    """
    cumulative = mesh.areas.cumsum()
    # side="right" never draws a triangle without area
    face = np.searchsorted(cumulative, rng.random(count) * cumulative[-1], side="right")
    a, b, c = (mesh.vertices[mesh.faces[face, i]] for i in range(3))
    u, v = rng.random((2, count, 1))
    over = u + v > 1
    u, v = np.where(over, 1 - u, u), np.where(over, 1 - v, v)
    return a + u * (b - a) + v * (c - a)


def normalise(points: NDArray[np.float64], mode: Normalisation) -> NDArray[np.float64]:
    """Transform the surface samples (k, 3) of a mesh to a frame that does not depend on its units.

    "unit_sphere": mean at the origin, farthest sample at distance 1. "unit_cube": bounding box centred, longest side 1.
    "none": unchanged. Raise MeshError if all samples coincide.
    """
    if mode not in get_args(Normalisation):
        raise ValueError(f"`normalisation` is {mode!r}; it is one of {', '.join(get_args(Normalisation))}")
    if mode == "none":
        return points
    low, high = points.min(0), points.max(0)
    if not (high > low).any():
        raise MeshError(f"all {len(points)} points coincide at {low.tolist()}; they have no size to normalise")
    if mode == "unit_sphere":
        centred = points - points.mean(0)
        return centred / np.linalg.norm(centred, axis=-1).max()
    return (points - (low + high) / 2) / (high - low).max()


@dataclass(frozen=True)
class Shapes:
    """Shapes to sample."""

    # By the name of each shape, a function from a number to that many points (k, 3) of its surface; fewer if the shape
    # is a point cloud of fewer points. The points depend only on the shape and its name. It raises MeshError for a file
    # that cannot be used.
    samplers: Mapping[str, Sampler]
    identity: str  # fingerprint that changes with any shape


def procedural_shapes(split: str, count: int, *, seed: int, kind: ProceduralKind = "turned") -> Shapes:
    """Return the shapes of a split: `procedural_shape` for "turned", `aligned_shape` for "aligned".

    No shape belongs to two splits or two seeds, and shape i does not depend on `count`, which is at least 1.
    """
    check_within(1, math.inf, **{f"{split}_shapes": count})
    if kind not in DRAWN:
        raise ValueError(f"`procedural_kind` is {kind!r}; it is one of {', '.join(DRAWN)}")
    name = NAMES[kind]
    samplers = {
        f"{name}/{split}/{i:06d}": partial(_procedural_samples, kind, (seed, PARTS.index(split), i))
        for i in range(count)
    }
    return Shapes(samplers, fingerprint([name, VERSION, split, seed, list(range(count))]))


def _procedural_samples(kind: ProceduralKind, seed: tuple[int, ...], count: int) -> NDArray[np.float64]:
    rng = np.random.default_rng(seed)
    return sample_surface(DRAWN[kind](rng), count, rng)


def procedural_shape(rng: np.random.Generator) -> Mesh:
    """Draw a shape of 2 to 6 primitives, each stretched, tapered, rotated and centred on the surface of an earlier one.

    Nothing is mirrored or repeated, so that a shape has only one pose, up to chance.
    """
    parts = [_part(rng, 1.0)]
    for _ in range(rng.integers(1, 6)):
        host = parts[rng.integers(len(parts))]
        part = _part(rng, rng.uniform(0.4, 0.9))
        parts.append(Mesh(part.vertices + sample_surface(host, 1, rng), part.faces))
    return _joined(parts)


def aligned_shape(rng: np.random.Generator) -> Mesh:
    """Draw a shape with axes, as furniture has: 2 to 8 parts parallel to the axes, each flush with an earlier one.

    Most parts are boxes and panels; some are turned about the x axis by up to 25 degrees. Of the shapes, 70 % are
    mirrored in the plane x = 0. Pairs of parts may be mirrored in y = 0 too, as the legs of a table.
    """
    symmetric = rng.random() < 0.7
    parts = [_aligned_part(rng, 1.0)]
    for _ in range(rng.integers(1, 8)):
        host = parts[rng.integers(len(parts))]
        part = _flush(_aligned_part(rng, rng.uniform(0.3, 1.0)), host, rng)
        low, high = host.vertices[:, 0].min(), host.vertices[:, 0].max()
        if symmetric and low < 0 < high and rng.random() < 0.5:
            low, high = part.vertices[:, 0].min(), part.vertices[:, 0].max()
            new = [Mesh(part.vertices - [(low + high) / 2, 0, 0], part.faces)]
        else:
            new = [part, _mirrored(part, 0)] if symmetric else [part]
        if host.vertices[:, 1].min() < 0 < host.vertices[:, 1].max() and rng.random() < 0.35:
            new += [_mirrored(one, 1) for one in new]
        parts += new
    return _joined(parts)


def _aligned_part(rng: np.random.Generator, size: float) -> Mesh:
    """Draw a box, a panel or another primitive with its axis along x, y or z."""
    box = rng.random() < 0.75
    solid = primitives()[0 if box else rng.integers(1, len(primitives()))]
    half = size * np.exp(rng.uniform(np.log(0.03 if box else 0.15), 0.0, 3))
    vertices = half * solid.vertices[:, rng.permutation(3)]
    if rng.random() < 0.15:
        angle = np.radians(rng.uniform(-25.0, 25.0))
        c, s = np.cos(angle), np.sin(angle)
        vertices = vertices @ np.array([[1.0, 0.0, 0.0], [0.0, c, s], [0.0, -s, c]])
    return Mesh(vertices, solid.faces)


def _flush(part: Mesh, host: Mesh, rng: np.random.Generator) -> Mesh:
    """Move a part against a face of the bounding box of another: to its middle, to an edge, or between."""
    low, high = host.vertices.min(0), host.vertices.max(0)
    own_low, own_high = part.vertices.min(0), part.vertices.max(0)
    middle, own_middle = (low + high) / 2, (own_low + own_high) / 2
    room = np.abs((high - low) - (own_high - own_low)) / 2
    place = rng.choice([-1.0, 0.0, 1.0, np.nan], 3)
    place = np.where(np.isnan(place), rng.uniform(-1, 1, 3), place)
    offset = middle - own_middle + room * place
    axis = rng.integers(3)
    inwards = 0.02 * (own_high - own_low)[axis]  # so that they touch
    outside = high[axis] - own_low[axis] - inwards if rng.random() < 0.5 else low[axis] - own_high[axis] + inwards
    offset[axis] = outside
    return Mesh(part.vertices + offset, part.faces)


def _mirrored(part: Mesh, axis: int) -> Mesh:
    return Mesh(part.vertices * np.where(np.arange(3) == axis, -1.0, 1.0), part.faces)


def _joined(parts: Sequence[Mesh]) -> Mesh:
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


@cache
def primitives() -> tuple[Mesh, ...]:
    """Return solids of about unit radius: box, wedge, cylinder, cone, capsule, two tori, ball, tube, vase."""
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


DRAWN: dict[ProceduralKind, Callable[[np.random.Generator], Mesh]] = {
    "turned": procedural_shape,
    "aligned": aligned_shape,
}


NAMES: dict[ProceduralKind, str] = {"turned": "procedural", "aligned": "aligned"}  # of the shapes and their stores


def shape_files(folder: Path, suffixes: Sequence[str] = SUFFIXES) -> dict[str, Path]:
    """Find <class>/{train,test}/<stem><suffix> in a folder, by ``<class>/<split>/<stem>``, training shapes first.

    Files of one folder with the same stem are named with their suffix. Raise ValueError if a class has two folders of
    one split, such as `train` and `Train`.
    """
    named: dict[str, list[Path]] = defaultdict(list)
    split_folders: dict[str, Path] = {}
    for path in sorted(folder.glob("*/[!.]*/[!.]*")):
        if path.suffix.lower() in suffixes and path.parent.name.lower() in ("train", "test") and path.is_file():
            split = f"{path.parent.parent.name}/{path.parent.name.lower()}"
            if (other := split_folders.setdefault(split, path.parent)) != path.parent:
                raise ValueError(f"{other} and {path.parent} are both the folder {split}; move their files into one")
            named[f"{split}/{path.stem}"].append(path)
    files = {
        name if len(paths) == 1 else f"{name}{path.suffix}": path for name, paths in named.items() for path in paths
    }
    return {name: files[name] for name in sorted(files, key=training_meshes_first)}


def training_meshes_first(name: str) -> tuple[bool, str]:
    """Return the sort key of the name of a shape: training shapes first."""
    return "/test/" in name, name


def mesh_shapes(files: Mapping[str, Path]) -> dict[str, Sampler]:
    """Return the sampler of each mesh file, by its name; the samples depend only on the mesh and the name."""
    return {name: partial(_mesh_samples, name, path) for name, path in files.items()}


def _mesh_samples(name: str, path: Path, count: int) -> NDArray[np.float64]:
    return sample_surface(read_mesh(path), count, np.random.default_rng(zlib.crc32(name_bytes(name))))
