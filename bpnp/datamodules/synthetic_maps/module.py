"""Synthetic maps: any number of random scenes with photos and their sparse maps, without a download."""

from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np
from jaxtyping import Int
from torch import Tensor

from bpnp.datamodules.augment import Augmentation, Drawn
from bpnp.datamodules.module import PARTS, PairDataModule
from bpnp.datamodules.pair import Counts, stacked
from bpnp.datamodules.synthetic_maps.maps import WEIGHTS, MapOptions, draw_map_pair
from bpnp.types import Batch


class MapSource:
    """A `PairSource` of scenes that are drawn as they are asked for, one a pair: a function of (seed, epoch, index).

    Raises ValueError for no pairs.
    """

    def __init__(self, options: MapOptions, *, num_pairs: int, seed: Sequence[int], label: str) -> None:
        if num_pairs < 1:
            raise ValueError(f"expected at least one {label} pair, got {num_pairs}")
        self.options, self.num_pairs, self.seed, self.label = options, num_pairs, tuple(seed), label

    @property
    def counts(self) -> Counts:
        """Most points of each pair; most have fewer."""
        most = np.full(self.num_pairs, self.options.num_points)
        return Counts(most, most, most)

    def names(self, index: Sequence[int]) -> tuple[str, ...]:
        return tuple(f"map/{self.label}/{i:06d}" for i in index)

    def batch(self, index: Int[Tensor, " b"], epoch: int) -> Batch:
        numbers = index.tolist()
        rngs = [np.random.default_rng([*self.seed, epoch, i]) for i in numbers]
        names = self.names(numbers)
        return stacked([draw_map_pair(name, self.options, rng) for name, rng in zip(names, rngs, strict=True)], index)


class SfmSceneDataModule(PairDataModule):
    """A photo's keypoints against the part of a sparse map that some other photos see, all of it drawn at random.

    Every pair has a scene of its own, drawn when the pair is asked for. A point is in the map if enough photos have a
    keypoint of it; it is off along its ray by the error of its triangulation. Keypoints of one photo alone, points out
    of the photo's sight and pairs that were missed are the points without a partner. Works without a Trainer:
    `setup()`, then the loaders.

    Args:
        train_pairs: training pairs of an epoch.
        fresh_views: draw new scenes and cameras every epoch; false for fixed pairs.
        val_pairs: validation pairs, fixed.
        test_pairs: pairs to test and predict on, fixed.
        num_points: largest number of points of a side; true pairs and others are thinned alike where there are more.
        min_points: a scene with fewer true pairs is drawn anew; at least 4.
        outliers: of each side at most this share of all points has no partner; 1 for all that there are. Two numbers,
            [low, high], draw it for each pair, uniformly.
        views: lowest and highest number of photos whose map points are taken.
        kinds: weight of each kind of scene; none for all kinds, in the shares of `maps.WEIGHTS`.
        frame: of the map: any, turned by a random rotation; upright, the third axis upwards and any heading; view, the
            coordinates of the first of the cameras whose map points are taken.
        tilt_deg: by how much an upright frame is off, about each of its horizontal axes, standard deviation in degrees.
        scale_range: lowest and highest number of scene units in a metre, drawn for each scene, uniformly in its
            logarithm.
        field_of_view: of the longer side of an image, degrees; a number or [low, high], uniform in the logarithm.
        noise_px: standard deviation of the noise on 2D points, pixels of an image with 1200 on its longer side; a
            number or [low, high], uniform in the logarithm.
        loading: options of `PairDataModule`: batch_size, eval_batch_size, train_outliers, test_outliers, seed, ...
    """

    def __init__(
        self,
        *,
        train_pairs: int = 40_000,
        fresh_views: bool = True,
        val_pairs: int = 200,
        test_pairs: int = 200,
        num_points: int = 256,
        min_points: int = 16,
        outliers: Drawn = (0.25, 1.0),
        views: tuple[int, int] = (1, 3),
        kinds: Mapping[str, float] | None = None,
        frame: Literal["any", "upright", "view"] = "any",
        tilt_deg: float = 0.0,
        scale_range: tuple[float, float] = (0.1, 10.0),
        field_of_view: Drawn = (24.0, 115.0),
        noise_px: Drawn = (0.1, 1.5),
        **loading: Any,
    ) -> None:
        super().__init__(**loading)
        self.options = MapOptions(
            num_points=num_points,
            min_points=min_points,
            outliers=outliers,
            views=views,
            kinds=WEIGHTS if kinds is None else kinds,
            frame="upright" if frame == "any" else frame,
            tilt_deg=tilt_deg,
            scale_range=scale_range,
            field_of_view=field_of_view,
            noise_px=noise_px,
        )
        self.num_pairs = {"train": train_pairs, "val": val_pairs, "test": test_pairs}
        self.fresh = fresh_views
        self.augmentations = dict.fromkeys(PARTS, Augmentation(rotate=frame == "any"))

    def _source(self, part: str, seed: tuple[int, int]) -> MapSource:
        split = "test" if part == "predict" else part
        return MapSource(self.options, num_pairs=self.num_pairs[split], seed=seed, label=split)
