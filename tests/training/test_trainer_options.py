"""Options of Lightning's Trainer on the quickstart, at two steps: each changes a number that is known without it."""

import csv
import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
import wandb
from jsonargparse import Namespace
from lightning import Callback, Trainer
from lightning.pytorch.loggers import CSVLogger
from small_data import SMALL_FEATURES
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from torch import Tensor
from trainer_observer import Observer, command, fit, flat

from bpnp import Batch, BPnPNet
from bpnp.cli import main
from bpnp.commands.training import join_training
from bpnp.models.weights import read_checkpoint
from bpnp.report import read_results
from bpnp.training import BlindPnPTask, SafeCheckpointIO

pytestmark = pytest.mark.slow
TWO_STEPS = ["--trainer.limit_train_batches=2", "--trainer.max_epochs=1", "--trainer.limit_val_batches=0"]
TWO_EPOCHS = ["--trainer.limit_train_batches=1", "--trainer.max_epochs=2", "--trainer.limit_val_batches=0"]


@pytest.fixture(autouse=True)
def _one_thread() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def saved(folder: Path, name: str = "last") -> dict[str, Any]:
    return read_checkpoint(folder / "run" / "checkpoints" / f"{name}.ckpt")


def state(folder: Path, name: str = "last") -> torch.Tensor:
    """The parameters in a checkpoint, in the order of the observed task."""
    content = saved(folder, name)["state_dict"]
    return torch.cat([content[key].flatten() for key, _ in Observer.task.named_parameters()])


@pytest.mark.parametrize(("limit", "read"), [("1", "1"), ("1.0", "1.0"), ("0.5", "0.5")])
def test_a_limit_of_one_is_one_batch(limit: str, read: str) -> None:
    """In a process of its own: the cache of `typing` may have the annotation with int and float in the other order."""
    names = [f"limit_{part}_batches" for part in ("train", "val", "test", "predict")]
    words = ["fit", "--config=quickstart", *(f"--trainer.{name}={limit}" for name in names), "--print_config"]
    ended = subprocess.run([sys.executable, "-m", "bpnp", *words], capture_output=True, text=True, check=True)
    for name in names:
        assert f"  {name}: {read}\n" in ended.stdout


def test_fast_dev_run_takes_one_step_and_writes_nothing(tmp_path: Path) -> None:
    fit(tmp_path, "--trainer.fast_dev_run=true")
    assert len(Observer.problems) == 1
    assert Observer.validated == [0]
    assert not list((tmp_path / "run").rglob("*.ckpt"))
    for word in ("validate", "test", "predict"):
        main(command(tmp_path, "--trainer.fast_dev_run=true", word=word))
    assert not [path for path in (tmp_path / "run").rglob("*") if path.is_file()]


def test_overfit_batches_repeats_one_batch(tmp_path: Path) -> None:
    fit(tmp_path, "--trainer.overfit_batches=1", "--trainer.max_epochs=2")
    assert len(Observer.problems) == 2
    assert Observer.problems[0] == Observer.problems[1]


def test_limits_count_batches(tmp_path: Path) -> None:
    limits = ["--trainer.limit_train_batches=3", "--trainer.limit_val_batches=1", "--trainer.limit_test_batches=1"]
    fit(tmp_path, *limits, "--trainer.max_epochs=1", "--data.eval_batch_size=2")
    assert len(Observer.problems) == 3
    assert Observer.validated == [0]
    last = f"--ckpt_path={tmp_path}/run/checkpoints/last.ckpt"
    main(command(tmp_path, *limits, "--data.eval_batch_size=2", last, word="test"))
    assert read_results(tmp_path / "run" / "test").problems == 2


def test_accumulated_gradients_step_once_for_two_batches(tmp_path: Path) -> None:
    fit(tmp_path, *TWO_STEPS, "--trainer.accumulate_grad_batches=2")
    assert (len(Observer.problems), len(Observer.rates), saved(tmp_path)["global_step"]) == (2, 1, 1)
    assert torch.equal(Observer.weights[0], Observer.weights[1])
    assert not torch.equal(Observer.weights[1], Observer.weights[2])


