"""Surface samples of many meshes in one memory-mapped file: built once, checked whenever it is opened."""

import contextlib
import hashlib
import json
import logging
import os
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track

from bpnp.datamodules.meshes.surfaces import MeshError

FORMAT = 1  # raised whenever the files below change their meaning

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class SurfacePools:
    """points (k, s, 3): s surface samples of each of k meshes, memory-mapped; the meshes' names; the largest |p|."""

    points: NDArray[np.float32]
    names: tuple[str, ...]
    radius: float

    def __len__(self) -> int:
        return len(self.names)


def open_pools(
    folder: Path,
    *,
    label: str,
    inputs: Mapping[str, Any],
    names: Sequence[str],
    sample: Callable[[int], NDArray[np.float64]],
    pool_size: int,
) -> SurfacePools:
    """Open the samples cached in `folder`, or build them: `sample(i)` gives the (pool_size, 3) points of mesh i.

    The cache is ``<label>-<key>.npy`` with the manifest ``<label>-<key>.json``; the key hashes the format, `inputs`,
    `names` and `pool_size`, so whatever changes the samples must be in `inputs`. The manifest holds a digest of itself
    and the samples: a cache that does not agree with it is built again, with a warning. Meshes for which `sample`
    raises MeshError are left out, with one warning for all of them. Two processes may build the same cache at once.

    Raises ValueError if no mesh can be used.
    """
    described = json.dumps([FORMAT, dict(inputs), list(names), pool_size], sort_keys=True)
    key = hashlib.blake2b(described.encode(), digest_size=8).hexdigest()
    points_path, manifest_path = (folder / f"{label}-{key}{suffix}" for suffix in (".npy", ".json"))
    if manifest_path.exists():
        try:
            return _open(points_path, manifest_path, key)
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            warnings.warn(f"surface cache {points_path} is broken ({error}); building it again", stacklevel=2)
    folder.mkdir(parents=True, exist_ok=True)
    with _temporary(points_path) as points_file, _temporary(manifest_path) as manifest_file:
        manifest = {"key": key} | _build(points_file, label=label, names=names, sample=sample, pool_size=pool_size)
        digest = _digest(points_file, manifest)
        manifest_file.write_text(json.dumps(manifest | {"digest": digest}, indent=1))
        os.replace(points_file, points_path)
        os.replace(manifest_file, manifest_path)  # last: a manifest promises complete samples
    logger.info("sampled %d meshes of %s into %s", len(manifest["names"]), label, points_path)
    return _open(points_path, manifest_path, key)


def _open(points_path: Path, manifest_path: Path, key: str) -> SurfacePools:
    manifest = json.loads(manifest_path.read_text())
    digest = manifest.pop("digest")
    if manifest["key"] != key or _digest(points_path, manifest) != digest:
        raise ValueError("samples and manifest do not agree")
    names, skipped = tuple(manifest["names"]), manifest["skipped"]
    if skipped:
        some = "; ".join(list(skipped.values())[:3])  # the reasons name the files
        warnings.warn(
            f"left out {len(skipped)} of {len(skipped) + len(names)} meshes, all listed in {manifest_path}: {some}",
            stacklevel=3,
        )
    points = np.asarray(np.load(points_path, mmap_mode="r"))[: len(names)]  # still mapped, no subclass
    return SurfacePools(points, names, manifest["radius"])


def _build(
    path: Path, *, label: str, names: Sequence[str], sample: Callable[[int], NDArray[np.float64]], pool_size: int
) -> dict[str, Any]:
    """Write the samples; the rows of meshes that were left out stay unused at the end of the file."""
    points = np.lib.format.open_memmap(path, mode="w+", dtype=np.float32, shape=(len(names), pool_size, 3))
    used: list[str] = []
    skipped: dict[str, str] = {}
    radius = 0.0
    for i in track(range(len(names)), f"sampling {label}", console=Console(stderr=True), transient=True):
        try:
            samples = sample(i)
        except MeshError as error:
            skipped[names[i]] = str(error)
            continue
        points[len(used)] = samples
        used.append(names[i])
        radius = max(radius, float(np.linalg.norm(samples, axis=-1).max()))
    if not used:
        raise ValueError(
            f"expected at least one usable mesh in {label}, got {len(skipped)} bad ones; the first: "
            f"{next(iter(skipped.values()))}"
        )
    points.flush()
    return {"names": used, "skipped": skipped, "radius": radius}


def _digest(points_path: Path, manifest: Mapping[str, Any]) -> str:
    with points_path.open("rb") as file:
        digest = hashlib.file_digest(file, "blake2b")
    digest.update(json.dumps(manifest, sort_keys=True).encode())
    return digest.hexdigest()


@contextlib.contextmanager
def _temporary(path: Path) -> Iterator[Path]:
    """A name beside `path` for this process, gone at the end whatever happens."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        yield temporary
    finally:
        temporary.unlink(missing_ok=True)
