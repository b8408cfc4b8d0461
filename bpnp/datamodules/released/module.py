"""The data sets that the authors of BPnPNet published."""

from pathlib import Path
from typing import Any

from bpnp.datamodules.augment import Augmentation
from bpnp.datamodules.meshes.source import hold_out
from bpnp.datamodules.module import PairDataModule
from bpnp.datamodules.prepare import cached
from bpnp.datamodules.released.prepare import released_recipe, released_rows
from bpnp.datamodules.store import Store, is_store, open_store
from bpnp.datamodules.stored_pairs import PAIRS, StoredPairs, check_limits


class PreprocessedDataModule(PairDataModule):
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
        rotate: turn the 3D points of each training pair by a random rotation.
        cache_dir: where the authors' files are converted to; none for BPNP_CACHE, else the user's cache folder.
        loading: options of `PairDataModule`: batch_size, eval_batch_size, train_outliers, test_outliers, seed, ...
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
        rotate: bool = False,
        cache_dir: str | None = None,
        **loading: Any,
    ) -> None:
        super().__init__(**loading)
        check_limits(min_points, max_points, eval_max_points)
        self.root, self.dataset, self.cache_dir = Path(root), dataset, cache_dir
        self._pairs: Store | None = None
        self.val_fraction, self.min_points, self.fresh = val_fraction, min_points, fresh_subsets
        evaluation = Augmentation(eval_max_points, clutter=0.0)
        self.augmentations = dict.fromkeys(("val", "test", "predict"), evaluation)
        self.augmentations["train"] = Augmentation(max_points, clutter=0.0, rotate=rotate)

    def prepare_data(self) -> None:
        """Convert in one process, for `setup` to open in all."""
        self._store()

    def _source(self, part: str, seed: tuple[int, int]) -> StoredPairs:
        store = self._store()
        if part in ("test", "predict"):
            return StoredPairs(store, released_rows(store, "test"), min_points=self.min_points)
        rows = released_rows(store, "train")
        training, held_out = hold_out(len(rows), self.val_fraction, seed=self.seed)
        return StoredPairs(store, rows[training if part == "train" else held_out], min_points=self.min_points)

    def _store(self) -> Store:
        """The pairs, opened once, and converted now if they are not."""
        if self._pairs is None and is_store(self.root):
            self._pairs = open_store(self.root, PAIRS)
        elif self._pairs is None:
            recipe = released_recipe(self.root, self.dataset)
            self._pairs = cached(recipe, str(recipe.parameters["dataset"]), self.cache_dir)
        return self._pairs
