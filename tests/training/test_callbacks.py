"""The learning rate follows its schedule, resumed or not; settings that mean nothing are refused."""

from pathlib import Path

import pytest
from lightning import LightningModule, Trainer
from planted import plant
from small_data import quiet_trainer, small_net
from torch import nn
from torch.utils.data import DataLoader

from bpnp.training.callbacks import CompileNets, LearningRateSchedule, PoseLossWarmup
from bpnp.training.task import BlindPnPTask


def test_the_rate_rises_stays_and_falls() -> None:
    schedule = LearningRateSchedule(warmup_steps=9, decay_start=100, decay_steps=50, final=0.2)
    steps = (0, 4, 9, 100, 125, 150, 10_000)
    assert [schedule.factor(step) for step in steps] == pytest.approx([0.1, 0.5, 1, 1, 0.6, 0.2, 0.2])
    assert LearningRateSchedule(warmup_steps=0).factor(10**6) == 1


def test_a_resumed_run_goes_on_at_the_rate_of_its_step(tmp_path: Path) -> None:
    """20 steps an epoch, at a learning rate that changes next to nothing."""
    data = DataLoader([plant(2, 10).batch()] * 20, batch_size=None)  # type: ignore[arg-type]

    def rate(epochs: int, resume: str | None = None) -> tuple[Trainer, float]:
        trainer = quiet_trainer(tmp_path, max_epochs=epochs, callbacks=[LearningRateSchedule(warmup_steps=39)])
        trainer.fit(BlindPnPTask(small_net(8, 1), learning_rate=1e-12), data, ckpt_path=resume)
        return trainer, trainer.optimizers[0].param_groups[0]["lr"]

    trainer, half = rate(1)
    assert half == pytest.approx(20 / 40 * 1e-12)
    trainer.save_checkpoint(tmp_path / "half.ckpt")
    resumed, full = rate(2, str(tmp_path / "half.ckpt"))
    assert resumed.global_step == 40
    assert full == pytest.approx(1e-12)


def test_the_nets_to_compile_are_the_solvers(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    compiled = []
    monkeypatch.setattr(nn.Module, "compile", lambda net, backend: compiled.append((net, backend)))
    task, trainer = LightningModule(), quiet_trainer(tmp_path)
    task.solver = net = small_net(8, 2)
    CompileNets(backend="eager").on_fit_start(trainer, task)
    assert compiled == [(net.features2d, "eager"), (net.features3d, "eager")]
    task.solver = nn.Identity()
    with pytest.raises(ValueError, match="expected a solver with `features2d` and `features3d`, got Identity"):
        CompileNets().on_fit_start(trainer, task)


def test_wrong_settings_are_refused() -> None:
    with pytest.raises(ValueError, match="expected warmup_steps"):
        LearningRateSchedule(warmup_steps=-1)
    with pytest.raises(ValueError, match="expected start_epoch >= 0"):
        PoseLossWarmup(start_epoch=-1)
