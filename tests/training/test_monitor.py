import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from lightning import LightningModule
from lightning.pytorch.loggers import CSVLogger
from planted import posed
from small_data import quiet_trainer
from torch import nn
from torch.utils.data import DataLoader

from bpnp import Batch, Prediction
from bpnp.training.callbacks import TrainingMonitor, watched_values


class PlantedModule(LightningModule):
    """A network that puts 0.25 of the mass on the true matches and the rest on a point without one.

    Its iterations are the number of the problem, and its features the points, times `feature`.
    """

    def __init__(self, feature: float = 1.0) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.ones(()))
        self.feature = feature

    def features(self, batch: Batch) -> tuple[torch.Tensor, torch.Tensor]:
        return batch.points2d, self.feature * batch.points3d + (1 - self.feature)

    def forward(self, batch: Batch) -> Prediction:
        assert batch.match3d is not None
        assert batch.rotation is not None
        assert batch.translation is not None
        matched = batch.match3d >= 0
        each = 0.25 / matched.sum(1, keepdim=True) * matched
        assignment = torch.zeros(len(batch), batch.points2d.shape[1], batch.points3d.shape[1])
        assignment.scatter_(1, batch.match3d.clamp(min=0)[:, None], each[:, None])
        assignment[torch.arange(len(batch)), 0, batch.count3d - 1] = 0.75
        pose = posed(batch.rotation, batch.translation)
        pose.stats.iterations.copy_(batch.index)
        return Prediction(assignment, None, {"pnp": pose})

    def training_step(self, batch: Batch, batch_idx: int) -> torch.Tensor:
        return self.weight**2

    def validation_step(self, batch: Batch, batch_idx: int) -> None:
        pass

    def configure_optimizers(self) -> torch.optim.Optimizer:
        return torch.optim.SGD(self.parameters(), lr=0.1)


def planted(size: int) -> Batch:
    """Problems of 8 and of 6 points in turn, all but the last one with a match."""
    points = np.random.default_rng(0).uniform(-1, 1, (size, 8, 3)) + [0, 0, 4]
    scenes = [each[: 8 - 2 * (k % 2)] for k, each in enumerate(points)]
    images = [(each[:, :2] / each[:, 2:]).astype("f4") for each in scenes]
    matches = [np.r_[np.arange(len(each) - 1), -1] for each in scenes]
    return Batch.from_arrays(images, scenes, [np.eye(3)] * size, [np.zeros(3)] * size, matches)


def spread(points: torch.Tensor) -> float:
    """Mean distance of unit vectors along the points from their mean."""
    unit = points.numpy() / np.linalg.norm(points.numpy(), axis=-1, keepdims=True)
    return float(np.linalg.norm(unit - unit.mean(0), axis=-1).mean())


def fit(folder: Path, monitor: TrainingMonitor, logger: object, epochs: int = 3) -> None:
    loader = DataLoader([planted(6), planted(4)], batch_size=None)  # type: ignore[arg-type]
    trainer = quiet_trainer(folder, max_epochs=epochs, callbacks=[monitor], logger=logger, log_every_n_steps=1)
    trainer.fit(PlantedModule(), loader, loader)


def test_a_planted_collapse_is_reported(tmp_path: Path) -> None:
    loader = DataLoader([planted(6)], batch_size=None)  # type: ignore[arg-type]
    trainer = quiet_trainer(tmp_path, max_epochs=1, callbacks=[TrainingMonitor()])
    with pytest.warns(UserWarning, match="features have collapsed. Use a lower model.learning_rate"):
        trainer.fit(PlantedModule(feature=0.0), loader, loader)
    assert float(trainer.callback_metrics["val/feature_spread_3d"]) < 1e-6
    assert float(trainer.callback_metrics["val/feature_spread_2d"]) > 0.1


def test_a_training_logs_the_monitored_values(tmp_path: Path) -> None:
    fit(tmp_path, TrainingMonitor(problems=2), CSVLogger(tmp_path, name="logs"))
    rows = list(csv.DictReader((tmp_path / "logs" / "version_0" / "metrics.csv").open()))
    mass = [float(row["val/true_match_mass"]) for row in rows if row["val/true_match_mass"]]
    assert mass == pytest.approx([0.25] * 3)
    assert {float(row["val/pnp_iterations"]) for row in rows if row["val/pnp_iterations"]} == {0.5}  # problems 0, 1
    watched = planted(6)
    for side, points in (("2d", watched.points2d), ("3d", watched.points3d)):
        (found, *_) = (float(row[name]) for row in rows if row[name := f"val/feature_spread_{side}"])
        assert found == pytest.approx((spread(points[0]) + spread(points[1, :6])) / 2, rel=1e-5)
    assert watched_values(Prediction(), planted(5)) == {}
    with pytest.raises(ValueError, match="`problems` is .*; it must be"):
        TrainingMonitor(problems=0)


def test_another_training_has_its_own_problems(tmp_path: Path) -> None:
    monitor = TrainingMonitor(problems=2)
    fit(tmp_path, monitor, None, epochs=1)
    monitor.watched = None if monitor.watched is None else replace(monitor.watched, match3d=monitor.watched.match3d * 0)
    loader = DataLoader([planted(6)], batch_size=None)  # type: ignore[arg-type]
    trainer = quiet_trainer(tmp_path, max_epochs=1, callbacks=[monitor])
    trainer.fit(PlantedModule(), loader, loader)
    assert float(trainer.callback_metrics["val/true_match_mass"]) == pytest.approx(0.25)
