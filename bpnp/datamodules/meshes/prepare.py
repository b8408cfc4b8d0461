"""Stores of surface samples: of a data set of meshes, or of procedural shapes."""

from collections import Counter
from pathlib import Path

import numpy as np

from bpnp.datamodules.meshes.archives import MeshFiles, open_archive
from bpnp.datamodules.meshes.procedural import ProceduralShapes
from bpnp.datamodules.meshes.source import POINTS, SURFACES
from bpnp.datamodules.meshes.surfaces import MeshError, Normalisation
from bpnp.datamodules.prepare import Prepared, Recipe, cached, prepare
from bpnp.datamodules.store import Store, StoreError, StoreWriter, is_store, open_store

MESHES_A_PART = 64
WIDTHS = {POINTS: 3}
MeshArchive = MeshFiles | ProceduralShapes


def prepare_meshes(
    source: Path, output: Path, *, points: int, normalisation: Normalisation, processes: int
) -> Prepared:  # fmt: skip
    """Keep `points` surface samples of every mesh of `source` (see `open_archive`), for `MeshDataModule(root=output)`.

    Meshes that cannot be used are left out and listed. If `output` has been made from the same source in the same way
    it is left as it is. Raises ValueError, StoreError or OSError: unusable source, no usable mesh, another `output`.
    """
    recipe = surfaces_recipe(open_archive(source), points=points, normalisation=normalisation, label=str(source))
    store = prepare(recipe, output, processes=processes)
    return Prepared(output, Counter(store.name(row).split("/")[-2] for row in range(len(store))), store.skipped)


def surfaces_recipe(archive: MeshArchive, *, points: int, normalisation: Normalisation, label: str) -> Recipe:
    """How the store of an archive's meshes is made. label: what the meshes are, for messages."""
    starts = range(0, len(archive.names), MESHES_A_PART)
    return Recipe(
        kind=SURFACES,
        widths=WIDTHS,
        parameters={"points": points, "normalisation": normalisation, "source": archive.identity},
        jobs=[(archive.part(start, start + MESHES_A_PART), points, normalisation) for start in starts],
        work=sample_part,
        what="mesh",
        source=label,
    )


def sample_part(writer: StoreWriter, archive: MeshArchive, count: int, mode: Normalisation) -> None:
    """Sample all meshes of an archive."""
    for name in archive.names:
        try:
            samples = archive.samples(name, count, mode)
        except (MeshError, OSError) as error:
            writer.skipped[name] = str(error)
        else:
            writer.add(name, {POINTS: samples}, radius=float(np.linalg.norm(samples, axis=-1).max()))


def open_surfaces(
    source: Path | ProceduralShapes, *, points: int, normalisation: Normalisation, cache_dir: str | None
) -> Store:
    """The store `source`, or the cached store of its meshes, made if it is not there.

    Raises ValueError as `open_archive`; StoreError for a store of another `normalisation`.
    """
    if isinstance(source, ProceduralShapes):
        archive: MeshArchive = source
        label = f"procedural-{source.split}"
    elif not is_store(source):
        archive, label = open_archive(source), source.resolve().name
    else:
        store = open_store(source, SURFACES)
        if (kept := store.parameters["normalisation"]) != normalisation:
            raise StoreError(
                f"expected meshes of `normalisation` {normalisation}, got {kept} in {source}; try {kept}, or preparing "
                f"again with --normalisation {normalisation}"
            )
        return store
    recipe = surfaces_recipe(archive, points=points, normalisation=normalisation, label=label)
    return cached(recipe, label, cache_dir)
