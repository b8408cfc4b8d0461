"""Batches of problems: sampling in any number of processes, exact resuming, and the base data module."""

import math
from abc import abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from lightning import LightningDataModule
from numpy.typing import NDArray
from torch import distributed
from torch.utils.data import DataLoader, Dataset, DistributedSampler, SequentialSampler, Subset

from bpnp.checks import check_within
from bpnp.datamodules.augment import Augmentation, Outliers, augment
from bpnp.datamodules.keyed_random import row_keys
from bpnp.datamodules.problem import ProblemSource
from bpnp.types import Batch

Key = tuple[int, int]  # (epoch, index); a problem depends on these and the seed only
POOL_BATCHES = 50  # number of training batches in a pool that is sorted by size


class ProblemDataset(Dataset[Batch]):
    """Data set that maps a list of (epoch, index) keys to a batch, whatever the worker or the order.

    A problem is a function of (seed, index), and of the epoch too if it is `fresh`.
    """

    def __init__(
        self,
        source: ProblemSource,
        augmentation: Augmentation | None = None,
        *,
        seed: Sequence[int] = (0,),
        fresh: bool = False,
    ) -> None:
        self.source, self.augmentation = source, augmentation or Augmentation()
        self.seed, self.fresh = tuple(seed), fresh
        self.sizes = self.augmentation.sizes(source.counts)

    def __len__(self) -> int:
        return len(self.sizes)

    def __getitem__(self, keys: Sequence[Key]) -> Batch:
        index, epoch = torch.tensor([index for _, index in keys]), keys[0][0] if self.fresh else 0
        problems = augment(self.source.batch(index, epoch), self.augmentation, row_keys(index, *self.seed, epoch))
        return replace(problems, **{name: getattr(problems, name).float() for name in ("rotation", "translation")})

    def problem(self, index: int, epoch: int = 0) -> Batch:
        """Return a batch of one problem."""
        return self[[(epoch, index)]]


