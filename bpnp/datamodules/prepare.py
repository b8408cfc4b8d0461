"""From a data set as it was published to one of our stores, in parallel; a killed run goes on where it was."""

import warnings
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bpnp.datamodules.colmap.model_files import FILES, ColmapError
from bpnp.datamodules.colmap.pairs import ColmapSource
from bpnp.datamodules.colmap.reconstruction import read_reconstruction
from bpnp.datamodules.colmap.scenes import find_scenes
from bpnp.datamodules.loader import Pair
from bpnp.datamodules.manifest import StoreError, fingerprint
from bpnp.datamodules.meshes.archives import MeshArchive, open_archive
from bpnp.datamodules.meshes.surface_store import open_surfaces, write_surfaces
from bpnp.datamodules.meshes.surfaces import MeshError, Normalisation
from bpnp.datamodules.pair_store import PairStore, write_pairs
from bpnp.datamodules.parts import make_once, make_parts

MESHES_A_PART = 64


@dataclass(frozen=True)
class Prepared:
    """What is in a new store: counts by kind, and what was left out and why, by name."""

    folder: Path
    counts: Mapping[str, int]
    skipped: Mapping[str, str]


def prepare_meshes(
    source: Path, output: Path, *, points: int, normalisation: Normalisation, processes: int
) -> Prepared:  # fmt: skip
    """Keep `points` surface samples of every mesh of `source` (see `open_archive`), for `MeshDataModule(root=output)`.

    Meshes that cannot be used are left out and listed. If `output` has been made from the same source in the same way
    it is left as it is. Raises ValueError, StoreError or OSError: unusable source, no usable mesh, another `output`.
    """
    archive = open_archive(source)
    parameters = {"points": points, "normalisation": normalisation, "source": fingerprint(archive.files)}

    def make(folder: Path) -> None:
        names = archive.names
        batches = [names[i : i + MESHES_A_PART] for i in range(0, len(names), MESHES_A_PART)]
        jobs = [(archive.part(batch), points, normalisation) for batch in batches]
        parts = make_parts(folder, jobs, sample_part, processes=processes, label="sampling meshes")
        skipped = {name: reason for part in parts for name, reason in open_surfaces(part).skipped.items()}
        if len(skipped) == len(names):
            raise nothing_usable("mesh", source, skipped)
        write_surfaces(folder / "store", _meshes_of(parts), parameters=parameters, skipped=skipped)

    make_once(output, parameters, make)
    store = open_surfaces(output)
    return Prepared(output, Counter(name.split("/")[-2] for name in store.names), store.skipped)


def prepare_colmap(source: Path, output: Path, *, min_points: int, clutter: float, processes: int) -> Prepared:
    """The pairs of every image of every COLMAP model below `source`, for `ColmapDataModule(root=output)`.

    Images with fewer than `min_points` true pairs, and models that cannot be read, are left out and listed. `clutter`:
    natural clutter to keep on both sides, as a ratio to the true pairs. Output and errors as `prepare_meshes`.
    """
    scenes = find_scenes(source)
    models = [(scene, name, folder) for scene in scenes for name, folder in scenes[scene].items()]
    found = (folder / f"{file}.{suffix}" for _, _, folder in models for file in FILES for suffix in ("bin", "txt"))
    inputs = fingerprint(file for file in found if file.is_file())
    parameters = {"min_points": min_points, "clutter": clutter, "source": inputs}

    def make(folder: Path) -> None:
        jobs = [(*model, min_points, clutter) for model in models]
        parts = make_parts(folder, jobs, read_part, processes=processes, label="reading COLMAP models")
        skipped = {name: reason for part in parts for name, reason in PairStore(part).skipped.items()}
        if not any(len(PairStore(part)) for part in parts):
            raise nothing_usable("image", source, skipped)
        write_pairs(folder / "store", _pairs_of(parts), parameters=parameters, skipped=skipped)

    make_once(output, parameters, make)
    store = PairStore(output)
    return Prepared(output, {"scenes": len(store.scenes), "pairs": len(store)}, store.skipped)


def sample_part(job: tuple[MeshArchive, int, Normalisation], path: Path) -> None:
    """Write the store of some meshes."""
    archive, count, mode = job
    usable: list[tuple[str, NDArray[np.float64]]] = []
    skipped: dict[str, str] = {}
    for name in archive.names:
        try:
            usable.append((name, archive.samples(name, count, mode)))
        except (MeshError, OSError) as error:
            skipped[name] = str(error)
    write_surfaces(path, usable, parameters={"points": count}, skipped=skipped)


def read_part(job: tuple[str, str, Path, int, float], path: Path) -> None:
    """Write the store of one COLMAP model; an empty one if it cannot be used."""
    scene, name, folder, min_points, clutter = job
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the images left out are counted here
            source = ColmapSource([read_reconstruction(folder, name=name)], min_points=min_points, clutter=clutter)
    except ColmapError as error:
        write_pairs(path, [], parameters={}, skipped={name: str(error)})
        return
    total = source.skipped + len(source.images)
    skipped = {f"{name}/*": f"{source.skipped} of {total} images with fewer than {min_points} points"}
    pairs = ((scene, source.pair(i, 0)) for i in range(len(source.images)))
    write_pairs(path, pairs, parameters={}, skipped=skipped if source.skipped else {})


def _meshes_of(parts: Sequence[Path]) -> Iterator[tuple[str, NDArray[np.float32]]]:
    for part in parts:
        store = open_surfaces(part)
        yield from zip(store.names, store.points, strict=True)


def _pairs_of(parts: Sequence[Path]) -> Iterator[tuple[str, Pair]]:
    for part in parts:
        store = PairStore(part)
        for i in range(len(store)):
            yield store.scenes[store.scene[i]], store.pair(i)


def nothing_usable(what: str, source: Path, skipped: Mapping[str, str]) -> StoreError:
    first = next(iter(skipped.values()), "none found")
    return StoreError(
        f"expected at least one usable {what} in {source}, got {len(skipped)} that are not; the first: {first}"
    )
