"""Procedural shapes: as many meshes as one likes, without a download."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from bpnp.datamodules.meshes.pools import SurfacePools, open_pools
from bpnp.datamodules.meshes.surfaces import Mesh, Normalisation, normalise, primitives, sample_surface

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
    turned = Rotation.from_quat(rng.standard_normal(4)).apply(vertices)  # uniform over the rotations
    return Mesh(turned, solid.faces)


def procedural_pools(
    split: str, count: int, *, seed: int, pool_size: int, normalisation: Normalisation, cache_dir: Path
) -> SurfacePools:
    """Surface samples of the `count` shapes of a split. No shape belongs to two splits or two seeds.

    Shape i does not depend on `count`. Raises ValueError for fewer than one shape.
    """
    if count < 1:
        raise ValueError(f"expected at least one procedural {split} shape, got {count}")

    def sample(i: int) -> NDArray[np.float64]:
        rng = np.random.default_rng([seed, SPLITS.index(split), i])
        return normalise(sample_surface(procedural_shape(rng), pool_size, rng), normalisation)

    return open_pools(
        cache_dir,
        label=f"procedural-{split}",
        inputs={"procedural": VERSION, "seed": seed, "normalisation": normalisation},
        names=[f"procedural/{split}/{i:06d}" for i in range(count)],
        sample=sample,
        pool_size=pool_size,
    )
