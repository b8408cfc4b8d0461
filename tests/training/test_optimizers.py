"""Optimizers of the command line, steps without a finite gradient, and what a resumed run takes from its checkpoint."""

import math
from pathlib import Path

import pytest
import torch
from lightning import Callback, LightningModule, Trainer
from lightning.pytorch.callbacks import ModelCheckpoint, StochasticWeightAveraging
from lightning.pytorch.utilities.types import OptimizerLRScheduler
from planted import plant
from small_data import quiet_trainer, small_net
from torch.optim import SGD, Adam, Optimizer
from torch.optim.lr_scheduler import CyclicLR, OneCycleLR
from torch.utils.data import DataLoader
from trainer_observer import Observer, fit, flat

from bpnp.training.task import BlindPnPTask

pytestmark = pytest.mark.slow
SHORT = ["--trainer.max_steps=4", "--trainer.limit_val_batches=0"]
BROKEN = "--trainer.callbacks+=test_optimizers.Broken"
OPTIMIZERS = ["torch.optim.Adam", "torch.optim.AdamW", "torch.optim.SGD", "torch.optim.RMSprop"]


class Broken(Callback):
    """Replace a gradient of the third step by NaN."""

    def on_after_backward(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if trainer.global_step == 2:
            next(p.grad for p in pl_module.parameters() if p.grad is not None)[0] = math.nan


@pytest.mark.parametrize("name", OPTIMIZERS)
def test_a_step_with_a_nan_gradient_is_skipped_and_counted(name: str, tmp_path: Path) -> None:
    fit(tmp_path, f"--optimizer={name}", "--optimizer.lr=1e-3", "--optimizer.weight_decay=0.1", *SHORT, BROKEN)
    assert type(Observer.trainer.optimizers[0]).__name__ == name.rpartition(".")[2]
    before, after = Observer.weights[2], Observer.weights[3]
    assert torch.equal(before, after)
    assert Observer.weights[-1].isfinite().all()
    assert not torch.equal(Observer.weights[-1], after)
    assert Observer.task.skipped_steps == 1


def test_the_rate_of_an_optimizer_is_printed(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """It is that of torch where the command has none, not that of the model."""
    caplog.set_level("INFO")
    fit(tmp_path, *SHORT, "--optimizer=torch.optim.AdamW", "--model.learning_rate=1e-5", "--trainer.max_steps=1")
    assert "AdamW with learning rate 0.001; model.learning_rate and model.weight_decay are not used" in caplog.text
    assert Observer.rates == [1e-3]
    assert not [record for record in caplog.records if "will be overridden" in record.getMessage()]


def test_the_first_step_of_sgd_is_the_rate_times_the_gradient(tmp_path: Path) -> None:
    fit(tmp_path, *SHORT, "--optimizer=torch.optim.SGD", "--optimizer.lr=0.25", "--trainer.max_steps=1")
    moved = Observer.weights[0] - Observer.weights[1]
    torch.testing.assert_close(moved, 0.25 * Observer.gradient, rtol=1e-4, atol=1e-7)


def test_a_scheduler_of_the_command_line_sets_the_rate(tmp_path: Path) -> None:
    schedule = ["--lr_scheduler=torch.optim.lr_scheduler.ExponentialLR", "--lr_scheduler.gamma=0.5"]
    options = ["--optimizer=torch.optim.AdamW", "--optimizer.lr=1e-4", *schedule]
    fit(tmp_path, *SHORT, *options, "--trainer.max_epochs=3", "--trainer.limit_train_batches=1")
    assert Observer.rates == pytest.approx([1e-4, 5e-5, 2.5e-5])


def test_an_optimizer_of_the_command_line_keeps_the_warm_up_of_the_task(tmp_path: Path) -> None:
    fit(tmp_path, *SHORT, "--optimizer=torch.optim.AdamW", "--optimizer.lr=1e-4", "--model.warmup_steps=9")
    assert Observer.rates == pytest.approx([1e-5, 2e-5, 3e-5, 4e-5])


def test_a_resumed_run_has_the_options_of_its_checkpoint_and_those_of_its_command(tmp_path: Path) -> None:
    own = ["--model.learning_rate=1e-4", "--model.weight_decay=0.1", "--model.matching_loss=likelihood"]
    fit(tmp_path, *SHORT, *own, "--model.warmup_steps=1", "--trainer.max_steps=2")
    assert Observer.rates == pytest.approx([5e-5, 1e-4])
    last = f"--ckpt_path={tmp_path}/run/checkpoints/last.ckpt"
    fit(tmp_path, *SHORT, last, "--trainer.max_steps=4")
    task, group = Observer.task, Observer.trainer.optimizers[0].param_groups[0]
    assert (task.learning_rate, task.warmup_steps, task.matching_loss) == (1e-4, 1, "likelihood")
    assert (Observer.rates, group["weight_decay"]) == (pytest.approx([1e-4, 1e-4]), 0.1)
    fit(tmp_path, *SHORT, last, "--trainer.max_steps=6", "--model.learning_rate=3e-6", "--model.warmup_steps=9")
    task, group = Observer.task, Observer.trainer.optimizers[0].param_groups[0]
    assert (task.hparams.learning_rate, task.hparams.weight_decay) == (3e-6, 0.1)
    assert group["weight_decay"] == 0.1
    assert Observer.rates[1:] == pytest.approx([0.6 * 3e-6])
    assert (Observer.weights[1] - Observer.weights[0]).abs().max() < 4e-6  # a step of Adam is at most its rate


def test_a_resumed_run_has_the_rate_that_its_command_gives_an_optimizer(tmp_path: Path) -> None:
    options = [*SHORT, "--optimizer=torch.optim.SGD", "--optimizer.momentum=0.5"]
    fit(tmp_path, *options, "--optimizer.lr=1e-3", "--trainer.max_steps=1")
    last = f"--ckpt_path={tmp_path}/run/checkpoints/last.ckpt"
    fit(tmp_path, *options, "--optimizer.lr=1e-4", "--optimizer.momentum=0.25", last, "--trainer.max_steps=2")
    assert Observer.rates == [1e-4]
    assert Observer.trainer.optimizers[0].param_groups[0]["momentum"] == 0.25


def test_a_resumed_run_keeps_a_reduced_rate(tmp_path: Path) -> None:
    plateau = ["--lr_scheduler=lightning.pytorch.cli.ReduceLROnPlateau", "--lr_scheduler.monitor=train/loss"]
    plateau += ["--lr_scheduler.patience=0", "--lr_scheduler.threshold=1e9", "--lr_scheduler.factor=0.5"]
    options = ["--optimizer=torch.optim.Adam", "--optimizer.lr=1e-4", *plateau, "--trainer.limit_train_batches=1"]
    fit(tmp_path, *SHORT, *options, "--trainer.max_steps=3")
    reduced = Observer.rates[-1]
    assert reduced < 1e-4
    last = f"--ckpt_path={tmp_path}/run/checkpoints/last.ckpt"
    fit(tmp_path, *SHORT, *options, "--trainer.max_epochs=9", last)
    assert Observer.rates[0] == reduced


def test_a_checkpoint_of_another_optimizer_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    fit(tmp_path, *SHORT, "--trainer.max_steps=1")
    last = f"--ckpt_path={tmp_path}/run/checkpoints/last.ckpt"
    with pytest.raises(SystemExit):
        fit(tmp_path, *SHORT, "--optimizer=torch.optim.RMSprop", last)
    error = capsys.readouterr().err
    assert "The checkpoint was trained with Adam, and this run uses RMSprop." in error


@pytest.mark.parametrize(("precision", "fused"), [("32-true", True), ("16-mixed", False), ("bf16-mixed", False)])
def test_adam_is_fused_where_the_gradients_cannot_be_scaled(precision: str, fused: bool) -> None:
    """A fused optimizer unscales the gradients itself, so Lightning refuses to clip them."""
    task = BlindPnPTask(small_net(8, 1))
    task.trainer = Trainer(accelerator="cpu", logger=False, enable_checkpointing=False)
    task.trainer.strategy.precision_plugin.precision = precision  # type: ignore[assignment]
    assert task.configure_optimizers().defaults["fused"] is fused  # type: ignore[union-attr]


def test_gradients_scaled_by_mixed_precision_are_clipped(tmp_path: Path) -> None:
    """float16 with a scaler on the CPU, as on a GPU."""
    from lightning.pytorch.plugins import MixedPrecision

    class Norms(Callback):
        seen = list[float]()

        def on_before_zero_grad(self, trainer: Trainer, pl_module: LightningModule, optimizer: Optimizer) -> None:
            gradients = [p.grad for p in pl_module.parameters() if p.grad is not None]
            self.seen += [float(torch.nn.utils.get_total_norm(gradients))] if gradients else []

    norms = Norms()
    plugin = MixedPrecision("16-mixed", "cpu", torch.amp.GradScaler("cpu", init_scale=1024.0))
    data = DataLoader([plant(2, 10, dtype=torch.float32).batch()] * 3, batch_size=None)  # type: ignore[arg-type]
    trainer = quiet_trainer(tmp_path, max_epochs=1, callbacks=[norms], plugins=[plugin], gradient_clip_val=1e-3)
    task = BlindPnPTask(small_net(8, 1), learning_rate=1e-3)
    trainer.fit(task, data)
    assert task.skipped_steps == 0
    assert norms.seen[-1] == pytest.approx(1e-3, rel=1e-2)


class OneCycle(BlindPnPTask):
    """A user's task, whose schedule also changes the momentum of Adam."""

    def configure_optimizers(self) -> OptimizerLRScheduler:
        optimizer = Adam(self.parameters(), lr=1e-3)
        schedule = OneCycleLR(optimizer, 1e-2, total_steps=12)
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}


class Cyclic(BlindPnPTask):
    """A user's task, whose schedule also changes the momentum of SGD."""

    def configure_optimizers(self) -> OptimizerLRScheduler:
        optimizer = SGD(self.parameters(), lr=1e-3, momentum=0.9)
        schedule = CyclicLR(optimizer, 1e-3, 1e-2, step_size_up=4)
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}


