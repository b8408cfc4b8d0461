"""SfM-like scenes without a download: as many facades with natural clutter as one likes."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Int
from torch import Tensor

from bpnp.datamodules.augment import Augmentation, Drawn, DrawnSide, bounds
from bpnp.datamodules.facades.views import SfmOptions, draw_sfm_pair
from bpnp.datamodules.module import PairDataModule
from bpnp.datamodules.pair import Counts, stacked
from bpnp.types import Batch


class SfmSceneSource:
    """A `PairSource` of scenes that are drawn as they are asked for, one a pair: a function of (seed, epoch, index).

    Raises ValueError for no pairs.
    """

    def __init__(self, options: SfmOptions, *, num_pairs: int, seed: Sequence[int], label: str) -> None:
        if num_pairs < 1:
            raise ValueError(f"expected at least one {label} pair, got {num_pairs}")
        self.options, self.num_pairs, self.seed, self.label = options, num_pairs, tuple(seed), label

    @property
    def counts(self) -> Counts:
        """Most points of each pair; scenes of which a camera sees little have fewer."""
        true = np.full(self.num_pairs, self.options.num_points)
        largest = true + round(bounds(self.options.clutter)[1] * self.options.num_points)
        return Counts(true, largest, largest)

    def names(self, index: Sequence[int]) -> tuple[str, ...]:
        return tuple(f"sfm/{self.label}/{i:06d}" for i in index)

    def batch(self, index: Int[Tensor, " b"], epoch: int) -> Batch:
        numbers = index.tolist()
        rngs = [np.random.default_rng([*self.seed, epoch, i]) for i in numbers]
        names = self.names(numbers)
        return stacked([draw_sfm_pair(name, self.options, rng) for name, rng in zip(names, rngs, strict=True)], index)


class SfmSceneDataModule(PairDataModule):
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
        rotate: turn each scene by a random rotation; false for scenes whose third axis points upwards.
        scale_range: lowest and highest number of scene units in a metre, drawn for each scene, uniformly in its
            logarithm.
        field_of_view: of the longer side of an image, degrees; a number or [low, high].
        noise_px: standard deviation of the noise on 2D points, pixels of an image with 1200 on its longer side; a
            number or [low, high].
        loading: options of `PairDataModule`: batch_size, eval_batch_size, train_outliers, test_outliers, seed, ...
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
        rotate: bool = True,
        scale_range: tuple[float, float] = (0.1, 10.0),
        field_of_view: Drawn = (40.0, 75.0),
        noise_px: Drawn = (0.5, 1.5),
        **loading: Any,
    ) -> None:
        super().__init__(**loading)
        self.options = {
            split: SfmOptions(
                num_points=num_points,
                min_points=min_points,
                clutter=clutter if split == "train" or eval_clutter is None else eval_clutter,
                clutter_side=clutter_side,
                scale_range=scale_range,
                field_of_view=field_of_view,
                noise_px=noise_px,
            )
            for split in ("train", "val", "test")
        }
        self.num_pairs = {"train": train_pairs, "val": val_pairs, "test": test_pairs}
        self.fresh, self.rotate = fresh_views, rotate

    def _augmentation(self, part: str) -> Augmentation:
        return Augmentation(rotate=self.rotate, outliers=self.outliers[part])

    def _source(self, part: str, seed: tuple[int, int]) -> SfmSceneSource:
        split = "test" if part == "predict" else part
        return SfmSceneSource(self.options[split], num_pairs=self.num_pairs[split], seed=seed, label=split)
