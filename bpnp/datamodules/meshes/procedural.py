"""Procedural shapes: any number of random meshes, without a download."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bpnp.datamodules.meshes.surfaces import Mesh, Normalisation, normalise, primitives, sample_surface
from bpnp.files import fingerprint
from bpnp.geometry import random_rotations

VERSION = 1  # raised whenever the same seed makes another shape

SPLITS = ("train", "val", "test")


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
        rng = np.random.default_rng([self.seed, SPLITS.index(self.split), int(name[-6:])])
        return normalise(sample_surface(procedural_shape(rng), count, rng), mode)
