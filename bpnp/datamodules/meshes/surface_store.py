"""Surface samples of a data set of meshes in one memory-mapped file, made once by `bpnp prepare`."""

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bpnp.datamodules.manifest import StoreError, new_store, read_manifest, write_manifest
from bpnp.datamodules.meshes.pools import SurfacePools

KIND = "surfaces"


@dataclass(frozen=True)
class SurfaceStore:
    """points (k, s, 3): s surface samples of each of k meshes, memory-mapped; names ``<class>/<split>/<stem>``."""

    folder: Path
    points: NDArray[np.float32]
    names: tuple[str, ...]
    radii: NDArray[np.float64]
    parameters: dict[str, Any]
    skipped: dict[str, str]

    def pools(self, split: str, *, pool_size: int) -> SurfacePools:
        """The first `pool_size` samples of the meshes of a split. StoreError for no such split, or fewer samples."""
        rows = [i for i, name in enumerate(self.names) if _split(name) == split]
        if not rows:
            raise StoreError(f"expected meshes of the split {split!r} in {self.folder}, got none; try preparing again")
        if pool_size > self.points.shape[1]:
            raise StoreError(
                f"expected `pool_size` of at most {self.points.shape[1]}, the samples in {self.folder}, got "
                f"{pool_size}; try that, or preparing again with --points {pool_size}"
            )
        block = slice(rows[0], rows[-1] + 1)  # the meshes of a split are written one after the other
        return SurfacePools(self.points[block, :pool_size], self.names[block], float(self.radii[block].max()))


def open_surfaces(folder: str | Path) -> SurfaceStore:
    """Open what `write_surfaces` wrote, reading it once to compare digests. Raises StoreError that names the folder."""
    path = Path(folder)
    manifest = read_manifest(path, kind=KIND)
    names = tuple((path / "names.txt").read_text(encoding="utf-8").splitlines())
    shape = (len(names), manifest["parameters"]["points"], 3)
    points = np.memmap(path / "points.bin", "<f4", mode="r", shape=shape) if names else np.empty(shape, np.float32)
    radii = np.fromfile(path / "radii.bin", "<f8")
    return SurfaceStore(path, np.asarray(points), names, radii, manifest["parameters"], manifest["skipped"])


def write_surfaces(
    folder: Path,
    meshes: Iterable[tuple[str, NDArray[np.floating]]],
    *,
    parameters: Mapping[str, Any],
    skipped: Mapping[str, str],
) -> None:
    """Write (name, samples (s, 3)) after (name, samples) into the new `folder`; complete or not there at all.

    parameters: kept in the manifest, must be JSON; "points" is s. The meshes of a split must follow each other.
    Raises StoreError if the folder exists.
    """
    counts = Counter[str]()
    with new_store(folder) as unfinished:
        with (
            (unfinished / "points.bin").open("wb") as points_file,
            (unfinished / "radii.bin").open("wb") as radii_file,
            (unfinished / "names.txt").open("w", encoding="utf-8") as names_file,
        ):
            for name, samples in meshes:
                points_file.write(np.ascontiguousarray(samples, "<f4").tobytes())
                radii_file.write(np.float64(np.linalg.norm(samples, axis=-1).max()).tobytes())
                names_file.write(f"{name}\n")
                counts[_split(name)] += 1
        content = {"kind": KIND, "counts": dict(counts), "skipped": dict(skipped), "parameters": dict(parameters)}
        write_manifest(unfinished, content, digested=("points.bin", "radii.bin", "names.txt"))


def _split(name: str) -> str:
    return name.split("/")[-2]
