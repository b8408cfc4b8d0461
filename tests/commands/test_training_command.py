"""Short help with groups on request, and a user's own task, loss and weights by name."""

import importlib
import os
import subprocess
import sys
from pathlib import Path
from typing import Any, ClassVar

import pytest
import torch
from lightning import Callback, LightningModule, Trainer
from planted import plant
from small_data import MESHES, SMALL_NET, small_meshes
from torch import Tensor, nn

import bpnp.cli as cli
import bpnp.commands.parser as parser
from bpnp import BPnPNet, Matcher
from bpnp.cli import main
from bpnp.files import CONFIGS
from bpnp.models.weights import TrainedNet
from bpnp.search.arguments import checked_prior, source_from
from bpnp.training import PoseLossWarmup
from bpnp.types import Prediction

pytestmark = pytest.mark.slow

SHORT = ["--trainer.max_epochs=1", "--trainer.limit_train_batches=2", "--trainer.limit_val_batches=1"]
seen: list[Any] = []


class Squares(nn.Module):
    """A loss of a user's: the sum of squares of the assignment, and none for the first pair."""

    needs_pose = False

    def __init__(self, factor: float = 1.0) -> None:
        super().__init__()
        self.factor = factor

    def forward(self, prediction: Any, batch: Any) -> Tensor:
        seen.append((self.factor, set(prediction.poses)))
        values = self.factor * prediction.assignment.square().sum((-2, -1))
        return torch.cat([values.new_full((1,), torch.nan), values[1:]])


class OwnTask(LightningModule):
    """A task of a user's with one weight."""

    def __init__(self, rate: float = 1.0) -> None:
        super().__init__()
        self.rate, self.weight = rate, nn.Parameter(torch.zeros(()))

    def training_step(self, batch: Any, batch_idx: int) -> Tensor:
        seen.append(self.rate)
        return (self.weight - batch.points2d.mean()) ** 2

    def validation_step(self, batch: Any, batch_idx: int) -> None:
        self.log("val/rotation_q2_deg", 0.0)

    def test_step(self, batch: Any, batch_idx: int) -> None:
        self.log("test/points", float(batch.points2d.shape[1]))

    def configure_optimizers(self) -> Any:
        return torch.optim.SGD(self.parameters(), lr=self.rate)


def folders(path: Path) -> list[str]:
    return [f"--trainer.default_root_dir={path}/run", f"--data.cache_dir={path}"]


@pytest.mark.parametrize("command", parser.LIGHTNING)
def test_help_is_short(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    main([command, "--help"])
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) < 40
    assert max(map(len, lines)) <= 110
    assert lines[0] == f"usage: bpnp {command} --config NAME [options]"


def test_a_loss_by_class_path_trains(tmp_path: Path) -> None:
    seen.clear()
    loss = ["--model.loss=test_training_command.Squares", "--model.loss.factor=2"]
    main(["fit", *MESHES, *SMALL_NET, *loss, *SHORT, *folders(tmp_path)])
    assert seen == [(2.0, set()), (2.0, set())]


def test_a_task_by_class_path_trains(tmp_path: Path) -> None:
    config = tmp_path / "own.yaml"
    config.write_text("model:\n  class_path: test_training_command.OwnTask\n  init_args:\n    rate: 0.5\n")
    options = ["--model=test_training_command.OwnTask", "--model.rate=0.5"]
    for way, own in (("options", options), ("file", [f"--config={config}"])):
        seen.clear()
        main(["fit", *MESHES, *own, *SHORT, *folders(tmp_path / way)])
        assert seen == [0.5, 0.5]
        assert (tmp_path / way / "run/checkpoints/last.ckpt").is_file()


