"""SfM-like scenes without a download: as many facades with natural clutter as one likes."""

import numpy as np
from lightning import LightningDataModule
from numpy.typing import NDArray
from torch.utils.data import DataLoader

from bpnp.datamodules.facades.views import SfmOptions, draw_sfm_pair
from bpnp.datamodules.loader import STAGES, Pair, PairSource, pair_loader
from bpnp.datamodules.meshes.procedural import SPLITS
from bpnp.datamodules.outliers import Drawn, DrawnSide, Outliers, bounds, harder
from bpnp.types import Batch


class SfmSceneSource:
    """A `PairSource` of scenes that are drawn as they are asked for, one a pair.

    A pair is a function of (seed, split, index), and of the epoch too if `fresh`. Raises ValueError for no pairs.
    """

    def __init__(self, options: SfmOptions, *, num_pairs: int, seed: int, split: str, fresh: bool) -> None:
        if num_pairs < 1:
            raise ValueError(f"expected at least one {split} pair, got {num_pairs}")
        self.options, self.num_pairs, self.seed, self.split, self.fresh = options, num_pairs, seed, split, fresh

    @property
    def sizes(self) -> NDArray[np.int64]:
        """Most points of the larger side of each pair; scenes of which a camera sees little have fewer."""
        true = self.options.num_points
        return np.full(self.num_pairs, true + round(bounds(self.options.clutter)[1] * true))

    def pair(self, index: int, epoch: int) -> Pair:
        rng = np.random.default_rng([self.seed, SPLITS.index(self.split), epoch if self.fresh else 0, index])
        return draw_sfm_pair(f"sfm/{self.split}/{index:06d}", self.options, rng)


class SfmSceneDataModule(LightningDataModule):
    """Random scenes like sparse SfM maps of buildings, each seen by one camera, with natural clutter.

    Facades, corners, columns, boxes, trees and ground, in a frame of any scale and origin. Every pair has a scene of
    its own, which is drawn when the pair is asked for. Works without a Trainer: `setup()`, then the loaders.

    Args:
        train_pairs: training pairs of an epoch.
        fresh_views: draw new scenes and cameras every epoch; false for fixed pairs.
        val_pairs: validation pairs, fixed.
        test_pairs: pairs to test and predict on, fixed.
        num_points: largest number of true pairs, a random subset where a camera sees more.
        min_points: a scene with fewer true pairs is drawn anew; at least 4.
        clutter: natural clutter, as a ratio to the true pairs: keypoints without a 3D point, and points of the scene
            that the image does not see, most of them nearby; as many as there are. Two numbers, [low, high], draw it
            for each pair, uniformly.
        clutter_side: the side that gets clutter, both, 2d or 3d, or random for one of the three in each pair.
        eval_clutter: clutter in validation, testing and prediction; none for that of training.
        train_outliers: synthetic outliers and occlusion in training and validation; none for none.
        test_outliers: the same in testing and prediction.
        rotate: turn each scene by a random rotation; false for scenes whose third axis points upwards.
        scale_range: lowest and highest number of scene units in a metre, drawn for each scene, uniformly in its
            logarithm.
        field_of_view: of the longer side of an image, degrees; a number or [low, high].
        noise_px: standard deviation of the noise on 2D points, pixels of an image with 1200 on its longer side; a
            number or [low, high].
        batch_size: training pairs per step, over all processes.
        eval_batch_size: pairs per step in validation, testing and prediction; none for batch_size.
        num_workers: loader processes.
        seed: of the scenes, the cameras and the order.
    """

    def __init__(
        self,
        *,
        train_pairs: int = 40_000,
        fresh_views: bool = True,
        val_pairs: int = 200,
        test_pairs: int = 200,
        num_points: int = 128,
        min_points: int = 16,
        clutter: Drawn = 0.0,
        clutter_side: DrawnSide = "both",
        eval_clutter: Drawn | None = None,
        train_outliers: Outliers | None = None,
        test_outliers: Outliers | None = None,
        rotate: bool = True,
        scale_range: tuple[float, float] = (0.1, 10.0),
        field_of_view: Drawn = (40.0, 75.0),
        noise_px: Drawn = (0.5, 1.5),
        batch_size: int = 16,
        eval_batch_size: int | None = None,
        num_workers: int = 0,
        seed: int = 0,
    ) -> None:
        super().__init__()
        self.options = {
            split: SfmOptions(
                num_points=num_points,
                min_points=min_points,
                clutter=clutter if split == "train" or eval_clutter is None else eval_clutter,
                clutter_side=clutter_side,
                rotate=rotate,
                scale_range=scale_range,
                field_of_view=field_of_view,
                noise_px=noise_px,
            )
            for split in SPLITS
        }
        self.num_pairs = {"train": train_pairs, "val": val_pairs, "test": test_pairs}
        self.outliers = {"train": train_outliers, "val": train_outliers, "test": test_outliers}
        self.fresh_views, self.seed, self.num_workers = fresh_views, seed, num_workers
        self.batch_size = batch_size
        self.eval_batch_size = batch_size if eval_batch_size is None else eval_batch_size
        self.sources: dict[str, PairSource] = {}

    def setup(self, stage: str | None = None) -> None:
        """Make the sources of a stage (fit, validate, test, predict; none for all). Raises ValueError for no pairs."""
        for split in SPLITS if stage is None else STAGES[stage]:
            fresh = self.fresh_views and split == "train"
            source = SfmSceneSource(
                self.options[split], num_pairs=self.num_pairs[split], seed=self.seed, split=split, fresh=fresh
            )
            self.sources[split] = harder(source, self.outliers[split], seed=self.seed, fresh=fresh)

    def train_dataloader(self) -> DataLoader[Batch]:
        return self._loader("train", self.batch_size)

    def val_dataloader(self) -> DataLoader[Batch]:
        return self._loader("val", self.eval_batch_size)

    def test_dataloader(self) -> DataLoader[Batch]:
        return self._loader("test", self.eval_batch_size)

    def predict_dataloader(self) -> DataLoader[Batch]:
        return self.test_dataloader()

    def _loader(self, split: str, batch_size: int) -> DataLoader[Batch]:
        if split not in self.sources:
            raise ValueError(f"expected `setup` before the {split} loader, got no call; try `setup()`")
        return pair_loader(
            self.sources[split],
            batch_size=batch_size,
            shuffle=split == "train",
            seed=self.seed,
            num_workers=self.num_workers,
        )
