"""Batches: the sampler's laws for any length and number of processes, and exact resuming under Lightning."""

from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from lightning import LightningModule, Trainer
from lightning.pytorch.callbacks import ModelCheckpoint
from lightning.pytorch.trainer.connectors.data_connector import _DataConnector, _resolve_overfit_batches
from lightning.pytorch.trainer.states import RunningStage
from lightning.pytorch.utilities import CombinedLoader
from small_data import recorded

from bpnp.datamodules.augment import Outliers
from bpnp.datamodules.loader import BucketSampler, ProblemDataModule, ProblemDataset
from bpnp.datamodules.problem import Counts, Problem, stack_problems
from bpnp.training import BestCheckpoint
from bpnp.types import Batch


class Numbered:
    """Problem i at epoch e is named "i" and has e in its points, so that a batch tells which keys it was made of."""

    def __init__(self, sizes: Sequence[int]) -> None:
        self.sizes = np.asarray(sizes, dtype=np.int64)

    @property
    def counts(self) -> Counts:
        return Counts(self.sizes, self.sizes, self.sizes)

    def batch(self, index: torch.Tensor, epoch: int) -> Batch:
        return stack_problems([self.problem(i, epoch) for i in index.tolist()], index)

    def problem(self, index: int, epoch: int) -> Problem:
        rng = np.random.default_rng([epoch, index])
        n = int(self.sizes[index])
        points2d, points3d = rng.random((n, 2), dtype=np.float32), np.full((n, 3), epoch, np.float32)
        return Problem(str(index), points2d, points3d, n, np.eye(3), np.ones(3), 800.0)


class Problems(ProblemDataModule):
    """20 problems to train on, and to test on."""

    fresh = True

    def _source(self, split: str, seed: tuple[int, int]) -> Numbered:
        return Numbered(random_sizes(20))


def random_sizes(count: int, *, largest: int = 400) -> list[int]:
    """Log-uniform from 4 to `largest`."""
    return np.exp(np.random.default_rng(0).uniform(np.log(4), np.log(largest), count)).astype(int).tolist()


def sampler(sizes: Sequence[int], *, rank: int = 0, replicas: int = 1, **options) -> BucketSampler:
    return BucketSampler(
        ProblemDataset(Numbered(sizes), fresh=True), rank=rank, num_replicas=replicas, seed=3, **options
    )


def is_mixed_but_alike(steps: list, sizes: Sequence[int]) -> tuple[bool, bool]:
    """Return True for steps in no order of their size, and for problems of about one size in each step."""
    logs = [np.log([sizes[i] for _, i in step]) for step in steps]
    order = np.corrcoef(np.arange(len(logs)), [each.mean() for each in logs])[0, 1]
    return abs(order) < 0.4, np.mean([each.std() for each in logs]) < 0.1 * np.std(np.log(sizes))


@pytest.mark.parametrize("count", [1, 7, 24, 1003])
@pytest.mark.parametrize("replicas", [1, 2, 4])
def test_training_visits_each_pair_at_most_once_an_epoch(count: int, replicas: int) -> None:
    sizes = random_sizes(count)
    ranks = [sampler(sizes, batch_size=8, shuffle=True, rank=r, replicas=replicas) for r in range(replicas)]
    alone = sampler(sizes, batch_size=8, shuffle=True)
    previous: list = []
    for epoch in (0, 1):
        for one in (alone, *ranks):
            one.set_epoch(epoch)
        steps = list(alone)
        assert steps == list(alone) != previous
        assert count < 1000 or all(is_mixed_but_alike(steps, sizes))
        previous = steps
        keys = [key for step in steps for key in step]
        assert {e for e, _ in keys} == {epoch}
        assert len(set(keys)) == len(keys) == (count if count < 8 else count - count % 8)
        shares = [list(one) for one in ranks]
        assert {len(one) for one in shares} == {len(one) for one in ranks} == {len(steps)}
        for step, *parts in zip(steps, *shares, strict=True):
            assert len({len(part) for part in parts}) == 1
            assert {key for part in parts for key in part} == set(step)


@pytest.mark.parametrize("count", [1, 2, 3, 8, 9, 250])
@pytest.mark.parametrize("replicas", [1, 2, 4])
@pytest.mark.parametrize("max_cells", [None, 40_000])
def test_evaluation_covers_every_pair(count: int, replicas: int, max_cells: int | None) -> None:
    sizes = random_sizes(count)
    options = {"batch_size": 8, "shuffle": False, "max_cells": max_cells}
    ranks = [sampler(sizes, rank=r, replicas=replicas, **options) for r in range(replicas)]
    before = [list(one) for one in ranks]
    for one in ranks:
        one.set_epoch(5)
    shares = [list(one) for one in ranks]
    assert shares == before
    assert {len(one) for one in shares} == {len(one) for one in ranks}
    assert all(step for share in shares for step in share)
    keys = [key for share in shares for step in share for key in step]
    assert set(keys) == {(0, i) for i in range(count)}
    if count == 250:
        assert all(is_mixed_but_alike(shares[0], sizes))
    for parts in zip(*shares, strict=True):
        step = [sizes[i] for part in parts for _, i in part]
        assert max_cells is None or len(step) == replicas or len(step) * max(step) ** 2 <= max_cells
    if max_cells is None:
        alone = [set(step) for step in sampler(sizes, **options)]
        assert [{k for part in parts for k in part} for parts in zip(*shares, strict=True)] == alone


