"""The data module of all sources: stages, loaders and the options that every source has."""

from abc import abstractmethod
from dataclasses import replace
from typing import Any

import numpy as np
from lightning import LightningDataModule
from numpy.typing import NDArray
from torch.utils.data import DataLoader

from bpnp.datamodules.augment import Augmentation, Outliers
from bpnp.datamodules.loader import ProblemDataset, ProblemKeys, problem_loader
from bpnp.datamodules.problem import ProblemSource
from bpnp.types import Batch

PARTS = ("train", "val", "test", "predict")
STAGES = {"fit": ("train", "val"), "validate": ("val",), "test": ("test",), "predict": ("predict",), None: PARTS}


class ProblemDataModule(LightningDataModule):
    """Stages and loaders over a source of problems. A child says what the problems of each part are: `_source`.

    Works without a Trainer: `setup()`, then the loaders. datasets: by part (train, val, test, predict), after `setup`.

    Args:
        train_outliers: synthetic outliers and occlusion in training and validation; none for none.
        test_outliers: the same in testing and prediction.
        batch_size: training problems per step, over all processes.
        eval_batch_size: problems per step in validation, testing and prediction; none for batch_size.
        max_cells: limit of problems x 2D points x 3D points of such a step, to bound the memory; none for no limit.
        num_workers: loader processes.
        seed: of all that is drawn at random, and of the order.
    """

    fresh = False  # whether the training problems are drawn anew in every epoch

    def __init__(
        self,
        *,
        train_outliers: Outliers | None = None,
        test_outliers: Outliers | None = None,
        batch_size: int = 16,
        eval_batch_size: int | None = None,
        max_cells: int | None = 2**25,
        num_workers: int = 0,
        seed: int = 0,
    ) -> None:
        super().__init__()
        sizes = {"batch_size": batch_size, "eval_batch_size": eval_batch_size, "max_cells": max_cells}
        for name, value in sizes.items():
            if value is not None and value < 1:
                raise ValueError(f"expected `{name}` of 1 or more, got {value}")
        if num_workers < 0:
            raise ValueError(f"expected `num_workers` of 0 or more, got {num_workers}")
        train, test = train_outliers or Outliers(), test_outliers or Outliers()
        self.outliers = {"train": train, "val": train, "test": test, "predict": test}
        self.batch_size = batch_size
        self.eval_batch_size = batch_size if eval_batch_size is None else eval_batch_size
        self.max_cells, self.num_workers, self.seed = max_cells, num_workers, seed
        self.augmentations: dict[str, Augmentation] = {}  # of the parts, outliers apart; a child sets its own
        self.datasets: dict[str, ProblemDataset] = {}

    @abstractmethod
    def _source(self, part: str, seed: tuple[int, int]) -> ProblemSource | None:
        """The problems of a part; None if there are none and the stage can do without them."""

    def setup(self, stage: str | None = None) -> None:
        """Open the problems of a stage (fit, validate, test, predict; none for all). Raises ValueError for bad data."""
        for part in STAGES[stage]:
            seed = (self.seed, min(PARTS.index(part), PARTS.index("test")))  # prediction has the problems of testing
            if (source := self._source(part, seed)) is not None:
                fresh = self.fresh and part == "train"
                augmentation = replace(self.augmentations.get(part, Augmentation()), outliers=self.outliers[part])
                self.datasets[part] = ProblemDataset(source, augmentation, seed=seed, fresh=fresh)

    def train_dataloader(self) -> DataLoader[Batch]:
        return self._loader("train")

    def val_dataloader(self) -> DataLoader[Batch] | list[DataLoader[Batch]]:
        return self._loader("val") if "val" in self.datasets or not self.datasets else []

    def test_dataloader(self) -> DataLoader[Batch]:
        return self._loader("test")

    def predict_dataloader(self) -> DataLoader[Batch]:
        return self._loader("predict")

    def on_after_batch_transfer(self, batch: Any, dataloader_idx: int) -> Any:
        """The training problems of a batch of keys, made on the device; other batches as they are."""
        return self.datasets["train"].batch(batch) if isinstance(batch, ProblemKeys) else batch

    def _loader(self, part: str) -> DataLoader[Batch]:
        if part not in self.datasets:
            raise ValueError(f"expected `setup` before the {part} loader, got no call; try `setup()`")
        training = part == "train"
        return problem_loader(
            self.datasets[part],
            batch_size=self.batch_size if training else self.eval_batch_size,
            shuffle=training,
            seed=self.seed,
            num_workers=self.num_workers,
            max_cells=None if training else self.max_cells,
            overfit=self.trainer is not None and self.trainer.overfit_batches > 0,  # type: ignore[attr-defined]
        )


def hold_out(count: int, fraction: float, *, seed: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Split range(count) at random into training rows and validation rows, at least one of each, both sorted.

    Raises ValueError for a fraction outside (0, 1) or fewer than two rows.
    """
    if not 0 < fraction < 1:
        raise ValueError(f"expected `val_fraction` between 0 and 1, got {fraction}")
    if count < 2:
        raise ValueError(f"expected at least 2 training rows, to hold one out for validation, got {count}")
    held = min(count - 1, max(1, round(fraction * count)))
    order = np.random.default_rng(seed).permutation(count)
    return np.sort(order[held:]), np.sort(order[:held])