class Averaged(BlindPnPTask):
    """A task with weights that are averaged, at a learning rate of their own, from the second epoch on."""

    def configure_callbacks(self) -> list[Callback]:
        return [StochasticWeightAveraging(swa_lrs=5e-3, swa_epoch_start=1)]


@pytest.mark.parametrize(("kind", "warmup_steps"), [(OneCycle, 0), (Cyclic, 0), (Averaged, 0), (Averaged, 9)])
def test_a_resumed_training_equals_an_uninterrupted_one(
    kind: type[BlindPnPTask], warmup_steps: int, tmp_path: Path
) -> None:
    data = DataLoader([plant(2, 10, dtype=torch.float32).batch()] * 3, batch_size=None)  # type: ignore[arg-type]

    def train(checkpoint: Path | None = None) -> torch.Tensor:
        torch.manual_seed(0)
        task = kind(small_net(8, 1), learning_rate=1e-3, warmup_steps=warmup_steps)
        keep = ModelCheckpoint(tmp_path, filename="{epoch}", save_top_k=-1, enable_version_counter=False)
        trainer = quiet_trainer(tmp_path, max_epochs=4, callbacks=[keep], enable_checkpointing=True)
        trainer.fit(task, data, ckpt_path=checkpoint)
        return flat(task)

    whole = train()
    torch.testing.assert_close(train(tmp_path / "epoch=1.ckpt"), whole, rtol=0, atol=0)
