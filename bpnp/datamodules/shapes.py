"""Collections of shapes to sample: procedural ones, and meshes in a folder."""

import math
import re
import zlib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray

from bpnp.checks import check_within
from bpnp.datamodules.surfaces import SUFFIXES, Mesh, read_mesh, sample_surface
from bpnp.files import files_as_they_are, fingerprint
from bpnp.geometry import random_rotations

VERSION = 1  # of procedural shapes, raised whenever the same seed makes another one
PARTS = ("train", "val", "test")
SPLITS = ("train", "test")
LAYOUT = f"<class>/{{train,test}}/*.{{{','.join(suffix[1:] for suffix in SUFFIXES)}}}"
ENTRY = re.compile(rf"(?:.*/)?([^/]+)/(train|test)/([^/.][^/]*)(?:{'|'.join(map(re.escape, SUFFIXES))})", re.I)
Sampler = Callable[[int], NDArray[np.float64]]


@dataclass(frozen=True)
class Shapes:
    """By the name of each shape a function that gives so many samples (k, 3) of its surface, or raises MeshError.

    The samples are a function of the shape and its name. identity: another one if any shape is another.
    """

    samplers: Mapping[str, Sampler]
    identity: str


def procedural_shapes(split: str, count: int, *, seed: int) -> Shapes:
    """The shapes of a split: train, val or test. No shape belongs to two splits or two seeds.

    Shape i does not depend on their number. Raises ValueError for none.
    """
    check_within(1, math.inf, **{f"{split}_shapes": count})
    samplers = {
        f"procedural/{split}/{i:06d}": partial(_procedural_samples, (seed, PARTS.index(split), i)) for i in range(count)
    }
    return Shapes(samplers, fingerprint(["procedural", VERSION, split, seed, list(range(count))]))


def _procedural_samples(seed: tuple[int, ...], count: int) -> NDArray[np.float64]:
    rng = np.random.default_rng(seed)
    return sample_surface(procedural_shape(rng), count, rng)


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


def open_shapes(source: Path) -> Shapes:
    """The meshes of `source`: the folder of ModelNet40, or any in its layout, or their parent.

    Their names are ``<class>/<split>/<stem>``; the training meshes come first. Raises ValueError that names the folder:
    missing, or without a mesh.
    """
    if not source.is_dir():
        raise ValueError(f"expected a folder with {LAYOUT}, got {source}, which is none; try unpacking its archive")
    for folder in (source, *sorted(path for path in source.iterdir() if path.is_dir())):
        if entries := _named(str(path) for path in folder.glob("*/*/*") if path.is_file()):
            meshes = {name: Path(path) for name, path in entries.items()}
            samplers = {name: partial(_mesh_samples, name, path) for name, path in meshes.items()}
            return Shapes(samplers, fingerprint([list(meshes), files_as_they_are(meshes.values())]))
    raise ValueError(f"expected a folder with {LAYOUT}, got {source} without; try its parent")


def _mesh_samples(name: str, path: Path, count: int) -> NDArray[np.float64]:
    return sample_surface(read_mesh(path), count, np.random.default_rng(zlib.crc32(name.encode())))


def _named(paths: Iterable[str]) -> dict[str, str]:
    """Path of each mesh by its name; others are no meshes."""
    meshes = (ENTRY.fullmatch(path) for path in paths)
    entries = {f"{mesh[1]}/{mesh[2].lower()}/{mesh[3]}": mesh[0] for mesh in meshes if mesh}
    order = sorted(entries, key=lambda name: (SPLITS.index(name.split("/")[-2]), name))
    return {name: entries[name] for name in order}
