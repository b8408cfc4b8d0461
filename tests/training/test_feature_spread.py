"""Features that collapse are reported, once; the learning rate follows its schedule, resumed or not."""

import csv
import math
import warnings
from pathlib import Path

import pytest
import torch
from lightning import Trainer
from lightning.pytorch.loggers import CSVLogger
from planted import plant
from small_data import small_net
from torch.utils.data import DataLoader

from bpnp import Batch, BPnPNet, Matcher
from bpnp.training.feature_spread import FeatureSpread, feature_spread
from bpnp.training.schedules import LearningRateSchedule
from bpnp.training.task import BlindPnPTask


def collapsed_net() -> BPnPNet:
    """All points of an image get the same feature."""
    net = small_net(8, 1)
    torch.nn.init.zeros_(net.features2d.enter.weight)
    return net


def fit(
    folder: Path,
    net: BPnPNet | Matcher,
    callback: FeatureSpread | LearningRateSchedule,
    *,
    epochs: int = 1,
    resume: str | None = None,
) -> Trainer:
    """20 steps an epoch, at a learning rate that changes next to nothing."""
    batch: Batch = plant(2, 10).batch()
    trainer = Trainer(
        default_root_dir=folder,
        max_epochs=epochs,
        callbacks=[callback],
        logger=CSVLogger(folder, name="logs", version=epochs),
        accelerator="cpu",
        enable_progress_bar=False,
        enable_model_summary=False,
        enable_checkpointing=False,
        log_every_n_steps=1,
    )
    trainer.fit(BlindPnPTask(net, learning_rate=1e-12), DataLoader([batch] * 20, batch_size=None), ckpt_path=resume)  # type: ignore[arg-type]
    return trainer


def logged(folder: Path, column: str) -> list[float]:
    rows = csv.DictReader((folder / "logs" / "version_1" / "metrics.csv").open())
    return [float(row[column]) for row in rows if row.get(column)]


def test_the_spread_of_known_features() -> None:
    corners = torch.eye(4)[None]  # each at sqrt(1 - 1/4) from the mean
    opposite = torch.tensor([[[1.0, 0], [-1, 0], [0, 9], [0, 9]]])
    everything = torch.ones(1, 4, dtype=torch.bool)
    assert float(feature_spread(corners, everything)) == pytest.approx(math.sqrt(3) / 2)
    assert float(feature_spread(torch.ones(1, 4, 3), everything)) == 0
    two = torch.tensor([[True, True, False, False]])  # what is padded does not count
    assert float(feature_spread(opposite, two)) == 1


def test_a_planted_collapse_is_reported_once(tmp_path: Path) -> None:
    monitor = FeatureSpread(patience=6, every=2)
    with pytest.warns(UserWarning, match="features have collapsed; try a lower model.learning_rate") as seen:
        fit(tmp_path, collapsed_net(), monitor)
    assert len([w for w in seen if "collapsed" in str(w.message)]) == 1
    assert 0 <= max(logged(tmp_path, "train/feature_spread_2d")) < 1e-6
    assert min(logged(tmp_path, "train/feature_spread_3d")) > 0.1
    again = FeatureSpread()
    again.load_state_dict(monitor.state_dict())
    assert again.warned


def test_features_that_differ_are_not_reported(tmp_path: Path) -> None:
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message=".*collapsed.*")
        fit(tmp_path, small_net(8, 1), FeatureSpread(patience=1, every=1))
        fit(tmp_path, collapsed_net(), FeatureSpread(patience=100))
    net = small_net(8, 1)
    fit(tmp_path, net, FeatureSpread())
    assert not net.features2d._forward_hooks


def test_wrong_settings_of_the_monitor_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="expected a solver with `features2d` and `features3d`, got Matcher"):
        fit(tmp_path, Matcher(channels=8, depth=1, heads=2), FeatureSpread())
    with pytest.raises(ValueError, match="got 0.05, 0 and 10"):
        FeatureSpread(patience=0)


def test_the_rate_rises_stays_and_falls() -> None:
    schedule = LearningRateSchedule(warmup_steps=9, decay_start=100, decay_steps=50, final=0.2)
    steps = (0, 4, 9, 100, 125, 150, 10_000)
    assert [schedule.factor(step) for step in steps] == pytest.approx([0.1, 0.5, 1, 1, 0.6, 0.2, 0.2])
    assert LearningRateSchedule(warmup_steps=0).factor(10**6) == 1
    with pytest.raises(ValueError, match="expected warmup_steps"):
        LearningRateSchedule(warmup_steps=-1)


def test_a_resumed_run_goes_on_at_the_rate_of_its_step(tmp_path: Path) -> None:
    schedule = LearningRateSchedule(warmup_steps=39)
    trainer = fit(tmp_path, small_net(8, 1), schedule)
    assert trainer.optimizers[0].param_groups[0]["lr"] == pytest.approx(20 / 40 * 1e-12)
    trainer.save_checkpoint(tmp_path / "half.ckpt")
    resumed = fit(tmp_path, small_net(8, 1), schedule, epochs=2, resume=str(tmp_path / "half.ckpt"))
    assert resumed.global_step == 40
    assert resumed.optimizers[0].param_groups[0]["lr"] == pytest.approx(1e-12)