def test_a_task_whose_test_step_returns_nothing_is_tested(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO")
    main(["test", "--model=test_training_command.OwnTask", *MESHES, *folders(tmp_path)])
    (said,) = (record.getMessage() for record in caplog.records if "test/points" in record.getMessage())
    assert "logged: test/points 24; no results folder: `test_step` does not return a dictionary" in said
    assert not (tmp_path / "run" / "test").exists()


def write_examples(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Write the examples of the contributing guide as the module `of_the_guide`."""
    guide = (Path(__file__).parents[2] / "CONTRIBUTING.md").read_text()
    (folder / "of_the_guide.py").write_text("".join(part.split("```")[0] for part in guide.split("```python\n")[1:]))
    monkeypatch.syspath_prepend(folder)
    monkeypatch.delitem(sys.modules, "of_the_guide", raising=False)


def test_loss_of_the_contributing_guide(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its value for a planted permutation and an even assignment, and a training with it."""
    write_examples(tmp_path, monkeypatch)
    loss, planted = importlib.import_module("of_the_guide").MissedMass(), plant(2, 5)
    for assignment, value in ((planted.permutation(), 0.0), (torch.full((2, 5, 5), 1 / 25), (1 - 5 / 25) ** 2)):
        assert loss(Prediction(assignment), planted.batch()).tolist() == pytest.approx([value] * 2, abs=1e-6)
    main(["fit", "--model.loss=of_the_guide.MissedMass", *MESHES, *SMALL_NET, *SHORT, *folders(tmp_path)])
    assert (tmp_path / "run" / "checkpoints" / "last.ckpt").exists()


def test_solver_and_metric_of_the_contributing_guide(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO")
    write_examples(tmp_path, monkeypatch)
    config = tmp_path / "metric.yaml"
    config.write_text("trainer:\n  callbacks:\n  - class_path: of_the_guide.DistanceError\n")
    main(["test", f"--config={config}", "--model.solver=of_the_guide.InFront", *MESHES, *folders(tmp_path)])
    data = small_meshes(tmp_path)
    data.setup("test")
    away = torch.cat([batch.translation.norm(dim=-1) for batch in data.test_dataloader()])
    (said,) = (text for text in caplog.messages if text.startswith("logged: "))
    name, value = said.removeprefix("logged: ").split()
    assert name == "test/distance_error"
    assert float(value) == pytest.approx(float((4 / away - 1).abs().median()), rel=1e-4)


@pytest.mark.nightly
def test_weights_of_a_task_by_class_path_are_trained(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    task = "--model=bpnp.training.task.BlindPnPTask"
    main(["test", task, "--model.init_args.weights=procedural-so3", *MESHES, *folders(tmp_path / "trained")])
    assert "untrained" not in "".join(capsys.readouterr())
    main(["test", task, *SMALL_NET, *MESHES, *folders(tmp_path / "untrained")])
    shown = capsys.readouterr()
    assert "untrained" in shown.err
    assert shown.out.index("The network is untrained") < shown.out.index("Pose errors")


@pytest.mark.parametrize(("name", "kind"), [("procedural-so3", BPnPNet), ("matcher-sfm", Matcher)])
def test_packaged_weights_are_found_by_name_wherever_a_checkpoint_is_taken(name: str, kind: type) -> None:
    for net in (source_from(name), checked_prior(name), TrainedNet.from_checkpoint(name)):
        assert type(net) is kind


def test_the_progress_bar_shows_the_loss_and_the_end_the_checkpoints(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "160")
    monkeypatch.setenv("FORCE_COLOR", "1")  # for a terminal
    monkeypatch.setenv("TERM", "xterm")
    main(["fit", *MESHES, *SMALL_NET, *SHORT, *folders(tmp_path)])
    printed = capsys.readouterr().out
    assert "train/loss:" in printed
    assert "v_num" not in printed
    for name in ("best", "last"):
        assert f"wrote {tmp_path}/run/checkpoints/{name}.ckpt" in printed.replace("\n", " ")


def test_a_class_in_the_current_folder_is_found(tmp_path: Path) -> None:
    (tmp_path / "solver_of_mine.py").write_text("from bpnp import BPnPNet\nclass Mine(BPnPNet): ...\n")
    data = ["--data=bpnp.datamodules.MeshDataModule", "--model.solver=solver_of_mine.Mine", "--print_config"]
    program = f"from bpnp.cli import main; main({['fit', *data]})"
    # Neither the script's folder nor the current one is on the path, as in the installed `bpnp`.
    environment = os.environ | {"PYTHONSAFEPATH": "1"}
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
    )
    assert "class_path: solver_of_mine.Mine" in done.stdout, done.stderr


def test_a_packaged_configuration_in_the_place_of_a_file_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    for config, is_reported in (("configs/quickstart.yaml", True), ("quickstart", False), ("presets/debug", False)):
        with pytest.raises(SystemExit):
            main(["fit", "--config=quickstart", f"--config={config}", "--print_config"])
        line = f"{config} is not in this folder; using the packaged {CONFIGS}"
        assert (line in capsys.readouterr().err) == is_reported


def test_ctrl_c_prints_the_command_that_resumes(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted(*_: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(cli, "parse_arguments", interrupted)
    for command, message in (("localize", "interrupted; run it again to continue"), ("solve", "interrupted")):
        with pytest.raises(SystemExit) as ended:
            main([command])
        assert ended.value.code == 130
        assert capsys.readouterr().err == f"bpnp: {message}\n"


class Watch(Callback):
    """Record the pose weight of each training step, and how many switches the trainer has."""

    weights: ClassVar[list[float]] = []
    switches: ClassVar[list[int]] = []

    def on_train_start(self, trainer: Trainer, pl_module: Any) -> None:
        self.weights.clear()
        self.switches[:] = [sum(isinstance(each, PoseLossWarmup) for each in trainer.callbacks)]

    def on_train_batch_end(self, trainer: Trainer, pl_module: Any, *_: Any) -> None:
        self.weights.append(pl_module.pose_weight)


class OwnWarmup(PoseLossWarmup):
    """A switch of a user's."""


EPOCHS = ["--trainer.max_epochs=3", "--trainer.limit_train_batches=1", "--trainer.limit_val_batches=0"]


OWN_SWITCH = ["--trainer.callbacks+=test_training_command.OwnWarmup"]


def test_the_switch_to_the_pose_loss_has_options_of_its_own(tmp_path: Path) -> None:
    own = tmp_path / "own.yaml"
    own.write_text(
        "trainer:\n  callbacks:\n  - class_path: test_training_command.Watch\n"
        "  - class_path: bpnp.training.PoseLossWarmup\n    init_args:\n      start_epoch: 120\n"
    )
    alone = ["--trainer.callbacks=test_training_command.Watch"]
    common = ["fit", *MESHES, *SMALL_NET, *EPOCHS, "--trainer.enable_progress_bar=false"]
    for name, options, weights, switches in (
        ("off", alone, [0, 0, 0], 0),
        ("on", [*alone, "--pose_loss.start_epoch=1"], [0, 1, 1], 1),
        ("weight", [*alone, "--pose_loss.start_epoch=2", "--pose_loss.weight=0.5"], [0, 0, 0.5], 1),
        ("of the model", [*alone, "--pose_loss.start_epoch=1", "--model.pose_weight=0.25"], [0, 0.25, 0.25], 1),
        ("merged", [f"--config={own}", "--pose_loss.start_epoch=1", "--pose_loss.weight=2"], [0, 2, 2], 1),
        ("of the user's", [*alone, *OWN_SWITCH, "--pose_loss.start_epoch=1"], [0, 1, 1], 1),
    ):
        main([*common, *options, *folders(tmp_path / name)])
        assert (Watch.weights, Watch.switches) == (weights, [switches]), name
    (saved,) = (tmp_path / "merged").rglob("config.yaml")
    main(["fit", f"--config={saved}", *folders(tmp_path / "again")])
    assert (Watch.weights, Watch.switches) == ([0, 2, 2], [1])


def test_a_weight_without_an_epoch_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["fit", *MESHES, *SMALL_NET, "--pose_loss.weight=0.5", *folders(tmp_path)])
    assert "--pose_loss.weight needs --pose_loss.start_epoch" in capsys.readouterr().err


@pytest.mark.nightly
@pytest.mark.parametrize(("user_policy", "policy"), [(None, "PASSIVE"), ("active", "ACTIVE")])
def test_threads_of_the_command_sleep_while_they_wait(user_policy: str | None, policy: str, tmp_path: Path) -> None:
    """OpenMP prints its settings when torch loads it."""
    environment = {name: value for name, value in os.environ.items() if name != "OMP_WAIT_POLICY"}
    environment |= {"OMP_DISPLAY_ENV": "true"} | ({"OMP_WAIT_POLICY": user_policy} if user_policy else {})
    line = [sys.executable, "-m", "bpnp", "fit", "--config=quickstart", "--print_config"]
    done = subprocess.run(line, cwd=tmp_path, env=environment, capture_output=True, text=True, check=True)
    assert f"OMP_WAIT_POLICY = '{policy}'" in done.stderr
    program = [sys.executable, "-c", "import bpnp, os; bpnp.Batch; print('OMP_WAIT_POLICY' in os.environ)"]
    done = subprocess.run(program, env=environment, capture_output=True, text=True, check=True)
    assert done.stdout == f"{user_policy is not None}\n"
