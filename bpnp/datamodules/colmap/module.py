"""Photos with known poses in COLMAP models: MegaDepth, or scenes of your own."""

import warnings
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from lightning import LightningDataModule
from lightning.pytorch.trainer.states import TrainerFn
from torch.utils.data import DataLoader

from bpnp.datamodules.colmap.model_files import ColmapError
from bpnp.datamodules.colmap.pairs import ColmapSource, Side
from bpnp.datamodules.colmap.reconstruction import Reconstruction, read_reconstruction
from bpnp.datamodules.colmap.scenes import find_scenes, split_scenes
from bpnp.datamodules.loader import PairSource, pair_loader
from bpnp.datamodules.manifest import is_store
from bpnp.datamodules.outliers import Outliers, harder
from bpnp.datamodules.pair_store import PairStore
from bpnp.datamodules.store_source import StoreSource
from bpnp.types import Batch

PARTS = {
    "fit": ("train", "val"),
    "validate": ("val",),
    "test": ("test",),
    "predict": ("predict",),
    None: ("train", "val", "test", "predict"),
}


class ColmapDataModule(LightningDataModule):
    """Photos with known poses in COLMAP models: MegaDepth, or scenes of your own.

    Scenes are split, not images, so that no landmark is both trained and tested on, as in Campbell et al. (ECCV 2020).
    A setup reads only the scenes of its stage. Works without a Trainer: `setup()`, then the loaders.

    Args:
        root: folder that `bpnp prepare megadepth` made; or folder of scenes, <scene>/sparse/0 or
            <scene>/sparse/manhattan/0 with cameras, images and points3D (.bin or .txt) in it; or one scene, one model,
            or a list of any of these.
        train_scenes: scenes to train on, or a text file with one a line; none for all that are left by the others.
        val_scenes: scenes to validate on, or a file; none to draw val_fraction.
        test_scenes: scenes to test and predict on, or a file; none to draw test_fraction.
        val_fraction: share of the scenes to validate on, drawn by seed.
        test_fraction: share of the scenes to test and predict on, drawn by seed; 1 for all.
        min_points: images that see fewer points are skipped; at least 4.
        max_points: largest number of true pairs of a training image, a random subset of more; none for all.
        fresh_subsets: draw new subsets, clutter and rotations every epoch in training.
        eval_max_points: the same in validation, testing and prediction, where it is fixed; none for all.
        clutter: natural clutter, as a ratio to the true pairs: keypoints without a 3D point, and points of the scene
            that the image does not see.
        clutter_side: the side that gets clutter, both, 2d or 3d.
        train_outliers: synthetic outliers and occlusion in training and validation; none for none.
        test_outliers: the same in testing and prediction.
        rotate: turn each pair's scene by a random rotation; never in prediction.
        batch_size: training pairs per step, over all processes.
        eval_batch_size: pairs per step in validation, testing and prediction; none for batch_size.
        max_cells: limit of pairs x 2D points x 3D points of such a step, to bound the memory; none for no limit.
        num_workers: loader processes.
        seed: of the split, the subsets, the clutter and the order.
    """

    def __init__(
        self,
        root: str | list[str],
        *,
        train_scenes: list[str] | str | None = None,
        val_scenes: list[str] | str | None = None,
        test_scenes: list[str] | str | None = None,
        val_fraction: float = 0.1,
        test_fraction: float = 0.2,
        min_points: int = 4,
        max_points: int | None = 1000,
        fresh_subsets: bool = True,
        eval_max_points: int | None = None,
        clutter: float = 0.0,
        clutter_side: Side = "both",
        train_outliers: Outliers | None = None,
        test_outliers: Outliers | None = None,
        rotate: bool = False,
        batch_size: int = 16,
        eval_batch_size: int | None = None,
        max_cells: int | None = 2**25,
        num_workers: int = 0,
        seed: int = 0,
    ) -> None:
        super().__init__()
        self.root = root
        self._split = partial(
            split_scenes,
            train=_scene_list("train_scenes", train_scenes),
            val=_scene_list("val_scenes", val_scenes),
            test=_scene_list("test_scenes", test_scenes),
            val_fraction=val_fraction,
            test_fraction=test_fraction,
            seed=seed,
        )
        self._options: dict[str, Any] = {"min_points": min_points, "clutter": clutter, "clutter_side": clutter_side}
        self.outliers = {"train": train_outliers, "val": train_outliers, "test": test_outliers}
        self.max_points, self.eval_max_points = max_points, eval_max_points
        self.fresh_subsets, self.rotate = fresh_subsets, rotate
        self.batch_size, self.eval_batch_size = batch_size, eval_batch_size or batch_size
        self.max_cells, self.num_workers, self.seed = max_cells, num_workers, seed
        self.sources: dict[str, PairSource] = {}
        self._read: dict[str, Reconstruction] = {}

    def setup(self, stage: str | None = None) -> None:
        """Read the scenes of a stage (fit, validate, test, predict; none for all).

        Raises ColmapError for folders without a usable model, ValueError for a split that does not fit the scenes or
        leaves none for the stage; fit does without validation scenes. A model that cannot be read is skipped with a
        warning if the part (train, val, test) has others.
        """
        store = PairStore(self.root) if isinstance(self.root, str) and is_store(self.root) else None
        scenes = dict.fromkeys(store.scenes, {}) if store else find_scenes(self.root)
        split = self._split(list(scenes))
        split["predict"] = split["test"]
        for part in PARTS[stage]:
            if split[part]:
                models = {scene: scenes[scene] for scene in split[part]}
                source = self._stored(store, split[part], part) if store else self._read_anew(models, part)
                outliers = self.outliers["test" if part == "predict" else part]
                fresh = self.fresh_subsets and part == "train"
                self.sources[part] = harder(source, outliers, seed=self.seed, fresh=fresh)
            elif stage is not None and (stage, part) != ("fit", "val"):
                name = stage.value if isinstance(stage, TrainerFn) else stage
                raise ValueError(
                    f"expected scenes for {name}, got none left of {', '.join(scenes)}; try to name them in the "
                    "*_scenes arguments, or other fractions"
                )

    def train_dataloader(self) -> DataLoader[Batch]:
        return self._loader("train")

    def val_dataloader(self) -> DataLoader[Batch] | list[DataLoader[Batch]]:
        return self._loader("val") if "val" in self.sources or not self.sources else []

    def test_dataloader(self) -> DataLoader[Batch]:
        return self._loader("test")

    def predict_dataloader(self) -> DataLoader[Batch]:
        return self._loader("predict")

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

    def _drawing(self, part: str) -> dict[str, Any]:
        """The options of a source, of either kind, for a part."""
        return self._options | {
            "max_points": self.max_points if part == "train" else self.eval_max_points,
            "rotate": self.rotate and part != "predict",
            "fresh": self.fresh_subsets and part == "train",
            "seed": self.seed,
        }

    def _stored(self, store: PairStore, scenes: list[str], part: str) -> StoreSource:
        wanted = [store.scenes.index(scene) for scene in scenes]
        return StoreSource(store, np.flatnonzero(np.isin(store.scene, wanted)), **self._drawing(part))

    def _read_anew(self, scenes: Mapping[str, Mapping[str, Path]], part: str) -> ColmapSource:
        return ColmapSource(self._reconstructions(scenes), **self._drawing(part))

    def _reconstructions(self, scenes: Mapping[str, Mapping[str, Path]]) -> list[Reconstruction]:
        found, failures = [], []
        for name, folder in (item for models in scenes.values() for item in models.items()):
            try:
                if name not in self._read:
                    self._read[name] = read_reconstruction(folder, name=name)
                found.append(self._read[name])
            except ColmapError as error:
                failures.append(error)
        if not found:
            raise failures[0]
        if failures:
            warnings.warn(
                f"skipped {len(failures)} of {len(found) + len(failures)} COLMAP models: "
                + "; ".join(map(str, failures[:4])),
                stacklevel=3,
            )
        return found


def _scene_list(name: str, scenes: list[str] | str | None) -> list[str] | None:
    """The scenes of a list, or of the lines of a text file."""
    if not isinstance(scenes, str):
        return scenes
    path = Path(scenes)
    if not path.is_file():
        raise ValueError(f"expected `{name}` as a list of scenes or a text file with one a line, got no file {path}")
    found = [line.strip() for line in path.read_text(encoding="utf-8").splitlines() if line.strip()]
    if not found:
        raise ValueError(f"expected `{name}` to name scenes, got {path} without a line; try none for no list")
    return found
