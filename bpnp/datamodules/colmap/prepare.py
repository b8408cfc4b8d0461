"""The store of all pairs of COLMAP models: MegaDepth, or scenes of your own."""

import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from bpnp.datamodules.colmap.model_files import FILES, ColmapError
from bpnp.datamodules.colmap.pairs import ColmapSource
from bpnp.datamodules.colmap.reconstruction import read_reconstruction
from bpnp.datamodules.colmap.scenes import find_scenes
from bpnp.datamodules.prepare import Prepared, Recipe, prepare
from bpnp.datamodules.store import StoreError, StoreWriter
from bpnp.datamodules.stored_pairs import PAIRS, WIDTHS, add_pair, scene_rows
from bpnp.files import files_as_they_are, fingerprint


def prepare_colmap(source: Path, output: Path, *, min_points: int, clutter: float, processes: int) -> Prepared:
    """The pairs of every image of every COLMAP model below `source`, for `ColmapDataModule(root=output)`.

    Images with fewer than `min_points` true pairs, and models that cannot be read, are left out and listed. `clutter`:
    natural clutter to keep on both sides, as a ratio to the true pairs. Output and errors as `prepare_meshes`.
    """
    scenes = find_scenes(source)
    models = [(scene, name, folder) for scene in scenes for name, folder in scenes[scene].items()]
    found = (folder / f"{file}.{suffix}" for _, _, folder in models for file in FILES for suffix in ("bin", "txt"))
    names = [name for _, name, _ in models]
    recipe = Recipe(
        kind=PAIRS,
        widths=WIDTHS,
        parameters={
            "min_points": min_points,
            "clutter": clutter,
            "source": fingerprint([names, files_as_they_are(file for file in found if file.is_file())]),
        },
        jobs=[(*model, min_points, clutter) for model in models],
        work=read_part,
        what="image",
        source=str(source),
    )
    store = prepare(recipe, output, processes=processes)
    return Prepared(output, {"scenes": len(scene_rows(store)), "pairs": len(store)}, store.skipped)


def read_part(writer: StoreWriter, scene: str, name: str, folder: Path, min_points: int, clutter: float) -> None:
    """The pairs of one COLMAP model; none if it cannot be used.

    What was not used of it is listed, not logged: there may be hundreds of models.
    """
    with silent(logging.getLogger(__package__)):
        try:
            reconstruction = read_reconstruction(folder, name=name)
            source = ColmapSource([reconstruction], min_points=min_points, clutter=clutter)
        except (ColmapError, StoreError) as error:
            writer.skipped[name] = str(error)
            return
        total = len(reconstruction.images)
        if left_out := total - len(source.images):
            writer.skipped[f"{name}/*"] = f"{left_out} of {total} images with fewer than {min_points} points"
        if reconstruction.notable:
            writer.skipped[f"{name}/points"] = reconstruction.notable
        for i in range(len(source.images)):
            add_pair(writer, scene, source.pair(i))


@contextmanager
def silent(logger: logging.Logger) -> Iterator[None]:
    """No messages below errors of a logger and of those under it, and no warnings."""
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logger.setLevel(level)