def test_each_part_has_its_outliers_and_its_batch_size() -> None:
    sizes = {"batch_size": 6, "eval_batch_size": 2}
    data = Problems(train_outliers=Outliers(ratio=1.0), test_outliers=Outliers(ratio=0.5), **sizes)
    data.setup()
    for part, ratio, size in (("train", 1.0, 6), ("val", 1.0, 2), ("test", 0.5, 2), ("predict", 0.5, 2)):
        for batch in getattr(data, f"{part}_dataloader")():
            matches = (batch.match3d >= 0).sum(-1)
            assert len(batch) == size
            assert torch.equal(batch.count3d, matches + (ratio * matches).long())
    single, other = Problems(**sizes, max_cells=1), Problems(**sizes, seed=1)
    for one in (single, other):
        one.setup()
    assert [len(batch) for batch in single.test_dataloader()] == [1] * 20
    assert len(next(iter(single.train_dataloader()))) == 6
    assert next(iter(other.test_dataloader())).ids != next(iter(data.test_dataloader())).ids


def test_overfitting_in_two_processes_uses_all_batches_of_each(monkeypatch: pytest.MonkeyPatch) -> None:
    """After Lightning has processed the loaders of both, each of the 20 problems is in one of 5 steps of 2 + 2."""
    monkeypatch.setattr("torch.distributed.is_initialized", lambda: True)
    monkeypatch.setattr("torch.distributed.get_world_size", lambda: 2)
    steps = []
    for rank in range(2):
        monkeypatch.setattr("torch.distributed.get_rank", lambda rank=rank: rank)
        data = Problems(batch_size=4)
        data.setup("fit")
        data.trainer = SimpleNamespace(
            overfit_batches=1.0,
            distributed_sampler_kwargs={"num_replicas": 2, "rank": rank},
            state=SimpleNamespace(fn="fit"),
            _accelerator_connector=SimpleNamespace(use_distributed_sampler=True, is_distributed=True),
        )
        combined = CombinedLoader(data.train_dataloader())
        _resolve_overfit_batches(combined, RunningStage.TRAINING)
        connector = _DataConnector(data.trainer)
        loader = connector._prepare_dataloader(combined.flattened[0], shuffle=False, mode=RunningStage.TRAINING)
        steps.append([batch.ids for batch in loader])
    assert [len(of_rank) for of_rank in steps] == [5, 5]
    assert sorted(int(i) for of_rank in steps for ids in of_rank for i in ids) == list(range(20))


def test_errors_name_what_is_wrong() -> None:
    with pytest.raises(ValueError, match=r"`batch_size` 15 .* cannot be divided among 2 processes; try 16"):
        sampler([4] * 20, batch_size=15, shuffle=True, replicas=2)
    with pytest.raises(ValueError, match=r"`eval_batch_size` 5 .* cannot be divided among 2 processes; try 4"):
        sampler([4] * 20, batch_size=5, shuffle=False, replicas=2)
    with pytest.raises(ValueError, match="no problems"):
        sampler([], batch_size=4, shuffle=False)
    with pytest.raises(ValueError, match=r"max_cells.*shuffle=True"):
        sampler([4], batch_size=4, shuffle=True, max_cells=100)


@pytest.mark.parametrize("workers", [0, 1])
@pytest.mark.filterwarnings("ignore")
def test_lightning_resumes_with_the_pairs_that_were_left(tmp_path: Path, workers: int) -> None:
    def fit(*callbacks: ModelCheckpoint, checkpoint: Path | None = None) -> list[tuple[str, ...]]:
        """ "epoch:index" of each problem of each batch."""
        options = {"max_epochs": 2, "enable_checkpointing": bool(callbacks), "callbacks": list(callbacks)}
        data = Problems(batch_size=6, seed=3, num_workers=workers)
        batches = recorded(data, tmp_path, checkpoint=checkpoint, limit_val_batches=0, **options)
        return [tuple(f"{int(p[0, 0])}:{i}" for p, i in zip(b.points3d, b.ids, strict=True)) for b in batches]

    whole = fit(ModelCheckpoint(tmp_path, filename="{step}", save_top_k=-1, every_n_train_steps=1))
    expected = sampler(random_sizes(20), batch_size=6, shuffle=True)
    planned = list(expected)
    expected.set_epoch(1)
    planned += list(expected)
    assert whole == [tuple(f"{epoch}:{i}" for epoch, i in step) for step in planned]
    for step in (2, 3, 5):  # inside the first epoch, at its end, inside the second
        assert fit(checkpoint=tmp_path / f"step={step}.ckpt") == whole[step:]


class Switch(BestCheckpoint):
    """A pose loss that joins at the second epoch of a task without one."""

    def on_train_epoch_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        pl_module.pose_weight = float(trainer.current_epoch >= 1)  # type: ignore[assignment]
        super().on_train_epoch_start(trainer, pl_module)


@pytest.mark.filterwarnings("ignore")
def test_the_checkpoint_before_the_pose_loss_resumes_with_the_first_batch_of_its_epoch(tmp_path: Path) -> None:
    def fit(checkpoint: Path | None = None) -> list[tuple[str, ...]]:
        options = {"max_epochs": 3, "callbacks": [Switch(tmp_path)], "enable_checkpointing": True}
        data = Problems(batch_size=6, seed=3)
        return [batch.ids for batch in recorded(data, tmp_path, checkpoint=checkpoint, limit_val_batches=0, **options)]

    whole = fit()
    assert len(whole) == 9
    resumed = (tmp_path / "before_pose_loss.ckpt").rename(tmp_path / "resumed.ckpt")
    assert fit(resumed) == whole[3:]