def test_early_stopping_ends_the_training(tmp_path: Path) -> None:
    stop = ["--trainer.callbacks+=EarlyStopping", "--trainer.callbacks.monitor=val/correspondence_loss"]
    fit(tmp_path, *stop, "--trainer.callbacks.stopping_threshold=10", "--trainer.limit_train_batches=1")
    assert (Observer.trainer.current_epoch, len(Observer.problems)) == (1, 1)  # of 3 epochs


def test_a_checkpoint_callback_of_the_user_writes_in_addition_to_ours(tmp_path: Path) -> None:
    own = ["--trainer.callbacks+=ModelCheckpoint", "--trainer.callbacks.every_n_train_steps=1"]
    own += ["--trainer.callbacks.save_top_k=-1", f"--trainer.callbacks.dirpath={tmp_path}/own"]
    fit(tmp_path, *TWO_STEPS, *own, "--trainer.callbacks.filename={step}")
    assert sorted(path.name for path in (tmp_path / "own").iterdir()) == ["step=1.ckpt", "step=2.ckpt"]
    assert read_checkpoint(tmp_path / "own" / "step=1.ckpt")["global_step"] == 1
    assert saved(tmp_path)["global_step"] == 2


@pytest.mark.nightly
@pytest.mark.parametrize(("warmup_steps", "factors"), [(0, [1, 1]), (9, [0.1, 0.2])])
def test_the_rate_finder_sets_the_rate_of_the_training(warmup_steps: int, factors: list[float], tmp_path: Path) -> None:
    find = ["--trainer.callbacks+=LearningRateFinder", "--trainer.callbacks.num_training_steps=20"]
    find += ["--trainer.callbacks.min_lr=1e-6", "--trainer.callbacks.max_lr=0.1"]
    find += [f"--model.warmup_steps={warmup_steps}"]
    fit(tmp_path, *find, "--trainer.max_steps=2", "--trainer.limit_val_batches=0", "--data.train_problems=88")
    finder = next(each for each in Observer.trainer.callbacks if type(each).__name__ == "LearningRateFinder")
    suggested = finder.optimal_lr.suggestion()
    assert suggested not in (None, 1e-4)  # the rate of the quickstart
    assert Observer.rates == pytest.approx([suggested * factor for factor in factors])


@pytest.mark.nightly
def test_stochastic_weight_averaging_ends_at_the_mean_of_the_epochs(tmp_path: Path) -> None:
    average = ["--trainer.callbacks+=StochasticWeightAveraging", "--trainer.callbacks.swa_lrs=1e-3"]
    average += ["--trainer.callbacks.swa_epoch_start=2", "--trainer.callbacks.annealing_epochs=1"]
    fit(tmp_path, *TWO_EPOCHS, *average, "--trainer.max_epochs=3")
    # Lightning averages the weights that the second and the third epoch begin with.
    expected = (Observer.weights[1] + Observer.weights[2]) / 2
    torch.testing.assert_close(flat(Observer.task), expected)


