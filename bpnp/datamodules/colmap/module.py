"""Photos with known poses in COLMAP models: MegaDepth, or scenes of your own."""

import warnings
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from lightning.pytorch.trainer.states import TrainerFn

from bpnp.datamodules.augment import Augmentation, Side
from bpnp.datamodules.colmap.model_files import ColmapError
from bpnp.datamodules.colmap.pairs import ColmapSource
from bpnp.datamodules.colmap.reconstruction import Reconstruction, read_reconstruction
from bpnp.datamodules.colmap.scenes import find_scenes, split_scenes
from bpnp.datamodules.module import STAGES, PairDataModule
from bpnp.datamodules.pair import PairSource
from bpnp.datamodules.store import Store, StoreError, is_store, open_store
from bpnp.datamodules.stored_pairs import PAIRS, StoredPairs, check_limits, scene_rows


class ColmapDataModule(PairDataModule):
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
        rotate: turn each pair's scene by a random rotation; never in prediction.
        loading: options of `PairDataModule`: batch_size, eval_batch_size, train_outliers, test_outliers, seed, ...
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
        rotate: bool = False,
        **loading: Any,
    ) -> None:
        super().__init__(**loading)
        check_limits(min_points, max_points, eval_max_points)
        if not clutter < np.inf:
            raise ValueError(f"expected a finite `clutter`, got {clutter}; 0.5 adds half as many points")
        self.root, self.min_points, self.fresh = root, min_points, fresh_subsets
        training = Augmentation(max_points, clutter, clutter_side, rotate)
        evaluation = replace(training, max_points=eval_max_points)
        self.augmentations = {"train": training, "val": evaluation, "test": evaluation}
        self.augmentations["predict"] = replace(evaluation, rotate=False)
        self.clutter = clutter
        self._split = partial(
            split_scenes,
            train=_scene_list("train_scenes", train_scenes),
            val=_scene_list("val_scenes", val_scenes),
            test=_scene_list("test_scenes", test_scenes),
            val_fraction=val_fraction,
            test_fraction=test_fraction,
            seed=self.seed,
        )
        self._store: Store | None = None
        self._scenes: dict[str, Any] = {}  # of each scene its rows in the store, or its models
        self._read: dict[str, Reconstruction] = {}

    def setup(self, stage: str | None = None) -> None:
        """Read the scenes of a stage (fit, validate, test, predict; none for all).

        Raises ColmapError for folders without a usable model, ValueError for a split that does not fit the scenes or
        leaves none for the stage; fit does without validation scenes. A model that cannot be read is skipped with a
        warning if the part (train, val, test) has others.
        """
        self._store = open_store(self.root, PAIRS) if isinstance(self.root, str) and is_store(self.root) else None
        self._scenes = scene_rows(self._store) if self._store else find_scenes(self.root)
        self._parts = self._split(list(self._scenes))
        if self._store and self.clutter > (kept := self._store.parameters.get("clutter", np.inf)):
            raise StoreError(
                f"expected `clutter` of at most {kept}, what {self.root} was made with, got {self.clutter}; try that, "
                f"or preparing again with --clutter {self.clutter}"
            )
        super().setup(stage)
        if stage is not None and STAGES[stage][0] not in self.datasets:
            name = stage.value if isinstance(stage, TrainerFn) else stage
            raise ValueError(
                f"expected scenes for {name}, got none left of {', '.join(self._scenes)}; try to name them in the "
                "*_scenes arguments, or other fractions"
            )

    def _source(self, part: str, seed: tuple[int, int]) -> PairSource | None:
        """The pairs of a part's scenes; None if it has no scenes."""
        scenes = [self._scenes[scene] for scene in self._parts["test" if part == "predict" else part]]
        if not scenes:
            return None
        if self._store is not None:
            return StoredPairs(self._store, np.sort(np.concatenate(scenes)), min_points=self.min_points)
        models = {name: folder for models in scenes for name, folder in models.items()}
        return ColmapSource(self._models(models), min_points=self.min_points, clutter=self.clutter, seed=seed)

    def _models(self, folders: Mapping[str, Path]) -> list[Reconstruction]:
        found, failures = [], []
        for name, folder in folders.items():
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
                f"skipped {len(failures)} of {len(folders)} COLMAP models: {'; '.join(map(str, failures[:4]))}",
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