class BucketSampler(DistributedSampler[list[Key]]):
    """Sampler of batches of similar size; yields the keys of this process's part of each batch.

    `batch_size` counts the problems of a step over all processes. Any number of processes has the same problems in a
    step, each process a contiguous slice of equal length. Training (`shuffle`) draws new batches for every (seed,
    epoch); evaluation visits every problem, in the batches of epoch 0. Lightning does not replace a
    `DistributedSampler`, and calls its `set_epoch`.

    The order of the batches is random, so that the first few, all that a limited run has, are a fair sample. Problems
    are repeated if the processes do not divide the last batch.

    `max_cells` limits problems x size^2 of a step in evaluation; None is no limit. Raise ValueError if the data set is
    empty, the processes do not divide `batch_size`, or `max_cells` is set in training, where a step keeps its number of
    problems.
    """

    def __init__(
        self,
        dataset: ProblemDataset,
        *,
        batch_size: int,
        shuffle: bool,
        seed: int,
        num_replicas: int = 1,
        rank: int = 0,
        max_cells: int | None = None,
    ) -> None:
        if len(dataset) == 0:
            raise ValueError("the data set has no problems")
        if batch_size < 1 or batch_size % num_replicas:
            name = "batch_size" if shuffle else "eval_batch_size"
            raise ValueError(
                f"`{name}` {batch_size} (problems in a step over all processes) cannot be divided among "
                f"{num_replicas} processes; try {max(1, round(batch_size / num_replicas)) * num_replicas}"
            )
        if shuffle and max_cells is not None:
            raise ValueError("`max_cells` cannot be used with `shuffle=True`; use a smaller `batch_size`")
        super().__init__(dataset, num_replicas=num_replicas, rank=rank, shuffle=shuffle, seed=seed)
        self.sizes = dataset.sizes
        self.batch_size = batch_size
        self.first_batch = 0  # first batch of the next pass, above 0 for a resumed epoch
        self.max_cells = max_cells
        self._length = max(1, len(self.sizes) // batch_size) if shuffle else len(self.batches(0))

    def batches(self, epoch: int) -> list[NDArray[np.int64]]:
        """Return the batches of an epoch over all processes, as indices."""
        rng = np.random.default_rng([self.seed, epoch])
        order = rng.permutation(len(self.sizes))
        batches = self._training_batches(order) if self.shuffle else self._evaluation_batches(order)
        return [batches[i] for i in rng.permutation(len(batches))]

    def _training_batches(self, order: NDArray[np.int64]) -> list[NDArray[np.int64]]:
        """Cut the shuffled set into pools of 50 batches, sort each pool by size and cut it into batches.

        The remainder of the division by `batch_size` is left out of the epoch. A set smaller than one batch is one
        batch.
        """
        whole = len(order) - len(order) % self.batch_size
        if whole == 0:
            return [self._fill_batches(order)]
        span = POOL_BATCHES * self.batch_size
        pools = np.split(order[:whole], range(span, whole, span))
        return list(np.concatenate([self._largest_first(pool) for pool in pools]).reshape(-1, self.batch_size))

    def _evaluation_batches(self, order: NDArray[np.int64]) -> list[NDArray[np.int64]]:
        """Cut the set into batches of at most `batch_size` problems with b * size^2 <= `max_cells`.

        The size is the larger side of the largest problem. A batch has at least one problem for each process.
        """
        order = self._largest_first(order)
        batches: list[NDArray[np.int64]] = []
        start = 0
        while start < len(order):
            fitting = self.batch_size
            if self.max_cells is not None:
                fitting = min(fitting, self.max_cells // int(self.sizes[order[start]]) ** 2)
            stop = start + max(self.num_replicas, fitting - fitting % self.num_replicas)
            batches.append(self._fill_batches(order[start:stop]))
            start = stop
        return batches

    def _largest_first(self, order: NDArray[np.int64]) -> NDArray[np.int64]:
        return order[np.argsort(-self.sizes[order], kind="stable")]

    def _fill_batches(self, batch: NDArray[np.int64]) -> NDArray[np.int64]:
        """Repeat a batch from its start up to a multiple of the number of processes."""
        return np.resize(batch, -(-len(batch) // self.num_replicas) * self.num_replicas)

    def __len__(self) -> int:
        return self._length

    def __iter__(self) -> Iterator[list[Key]]:
        epoch = self.epoch if self.shuffle else 0
        for batch in self.batches(epoch)[self.first_batch :]:
            size = len(batch) // self.num_replicas
            yield [(epoch, int(i)) for i in batch[self.rank * size : (self.rank + 1) * size]]


class FixedSampler(DistributedSampler[int], SequentialSampler):
    """Sampler of all batches of this process in their order.

    With `overfit_batches`, Lightning replaces a sampler that is not sequential, and in several processes one that is
    not distributed, by another that drops batches.
    """

    def __init__(self, batches: Dataset[Batch]) -> None:
        super().__init__(batches, num_replicas=1, rank=0, shuffle=False)


class ProblemLoader(DataLoader[Batch]):
    """DataLoader of whole batches that resumes exactly, also within an epoch.

    The workers start at the first `next`, not at `iter`, because Lightning calls `set_epoch` between the two when it
    resumes. The state is (epoch, batches served) and applies to that epoch only.
    """

    epoch = served = 0
    resumed = False  # True from the loading of a state to the next iteration

    def __iter__(self) -> Iterator[Batch]:  # type: ignore[override]
        assert isinstance(self.sampler, BucketSampler)
        if not self.resumed or self.epoch != self.sampler.epoch:
            self.epoch, self.served = self.sampler.epoch, 0
        self.resumed = False
        self.sampler.first_batch = self.served
        for batch in super().__iter__():
            self.served += 1
            yield batch

    def state_dict(self) -> dict[str, int]:
        """Return the epoch of the last iteration and the number of batches served in it."""
        return {"epoch": self.epoch, "served": self.served}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Resume the epoch of this state at its next iteration."""
        self.epoch, self.served, self.resumed = state_dict["epoch"], state_dict["served"], True


PARTS = ("train", "val", "test", "predict")
STAGES = {"fit": ("train", "val"), "validate": ("val",), "test": ("test",), "predict": ("predict",), None: PARTS}


class ProblemDataModule(LightningDataModule):
    """Base data module over a source of problems; a subclass implements `_source`.

    Works without a Trainer: `setup()`, then the loaders. After `setup`, `datasets` holds those of the parts train, val,
    test and predict.

    Args:
        train_outliers: Synthetic outliers and occlusion in training and validation. Default: None, without.
        test_outliers: Synthetic outliers and occlusion in testing and prediction. Default: None, without.
        batch_size: Training problems in a step, over all processes.
        eval_batch_size: Problems in a step of validation, testing and prediction; None for batch_size.
        max_cells: Limit of problems x 2D points x 3D points in such a step, to bound the memory; None for no limit.
        num_workers: Number of loader processes.
        seed: Seed of all random numbers and of the order.

    Raises:
        ValueError: An option is out of range.
    """

    fresh = False  # True if each epoch draws new training problems

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
        check_within(1, math.inf, **{name: size for name, size in sizes.items() if size is not None})
        check_within(0, math.inf, num_workers=num_workers, seed=seed)
        train, test = train_outliers or Outliers(), test_outliers or Outliers()
        self.outliers = {"train": train, "val": train, "test": test, "predict": test}
        self.batch_size = batch_size
        self.eval_batch_size = batch_size if eval_batch_size is None else eval_batch_size
        self.max_cells, self.num_workers, self.seed = max_cells, num_workers, seed
        self.augmentations: dict[str, Augmentation] = {}  # by part, without outliers; set by subclasses
        self.datasets: dict[str, ProblemDataset] = {}

    @abstractmethod
    def _source(self, split: str, seed: tuple[int, int]) -> ProblemSource | None:
        """Return the problems of train, val or test; None if there are none and the stage does not need them."""

    def setup(self, stage: str | None = None) -> None:
        """Open the problems of a stage: fit, validate, test or predict; None for all.

        Raises:
            ValueError: The data are unusable.
        """
        for part in STAGES[stage]:
            split = "test" if part == "predict" else part  # prediction uses the test problems
            seed = (self.seed, PARTS.index(split))
            if (source := self._source(split, seed)) is not None:
                fresh = self.fresh and part == "train"
                augmentation = replace(self.augmentations.get(part, Augmentation()), outliers=self.outliers[part])
                self.datasets[part] = ProblemDataset(source, augmentation, seed=seed, fresh=fresh)

    def train_dataloader(self) -> DataLoader[Batch]:
        """Return the loader of the training problems."""
        return self._loader("train")

    def val_dataloader(self) -> DataLoader[Batch] | list[DataLoader[Batch]]:
        """Return the loader of the validation problems; an empty list if there are no such problems."""
        return self._loader("val") if "val" in self.datasets or not self.datasets else []

    def test_dataloader(self) -> DataLoader[Batch]:
        """Return the loader of the test problems."""
        return self._loader("test")

    def predict_dataloader(self) -> DataLoader[Batch]:
        """Return the loader of the problems to predict."""
        return self._loader("predict")

    def _loader(self, part: str) -> DataLoader[Batch]:
        if part not in self.datasets:
            raise ValueError(f"the {part} loader needs `setup()` first")
        training, dataset = part == "train", self.datasets[part]
        group = distributed.is_available() and distributed.is_initialized()
        sampler = BucketSampler(
            dataset,
            batch_size=self.batch_size if training else self.eval_batch_size,
            shuffle=training,
            seed=self.seed,
            num_replicas=distributed.get_world_size() if group else 1,
            rank=distributed.get_rank() if group else 0,
            max_cells=None if training else self.max_cells,
        )
        if self.trainer is not None and self.trainer.overfit_batches > 0:  # type: ignore[attr-defined]
            keys: list[Any] = list(sampler)  # the same batches in every epoch, in this order
            batches = Subset(dataset, keys)
            return DataLoader(batches, sampler=FixedSampler(batches), batch_size=None, num_workers=self.num_workers)
        return ProblemLoader(
            dataset,
            sampler=sampler,
            batch_size=None,
            num_workers=self.num_workers,
            persistent_workers=self.num_workers > 0,
            pin_memory=torch.cuda.is_available(),
            generator=torch.Generator().manual_seed(self.seed),  # in place of the global generator
        )


def hold_out(count: int, fraction: float, *, seed: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Split range(count) at random into training rows and validation rows, at least one of each, both sorted.

    Raise ValueError if the fraction of validation rows is not in (0, 1), or there are fewer than two rows.
    """
    if not 0 < fraction < 1:
        raise ValueError(f"`val_fraction` is {fraction}; it must be between 0 and 1")
    if count < 2:
        raise ValueError(f"the number of training rows is {count}; at least 2 are needed, one of them for validation")
    held = min(count - 1, max(1, round(fraction * count)))
    order = np.random.default_rng(seed).permutation(count)
    return np.sort(order[held:]), np.sort(order[:held])