@pytest.mark.nightly
def test_an_exponential_moving_average_is_what_is_saved(tmp_path: Path) -> None:
    average = ["--trainer.callbacks+=EMAWeightAveraging", "--trainer.callbacks.decay=0.75"]
    fit(tmp_path, *TWO_STEPS, *average, "--model.learning_rate=1e-2")
    _, first, second = Observer.weights
    expected = 0.75 * first + 0.25 * second  # the average begins at the first update
    torch.testing.assert_close(state(tmp_path), expected, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize(
    ("precision", "features", "weights"),
    [("bf16-mixed", torch.bfloat16, torch.float32), ("64-true", torch.float64, torch.float64)],
)
def test_each_precision_has_its_dtypes_of_features_and_weights(
    precision: str, features: torch.dtype, weights: torch.dtype, tmp_path: Path
) -> None:
    fit(tmp_path, *TWO_STEPS, f"--trainer.precision={precision}")
    assert Observer.dtypes == {features}
    assert state(tmp_path).dtype == weights
    assert Observer.task.skipped_steps == 0


class Ranks(Callback):
    """Append the number of processes and the problems of each step to a file of each process."""

    def on_train_batch_end(self, trainer: Trainer, pl_module: Any, outputs: Any, batch: Any, batch_idx: int) -> None:
        with open(f"{trainer.default_root_dir}/rank{trainer.global_rank}", "a") as file:
            file.write(f"{trainer.world_size} {len(batch)} {','.join(batch.ids)}\n")


@pytest.mark.nightly
@pytest.mark.parametrize("strategy", ["ddp", "ddp_spawn"])
def test_two_processes_share_each_batch(strategy: str, tmp_path: Path) -> None:
    options = [*TWO_STEPS, f"--trainer.strategy={strategy}", "--trainer.devices=2", "--trainer.accelerator=cpu"]
    line = [sys.executable, "-m", "bpnp", *command(tmp_path, *options)]
    line.append("--trainer.callbacks=test_trainer_options.Ranks")
    environment = os.environ | {"OMP_NUM_THREADS": "1", "CUDA_VISIBLE_DEVICES": ""}
    environment["PYTHONPATH"] = os.pathsep.join(sys.path)
    done = subprocess.run(line, env=environment, capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode == 0, done.stderr[-2000:]
    assert saved(tmp_path)["global_step"] == 2
    steps = [(tmp_path / "run" / f"rank{rank}").read_text().split() for rank in (0, 1)]
    assert [each[:2] + each[3:5] for each in steps] == [["2", "2"] * 2] * 2  # of a batch of 4
    problems = [name for each in steps for names in (each[2], each[5]) for name in names.split(",")]
    assert len(set(problems)) == 8


def test_the_weights_that_a_process_passes_on_are_read_as_they_were(tmp_path: Path) -> None:
    """`ddp_spawn` and `ddp_notebook` write a state without a checkpoint around it."""
    files, weights = SafeCheckpointIO(), {"solver.a": torch.arange(3.0), "solver.b": torch.ones(())}
    files.save_checkpoint(weights, tmp_path / ".temp.ckpt")
    read = files.load_checkpoint(tmp_path / ".temp.ckpt")
    assert read.keys() == weights.keys()
    assert all(torch.equal(read[name], value) for name, value in weights.items())


def test_the_csv_logger_has_a_row_for_each_step(tmp_path: Path) -> None:
    fit(tmp_path, *TWO_STEPS, "--trainer.log_every_n_steps=1")
    (file,) = (tmp_path / "run").rglob("metrics.csv")
    with file.open(newline="") as rows:
        losses = [float(row["train/loss"]) for row in csv.DictReader(rows) if row.get("train/loss")]
    assert len(losses) == 2
    assert losses[-1] == pytest.approx(float(Observer.trainer.callback_metrics["train/loss"]))


def test_the_tensorboard_logger_has_the_loss_of_each_step(tmp_path: Path) -> None:
    logger = ["--trainer.logger=TensorBoardLogger", f"--trainer.logger.save_dir={tmp_path}/board"]
    fit(tmp_path, *TWO_STEPS, *logger, "--trainer.log_every_n_steps=1")
    (file,) = (tmp_path / "board").rglob("events.out.tfevents.*")
    events = EventAccumulator(str(file)).Reload()
    losses = [event.value for event in events.Scalars("train/loss")]
    assert len(losses) == 2
    assert losses[-1] == pytest.approx(float(Observer.trainer.callback_metrics["train/loss"]), rel=1e-6)


@pytest.mark.nightly
def test_the_wandb_logger_has_the_loss_of_the_last_step(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("WANDB_MODE", "offline")  # Lightning's logger sets it too, for the whole process
    logger = ["--trainer.logger=WandbLogger", f"--trainer.logger.save_dir={tmp_path}/wandb"]
    logger += ["--trainer.logger.project=bpnp", "--trainer.logger.mode=offline"]
    fit(tmp_path, *TWO_STEPS, *logger, "--trainer.log_every_n_steps=1")
    run = Observer.trainer.loggers[0].experiment
    assert run.summary["trainer/global_step"] == 1
    assert run.summary["train/loss"] == pytest.approx(float(Observer.trainer.callback_metrics["train/loss"]))
    run.finish()


def read_wandb(folder: Path) -> tuple[dict[str, Any], dict[str, Any], dict[str, Any]]:
    """Run, hyperparameters and last metrics of a W&B folder, as W&B reads them."""
    command = [sys.executable, "-m", "wandb", "leet", "inspect", str(folder), "--json"]
    lines = subprocess.run(command, check=True, capture_output=True, text=True).stdout.splitlines()
    found: dict[str, dict[str, Any]] = {"run": {}, "config": {}, "summary": {}}
    for record in map(json.loads, lines):
        if (kind := record["type"]) in found:
            found[kind] |= record[kind] if kind == "run" else record[kind]["update"]
    return found["run"], found["config"], found["summary"]


def run_id(folder: Path) -> str:
    """Id of an offline run of W&B; the name of its folder ends in a number too where two begin in one second."""
    (file,) = folder.glob("run-*.wandb")
    return file.stem.removeprefix("run-")


@pytest.mark.nightly
def test_a_test_is_logged_into_the_wandb_run_of_its_training(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Offline, it is another folder with the id of the training's run."""
    monkeypatch.setenv("WANDB_MODE", "offline")  # Lightning's logger sets it too, for the whole process
    options = ["--trainer.logger=WandbLogger", "--trainer.logger.mode=offline", "--data.test_shapes=1"]
    trained_with = ["--model.learning_rate=0.25", "--trainer.log_every_n_steps=1", "--pose_loss.start_epoch=0"]
    main(command(tmp_path, *TWO_STEPS, *options, *trained_with))
    wandb.finish()
    (trained,) = (tmp_path / "run" / "wandb").glob("offline-run-*")
    last = f"{tmp_path}/run/checkpoints/last.ckpt"
    main(command(tmp_path, *options, "--trainer.logger.name=other", f"--ckpt_path={last}", word="test"))
    wandb.finish()
    (tested,) = set((tmp_path / "run" / "wandb").glob("offline-run-*")) - {trained}
    name = run_id(trained)
    assert run_id(tested) == name
    assert f"W&B: the results go into run {name} of the training in {tmp_path}/run;" in caplog.text
    trained_run, hyperparameters, losses = read_wandb(trained)
    run, config, metrics = read_wandb(tested)
    assert hyperparameters["learning_rate"] == 0.25
    assert config.keys() == {"test"}  # the training keeps its hyperparameters
    assert config["test"]["ckpt_path"] == last
    assert run["resume"] is True  # so that `wandb sync` adds it to the run of the training
    assert run["project"] == trained_run["project"]
    assert "display_name" not in run  # that of the training stays
    logged = read_results(tmp_path / "run" / "test").estimates["pnp"]["rotation_q2_deg"]
    assert metrics["test/pnp/rotation_q2_deg"] == pytest.approx(logged, rel=1e-5)
    assert "train/loss" in losses
    assert metrics["trainer/global_step"] == 2  # steps of the checkpoint; a test itself counts from 0
    assert "epoch" not in metrics


@pytest.mark.nightly
def test_a_training_that_goes_on_stays_in_its_wandb_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Two continuations have the same id; a training from a checkpoint of another folder has its own."""
    monkeypatch.setenv("WANDB_MODE", "offline")
    options = ["--trainer.logger=WandbLogger", "--trainer.logger.mode=offline", "--trainer.limit_train_batches=1"]
    options += ["--trainer.log_every_n_steps=1", "--pose_loss.start_epoch=0"]
    last = f"--ckpt_path={tmp_path}/run/checkpoints/last.ckpt"
    for epochs, start in ((1, []), (2, [last]), (3, [last])):
        main(command(tmp_path, *options, f"--trainer.max_epochs={epochs}", *start))
        wandb.finish()
    folders = sorted((tmp_path / "run" / "wandb").glob("offline-run-*"))
    assert len(folders) == 3
    (name,) = set(map(run_id, folders))
    assert caplog.text.count(f"W&B: the next steps go into run {name} of the training in {tmp_path}/run;") == 2
    assert sorted(read_wandb(folder)[2]["trainer/global_step"] for folder in folders) == [0, 1, 2]
    other = f"--trainer.default_root_dir={tmp_path}/other"
    main(command(tmp_path, *options, "--trainer.max_epochs=4", last, other))
    wandb.finish()
    (folder,) = (tmp_path / "other" / "wandb").glob("offline-run-*")
    assert run_id(folder) != name


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("options", "joined"),
    [
        ({}, True),
        ({"project": "bpnp"}, True),
        ({"project": "another"}, False),
        ({"id": "own"}, False),
        ({"version": "own"}, False),
    ],
)
def test_a_test_has_a_wandb_run_of_its_own_if_its_logger_names_one(
    options: dict[str, str], *, joined: bool, tmp_path: Path
) -> None:
    log = tmp_path / "logs" / "version_0"
    log.mkdir(parents=True)
    (log / "metrics.csv").write_text("step,train/loss\n1,0.5\n")
    (log / "config.yaml").write_text("seed_everything: 0\n")
    (log / "wandb.yaml").write_text("id: first\nproject: bpnp\n")
    (tmp_path / "checkpoints").mkdir()
    torch.save({"state_dict": {}, "global_step": 7}, tmp_path / "checkpoints" / "last.ckpt")
    given = Namespace(name="a", save_dir=".", version=None, id=None, project=None)
    logger = Namespace(class_path="lightning.pytorch.loggers.WandbLogger", init_args=given)
    given.update(Namespace(**options))
    unchanged = logger.clone()
    join_training(logger, str(tmp_path / "checkpoints" / "last.ckpt"), "test")
    if joined:
        assert (given.id, given.project, given.resume) == ("first", "bpnp", "allow")
        assert (given.name, given.step) == (None, 7)
    else:
        assert logger == unchanged


class Stop(Callback):
    """Ctrl-C after the first step."""

    def on_train_batch_end(self, *_: Any) -> None:
        raise KeyboardInterrupt


@pytest.mark.nightly
def test_a_run_goes_on_after_ctrl_c(tmp_path: Path) -> None:
    with pytest.raises(SystemExit) as ended:
        fit(tmp_path, "--trainer.callbacks+=test_trainer_options.Stop", "--trainer.max_steps=2")
    assert ended.value.code == 130
    assert saved(tmp_path, "interrupted")["global_step"] == 1
    stopped = state(tmp_path, "interrupted")
    fit(tmp_path, "--trainer.max_steps=3", f"--ckpt_path={tmp_path}/run/checkpoints/interrupted.ckpt")
    assert len(Observer.rates) == 2
    torch.testing.assert_close(stopped, Observer.weights[0])
    assert saved(tmp_path)["global_step"] == 3


def test_a_run_resumed_after_the_switch_has_the_pose_loss_from_its_first_step(tmp_path: Path) -> None:
    switch = ["--pose_loss.start_epoch=1", "--pose_loss.weight=0.5"]
    fit(tmp_path, *TWO_EPOCHS, *switch)
    assert Observer.pose_weights == [0, 0.5]
    later = ["--pose_loss.start_epoch=90", "--pose_loss.weight=0.5", "--trainer.max_epochs=3"]
    fit(tmp_path, *TWO_EPOCHS, *later, f"--ckpt_path={tmp_path}/run/checkpoints/last.ckpt")
    assert Observer.pose_weights == [0.5]


@pytest.mark.filterwarnings("ignore:The (pose loss joins|training has ended)")
@pytest.mark.parametrize(
    ("first", "later", "weights"),
    [
        (["--pose_loss.start_epoch=1", "--pose_loss.weight=0.5"], [], [0.5, 0.5]),
        (["--pose_loss.start_epoch=3"], [], [0.0, 1.0]),
        (["--pose_loss.start_epoch=3"], ["--pose_loss.weight=2"], [0.0, 2.0]),
        (["--model.pose_weight=0.25"], [], [0.25, 0.25]),
    ],
)
def test_a_resumed_run_has_the_pose_loss_of_its_checkpoint(
    first: list[str], later: list[str], weights: list[float], tmp_path: Path
) -> None:
    """Two epochs, and two more."""
    fit(tmp_path, *TWO_EPOCHS, *first)
    fit(tmp_path, *TWO_EPOCHS, *later, "--trainer.max_epochs=4", f"--ckpt_path={tmp_path}/run/checkpoints/last.ckpt")
    assert Observer.pose_weights == weights


def test_predict_writes_the_poses_of_a_limited_number_of_batches(tmp_path: Path) -> None:
    fit(tmp_path, *TWO_STEPS)
    last = f"--ckpt_path={tmp_path}/run/checkpoints/last.ckpt"
    main(command(tmp_path, "--trainer.limit_predict_batches=1", "--data.eval_batch_size=3", last, word="predict"))
    with (tmp_path / "run" / "predictions.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len({row["id"] for row in rows}) == 3
    assert {row["estimate"] for row in rows} == {"ransac", "pnp", "refined"}


class Derived(BPnPNet):
    """A user's own network, and one that derives from it."""


class Twice(Derived):
    def cost(self, batch: Batch) -> Tensor:
        return 2 * super().cost(batch)


def test_a_network_two_classes_below_ours_comes_back_from_its_checkpoint(tmp_path: Path) -> None:
    fit(tmp_path, *TWO_STEPS, "--model.solver=test_trainer_options.Twice", *SMALL_FEATURES)
    net = BPnPNet.from_checkpoint(tmp_path / "run" / "checkpoints" / "last.ckpt")
    assert type(net) is Twice
    batch = Batch.from_arrays(torch.rand(9, 2), torch.rand(12, 3))
    task = BlindPnPTask.load_from_checkpoint(tmp_path / "run" / "checkpoints" / "last.ckpt").eval()
    for found in (net, task.solver, Observer.task.solver.eval()):
        expected = 2 * BPnPNet.cost(net, batch)
        torch.testing.assert_close(found.cost(batch), expected)


@pytest.mark.nightly
@pytest.mark.parametrize("rarely", ["check_val_every_n_epoch=5", "val_check_interval=0.4"])
def test_the_last_steps_are_saved_and_continued(rarely: str, tmp_path: Path) -> None:
    """Six steps an epoch; no validation follows the last ones."""
    options = [f"--trainer.{rarely}", "--model.learning_rate=1e-2"]
    fit(tmp_path, *options, "--trainer.max_epochs=1")
    assert saved(tmp_path)["global_step"] == 6
    fit(tmp_path, *options, "--trainer.max_epochs=2", f"--ckpt_path={tmp_path}/run/checkpoints/last.ckpt")
    assert saved(tmp_path)["global_step"] == 12
    resumed = state(tmp_path)
    fit(tmp_path / "straight", *options, "--trainer.max_epochs=2")
    torch.testing.assert_close(state(tmp_path / "straight"), resumed, rtol=0, atol=0)


@pytest.mark.nightly
@pytest.mark.parametrize("validated", ["limit_val_batches=1", "limit_val_batches=0"])
def test_an_epoch_that_max_steps_ended_is_finished_by_the_next_run(validated: str, tmp_path: Path) -> None:
    """The second of six-step epochs is stopped after two steps."""
    options = [f"--trainer.{validated}", "--model.learning_rate=1e-2", "--trainer.max_epochs=3"]
    fit(tmp_path, *options, "--trainer.max_steps=8")
    assert (saved(tmp_path)["epoch"], saved(tmp_path)["global_step"]) == (1, 8)
    fit(tmp_path, *options, "--ckpt_path=last")
    assert saved(tmp_path)["global_step"] == 18
    resumed = state(tmp_path)
    fit(tmp_path / "straight", *options)
    torch.testing.assert_close(state(tmp_path / "straight"), resumed, rtol=0, atol=0)


def test_no_checkpoints_are_written_without_checkpointing(tmp_path: Path) -> None:
    fit(tmp_path, *TWO_STEPS, "--trainer.enable_checkpointing=false")
    assert len(Observer.problems) == 2
    assert not list(tmp_path.rglob("*.ckpt"))


def test_a_schedule_without_an_optimizer_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    schedule = ["--lr_scheduler=torch.optim.lr_scheduler.StepLR", "--lr_scheduler.step_size=10"]
    with pytest.raises(SystemExit):
        fit(tmp_path, *TWO_STEPS, *schedule)
    assert "--lr_scheduler needs --optimizer, such as --optimizer Adam" in capsys.readouterr().err


class TaggedLogger(CSVLogger):
    """A logger whose folder is among its other options."""

    def __init__(self, tag: str = "", **options: Any) -> None:
        super().__init__(**options)


def test_a_logger_has_its_folder_among_other_options(tmp_path: Path) -> None:
    options = [f"--trainer.logger={TaggedLogger.__module__}.{TaggedLogger.__qualname__}"]
    options += ["--trainer.logger.name=tagged", f"--trainer.logger.save_dir={tmp_path}/own"]
    fit(tmp_path, *TWO_STEPS, *options)
    assert (tmp_path / "own" / "tagged" / "version_0").is_dir()


@pytest.mark.parametrize("words", [["--data.cache_dir=None"], ["--data.cache_dir", "None"]])
def test_none_is_null(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    """Not a folder of this name."""
    with pytest.raises(SystemExit) as ended:
        main(["fit", "--config=quickstart", *words, "--print_config"])
    assert ended.value.code == 0
    assert "cache_dir: null" in capsys.readouterr().out


class StopAtStep(Callback):
    """Interruption within an epoch."""

    def __init__(self, step: int) -> None:
        self.step = step

    def on_train_batch_end(self, trainer: Trainer, *_: Any) -> None:
        if trainer.global_step == self.step:
            raise RuntimeError("stopped")


def test_an_epoch_with_the_pose_loss_is_resumed_with_it(tmp_path: Path) -> None:
    """The second of six-step epochs has the pose loss, and is stopped after two steps."""
    options = ["--trainer.max_epochs=2", "--pose_loss.start_epoch=1", "--model.learning_rate=1e-3"]
    stop = f"{StopAtStep.__module__}.{StopAtStep.__qualname__}"
    with pytest.raises(RuntimeError, match="stopped"):
        fit(tmp_path, *options, f"--trainer.callbacks+={stop}", "--trainer.callbacks.step=8")
    fit(tmp_path, *options, "--ckpt_path=last")
    assert Observer.pose_weights == [1.0] * 4
    resumed = state(tmp_path)
    fit(tmp_path / "straight", *options)
    assert Observer.pose_weights == [0.0] * 6 + [1.0] * 6
    torch.testing.assert_close(state(tmp_path / "straight"), resumed, rtol=0, atol=0)
