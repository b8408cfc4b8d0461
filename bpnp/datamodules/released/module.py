"""The data sets that the authors of BPnPNet published, converted once into a packed store."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from lightning import LightningDataModule
from numpy.typing import NDArray
from torch.utils.data import DataLoader

from bpnp.datamodules.loader import STAGES, Pair, PairSource, pair_loader
from bpnp.datamodules.manifest import fingerprint, is_store
from bpnp.datamodules.meshes.source import hold_out
from bpnp.datamodules.outliers import Outliers, harder
from bpnp.datamodules.pair_store import PairStore, write_pairs
from bpnp.datamodules.parts import make_once
from bpnp.datamodules.prepare import Prepared, nothing_usable
from bpnp.datamodules.released.files import FOCAL, SPLITS, find_parts, read_part
from bpnp.datamodules.store_source import StoreSource
from bpnp.types import Batch


def prepare_preprocessed(source: Path, output: Path, *, dataset: str | None = None) -> Prepared:
    """The authors' pickles below `source` (see `find_parts`) as a store with the scenes train and test.

    Samples that cannot be used are left out and listed. Raises ValueError, StoreError, OSError or PickleError: nothing
    to convert, a bad pickle, no usable sample, another `output`.
    """
    name, parts = find_parts(source, dataset)
    parameters = {"dataset": name, "source": fingerprint(file for part in parts for file in part.files)}
    skipped: dict[str, str] = {}

    def usable() -> Iterator[tuple[str, Pair]]:
        for part in parts:
            for sample, pair in read_part(part, focal=FOCAL.get(name, 1.0)):
                if isinstance(pair, Pair):
                    yield part.scene, pair
                else:
                    skipped[sample] = str(pair)

    def make(folder: Path) -> None:
        write_pairs(folder / "store", usable(), parameters=parameters, skipped=skipped)
        if not len(PairStore(folder / "store")):
            raise nothing_usable("sample", source, skipped)

    make_once(output, parameters, make)
    store = PairStore(output)
    counts = {split: int(len(_rows(store, split))) for split in SPLITS}
    return Prepared(output, counts, store.skipped)


class PreprocessedDataModule(LightningDataModule):
    """The pairs that Campbell et al. (ECCV 2020) published, with their split; validation pairs are held out at random.

    Works without a Trainer: `setup()`, then the loaders.

    Args:
        root: folder that `bpnp prepare preprocessed` made, or the authors' folder with <dataset>_{train,test} in it,
            which is then converted once into cache_dir.
        dataset: modelnet40, megadepth or data61_2d3d; none for the only one that is there.
        val_fraction: share of the training pairs that is held out for validation.
        min_points: pairs with fewer true pairs are left out; at least 4.
        max_points: largest number of true pairs in training, a random subset of more; none for all.
        fresh_subsets: draw new subsets, outliers and rotations every epoch in training.
        eval_max_points: the same as max_points in validation, testing and prediction, where it is fixed.
        train_outliers: synthetic outliers and occlusion in training and validation; none for none.
        test_outliers: the same in testing and prediction.
        rotate: turn the 3D points of each training pair by a random rotation.
        batch_size: training pairs per step, over all processes.
        eval_batch_size: pairs per step in validation, testing and prediction; none for batch_size.
        max_cells: limit of pairs x 2D points x 3D points of such a step, to bound the memory; none for no limit.
        num_workers: loader processes.
        seed: of the held-out pairs, the subsets, the outliers and the order.
        cache_dir: where the authors' files are converted to.
    """

    def __init__(
        self,
        root: str,
        *,
        dataset: str | None = None,
        val_fraction: float = 0.05,
        min_points: int = 4,
        max_points: int | None = 1000,
        fresh_subsets: bool = True,
        eval_max_points: int | None = None,
        train_outliers: Outliers | None = None,
        test_outliers: Outliers | None = None,
        rotate: bool = False,
        batch_size: int = 16,
        eval_batch_size: int | None = None,
        max_cells: int | None = 2**25,
        num_workers: int = 0,
        seed: int = 0,
        cache_dir: str = ".cache/bpnp",
    ) -> None:
        super().__init__()
        self.root, self.dataset, self.cache_dir = Path(root), dataset, Path(cache_dir)
        self.val_fraction, self.min_points, self.rotate = val_fraction, min_points, rotate
        self.max_points, self.eval_max_points, self.fresh_subsets = max_points, eval_max_points, fresh_subsets
        self.outliers = {"train": train_outliers, "val": train_outliers, "test": test_outliers}
        self.batch_size, self.eval_batch_size = batch_size, eval_batch_size or batch_size
        self.max_cells, self.num_workers, self.seed = max_cells, num_workers, seed
        self.sources: dict[str, PairSource] = {}

    def prepare_data(self) -> None:
        """Convert in one process, for `setup` to open in all."""
        self._folder()

    def setup(self, stage: str | None = None) -> None:
        """Open the pairs of a stage (fit, validate, test, predict; none for all). Raises ValueError for bad data."""
        store = PairStore(self._folder())
        for part in ("train", "val", "test") if stage is None else STAGES[stage]:
            fresh = self.fresh_subsets and part == "train"
            source = StoreSource(
                store,
                self._rows(store, part),
                min_points=self.min_points,
                max_points=self.max_points if part == "train" else self.eval_max_points,
                rotate=self.rotate and part == "train",
                fresh=fresh,
                seed=self.seed,
            )
            self.sources[part] = harder(source, self.outliers[part], seed=self.seed, fresh=fresh)

    def train_dataloader(self) -> DataLoader[Batch]:
        return self._loader("train")

    def val_dataloader(self) -> DataLoader[Batch]:
        return self._loader("val")

    def test_dataloader(self) -> DataLoader[Batch]:
        return self._loader("test")

    def predict_dataloader(self) -> DataLoader[Batch]:
        return self._loader("test")

    def _loader(self, part: str) -> DataLoader[Batch]:
        if part not in self.sources:
            raise ValueError(f"expected `setup` before the {part} loader, got no call; try `setup()`")
        training = part == "train"
        return pair_loader(
            self.sources[part],
            batch_size=self.batch_size if training else self.eval_batch_size,
            shuffle=training,
            seed=self.seed,
            num_workers=self.num_workers,
            max_cells=None if training else self.max_cells,
        )

    def _folder(self) -> Path:
        if is_store(self.root):
            return self.root
        name, parts = find_parts(self.root, self.dataset)
        key = fingerprint(file for part in parts for file in part.files)
        return prepare_preprocessed(self.root, self.cache_dir / f"{name}-{key[:16]}", dataset=name).folder

    def _rows(self, store: PairStore, part: str) -> NDArray[np.int64]:
        rows = _rows(store, "test" if part == "test" else "train")
        if part == "test":
            return rows
        training, held_out = hold_out(len(rows), self.val_fraction, seed=self.seed)
        return rows[training if part == "train" else held_out]


def _rows(store: PairStore, split: str) -> NDArray[np.int64]:
    """The pairs of a split's scenes, `train` or `train/...`."""
    wanted = [i for i, scene in enumerate(store.scenes) if scene.split("/")[0] == split]
    return np.flatnonzero(np.isin(store.scene, wanted))
