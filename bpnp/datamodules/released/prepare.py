"""The data sets that the authors of BPnPNet published, converted once into a store of pairs."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bpnp.datamodules.pair import Pair
from bpnp.datamodules.prepare import Prepared, Recipe, prepare
from bpnp.datamodules.released.files import FOCAL, SPLITS, AuthorsPart, find_parts, read_part
from bpnp.datamodules.store import Store, new_store
from bpnp.datamodules.stored_pairs import PAIRS, WIDTHS, add_pair, scene_rows
from bpnp.files import files_as_they_are, fingerprint


def prepare_preprocessed(source: Path, output: Path, *, dataset: str | None = None) -> Prepared:
    """The authors' pickles below `source` (see `find_parts`) as a store with the scenes train and test.

    Samples that cannot be used are left out and listed. Raises ValueError, StoreError, OSError or PickleError: nothing
    to convert, a bad pickle, no usable sample, another `output`.
    """
    store = prepare(released_recipe(source, dataset), output)
    counts = {split: int(len(released_rows(store, split))) for split in SPLITS}
    return Prepared(output, counts, store.skipped)


def released_recipe(source: Path, dataset: str | None) -> Recipe:
    """How the store of the authors' files below `source` is made."""
    name, parts = find_parts(source, dataset)
    return Recipe(
        kind=PAIRS,
        widths=WIDTHS,
        parameters={"dataset": name, "source": fingerprint(files_as_they_are(f for part in parts for f in part.files))},
        jobs=[(part, FOCAL.get(name, 1.0)) for part in parts],
        work=convert_part,
        what="sample",
        source=str(source),
    )


def convert_part(job: tuple[AuthorsPart, float], output: Path) -> None:
    """Write the store of the pickles of one folder."""
    part, focal = job
    with new_store(output, PAIRS, WIDTHS, durable=False) as writer:
        for sample, pair in read_part(part, focal=focal):
            if isinstance(pair, Pair):
                add_pair(writer, part.scene, pair)
            else:
                writer.skipped[sample] = str(pair)


def released_rows(store: Store, split: str) -> NDArray[np.int64]:
    """The pairs of a split's scenes, `train` or `train/...`."""
    rows = [rows for scene, rows in scene_rows(store).items() if scene.split("/")[0] == split]
    return np.sort(np.concatenate([*rows, np.empty(0, np.int64)]))
