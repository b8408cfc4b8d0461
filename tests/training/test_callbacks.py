"""The learning rate follows its schedule, resumed or not; settings that mean nothing are refused."""

from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest
from lightning import Callback, LightningModule, Trainer
from planted import plant
from small_data import quiet_trainer, small_meshes, small_net
from torch.optim import Optimizer
from torch.utils.data import DataLoader

from bpnp.training.callbacks import ParameterCount, ProgressLines
from bpnp.training.task import BlindPnPTask


def test_the_rate_rises_stays_and_falls() -> None:
    task = BlindPnPTask(small_net(), warmup_steps=9, decay_start=100, decay_steps=50)
    steps = (0, 4, 9, 100, 125, 150, 10_000)
    assert [task.rate_factor(step) for step in steps] == pytest.approx([0.1, 0.5, 1, 1, 0.51, 0.02, 0.02])
    assert BlindPnPTask(small_net()).rate_factor(10**6) == 1


def test_a_resumed_run_goes_on_at_the_rate_of_its_step_or_on_another_schedule(tmp_path: Path) -> None:
    """Five steps an epoch, at a learning rate that changes next to nothing; `rates` is what each step was made with."""
    data = DataLoader([plant(2, 10).batch()] * 5, batch_size=None)  # type: ignore[arg-type]
    rates: list[float] = []

    class Rates(Callback):
        def on_before_zero_grad(self, trainer: Trainer, pl_module: LightningModule, optimizer: Optimizer) -> None:
            rates.append(optimizer.param_groups[0]["lr"])

    def fit(epochs: int, resume: str | None = None, *, rate: float = 1e-12, **schedule: int) -> Trainer:
        rates.clear()
        trainer = quiet_trainer(tmp_path, max_epochs=epochs, callbacks=[Rates()])
        task = BlindPnPTask(small_net(8, 1), learning_rate=rate, warmup_steps=9, **schedule)
        trainer.fit(task, data, ckpt_path=resume)
        return trainer

    fit(1).save_checkpoint(half := str(tmp_path / "half.ckpt"))
    assert rates == pytest.approx([k / 10 * 1e-12 for k in range(1, 6)])
    assert fit(2, half).global_step == 10
    assert rates == pytest.approx([k / 10 * 1e-12 for k in range(6, 11)])
    fit(2, half, decay_start=5, decay_steps=2)
    assert rates[2:] == pytest.approx([0.02 * k / 10 * 1e-12 for k in range(8, 11)])
    fit(2, half, rate=4e-12)
    assert rates[1:] == pytest.approx([k / 10 * 4e-12 for k in range(7, 11)])


def test_the_parameters_of_each_part_are_printed(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    task = BlindPnPTask(small_net(8, 1))
    frozen = next(iter(task.solver.features2d.parameters())).requires_grad_(False).numel()
    ParameterCount().on_fit_start(quiet_trainer(tmp_path, max_epochs=1), task)
    line = capsys.readouterr().out
    total = sum(parameter.numel() for parameter in task.parameters())
    assert line.startswith(f"BPnPNet: {total:,} parameters, {total - frozen:,} trained (features2d ")
    assert "FLOPs" not in line


def test_a_line_has_the_validation_of_its_own_epoch_only(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    options = {"max_epochs": 2, "check_val_every_n_epoch": 2, "limit_train_batches": 1, "limit_val_batches": 1}
    trainer = quiet_trainer(tmp_path, **options, callbacks=[lines := ProgressLines()])
    trainer.fit(BlindPnPTask(small_net()), datamodule=small_meshes(tmp_path))
    lines.on_train_epoch_end(trainer, trainer.lightning_module)  # of an epoch without a validation
    printed = capsys.readouterr().out.splitlines()
    assert ["val/correspondence_loss" in line for line in printed if line.startswith("epoch")] == [False, True, False]


@pytest.mark.parametrize("part", ["test", "predict"])
@pytest.mark.parametrize(("batches", "printed"), [(25, [3, 5, 8, 10, 13, 15, 18, 20, 23, 25]), (3, [1, 2, 3])])
def test_a_test_and_a_prediction_print_each_tenth(
    part: str, batches: int, printed: list[int], capsys: pytest.CaptureFixture[str]
) -> None:
    trainer = Mock(Trainer, is_global_zero=True, **{f"num_{part}_batches": [1, batches - 1]})  # of two loaders
    for batch in range(batches):
        getattr(ProgressLines(), f"on_{part}_batch_end")(trainer, Mock(LightningModule), None, None, batch)
    assert capsys.readouterr().out.splitlines() == [f"{done} of {batches} batches" for done in printed]


class Idle(LightningModule):
    """A module that does nothing with a batch."""

    def test_step(self, batch: Any, batch_idx: int, dataloader_idx: int = 0) -> None:
        pass

    def predict_step(self, batch: Any, batch_idx: int, dataloader_idx: int = 0) -> None:
        pass


def test_the_lines_of_a_test_with_two_loaders_count_all_batches(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    trainer = quiet_trainer(tmp_path, callbacks=[ProgressLines()])
    loaders = [DataLoader([0.0] * count, batch_size=None) for count in (3, 5)]  # type: ignore[arg-type]
    for run in (trainer.test, trainer.predict):
        run(Idle(), loaders)
        lines = [line for line in capsys.readouterr().out.splitlines() if line.endswith(" batches")]
        assert lines == [f"{k + 1} of 8 batches" for k in range(8)]
