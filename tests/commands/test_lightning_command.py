"""The network of the checkpoint, the run folder, predictions and messages of `bpnp fit|validate|test|predict`."""

import csv
import inspect
import json
import re
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from lightning import Callback, LightningDataModule, Trainer
from lightning.pytorch.cli import LightningCLI
from lightning.pytorch.loggers import Logger
from planted import plant, posed
from small_data import MESHES, SMALL_FEATURES, SMALL_NET, quiet_trainer
from torch import nn
from torch.utils.data import DataLoader

from bpnp import Batch, BPnPNet, Prediction
from bpnp.cli import main
from bpnp.datamodules import MeshDataModule
from bpnp.datamodules.problem import Problem, stack_problems
from bpnp.geometry import quaternion_rotation
from bpnp.report import read_results
from bpnp.training import BlindPnPTask

pytestmark = pytest.mark.slow

OTHERS = [
    "--model.solver.features2d.centre=true",
    "--model.solver.features2d.scale=4",
    "--model.solver.features3d.centre=true",
    "--model.solver.features3d.normalise=true",
    "--model.solver.transport=bpnp.layers.Sinkhorn",
    "--model.solver.transport.mu=0.2",
    "--model.solver.ransac=bpnp.layers.RansacPnP",
    "--model.solver.ransac.threshold=0.03",
]
SHORT = ["--trainer.max_epochs=1", "--trainer.limit_train_batches=2", "--trainer.limit_val_batches=1"]


def words(command: str, folder: Path, *options: str) -> list[str]:
    return [command, *MESHES, f"--data.cache_dir={folder}/cache", f"--trainer.default_root_dir={folder}/run", *options]


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a run of a network whose settings are not the default ones."""
    folder = tmp_path_factory.mktemp("trained")
    main(words("fit", folder, *SMALL_NET, *OTHERS, *SHORT, "--model.learning_rate=1e-3"))
    return folder


def loss_of_test(folder: Path, name: str, *options: str) -> float:
    """The loss of a test of the trained checkpoint."""
    test_options = [f"--ckpt_path={folder}/run/checkpoints/last.ckpt", f"--results.folder={folder}/{name}", *options]
    main(words("test", folder, *test_options))
    loss = read_results(folder / name).correspondence_loss
    assert loss is not None
    return loss


def test_a_test_runs_the_network_of_the_checkpoint(trained: Path, tmp_path: Path) -> None:
    own = loss_of_test(trained, "own", *SMALL_NET, *OTHERS)
    task = BlindPnPTask.load_from_checkpoint(trained / "run/checkpoints/last.ckpt")
    assert task.solver.features2d.scale == 4
    config = tmp_path / "widths.yaml"
    config.write_text("model:\n  solver: bpnp.models.BPnPNet\n  learning_rate: 0.5\n")
    for name, options in {
        "nothing": [],
        "class": ["--model.solver=bpnp.models.BPnPNet"],
        "widths": SMALL_NET,
        "file": [f"--config={config}"],
        "task": ["--model=bpnp.training.BlindPnPTask"],
        "best": ["--ckpt_path=best"],
    }.items():
        assert loss_of_test(trained, name, *options) == pytest.approx(own, abs=1e-6), name
    recorded = read_results(trained / "nothing").settings["solver"]
    assert recorded["init_args"]["transport"]["init_args"]["mu"] == 0.2


def test_an_option_that_contradicts_the_checkpoint_is_an_error(trained: Path, fails: Callable[..., str]) -> None:
    checkpoint = f"--ckpt_path={trained}/run/checkpoints/last.ckpt"
    for option, message in (
        ("--model.solver.features2d.scale=1", "features2d.scale=1.0 (saved: 4.0)"),
        ("--model.solver.features2d.centre=false", "features2d.centre=False (saved: True)"),
        ("--model.solver.features3d.channels=32", "features3d.channels=32 (saved: 16)"),
    ):
        assert message in fails(*words("test", trained, checkpoint, "--model.solver=bpnp.models.BPnPNet", option))
        weights = checkpoint.replace("ckpt_path", "model.weights")
        assert message in fails(*words("test", trained, weights, "--model.solver=bpnp.models.BPnPNet", option))
    assert "a checkpoint of BPnPNet, not of Matcher" in fails(
        *words("test", trained, checkpoint, "--model.solver=bpnp.models.Matcher")
    )


def test_a_command_line_of_the_users_own_keeps_its_options(trained: Path, tmp_path: Path) -> None:
    """Lightning's CLI applies what it finds under `hyper_parameters` in a checkpoint after its command line."""
    cli = LightningCLI(
        BlindPnPTask,
        MeshDataModule,
        save_config_callback=None,
        args=[
            "validate", f"--ckpt_path={trained}/run/checkpoints/last.ckpt", "--model.learning_rate=0.25",
            *SMALL_NET, *OTHERS, *MESHES[1:], f"--data.cache_dir={tmp_path}", "--trainer.logger=false",
        ],
    )  # fmt: skip
    assert cli.model.learning_rate == cli.model.hparams.learning_rate == 0.25
    assert cli.model.solver.features2d.scale == 4


def test_a_setting_of_the_evaluation_is_changed_and_printed(trained: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO")
    before = read_results(trained / "own") if (trained / "own").exists() else None
    loss = loss_of_test(trained, "rounds", "--model.solver=bpnp.models.BPnPNet", "--model.solver.rounds=2")
    assert before is None or loss == pytest.approx(before.correspondence_loss, abs=1e-6)
    assert "with rounds=2 (saved: 0)" in caplog.text
    assert read_results(trained / "rounds").settings["solver"]["init_args"]["rounds"] == 2


def test_weights_and_options_of_the_command_come_together(trained: Path, tmp_path: Path) -> None:
    weights = f"--model.weights={trained}/run/checkpoints/last.ckpt"
    main(words("fit", tmp_path, weights, *SHORT, "--model.learning_rate=1e-12"))
    file = tmp_path / "run/checkpoints/last.ckpt"
    before, after = (BlindPnPTask.load_from_checkpoint(each) for each in (trained / "run/checkpoints/last.ckpt", file))
    assert (after.learning_rate, before.learning_rate) == (1e-12, 1e-3)
    for name, value in before.solver.named_parameters():
        torch.testing.assert_close(after.solver.get_parameter(name), value, rtol=0, atol=1e-9)


def test_a_part_of_the_users_is_named_by_the_configuration(tmp_path: Path, fails: Callable[..., str]) -> None:
    part = [
        "--model.solver=bpnp.models.BPnPNet",
        *SMALL_FEATURES[2:],
        "--model.solver.features2d=test_lightning_command.Flat",
    ]
    main(words("fit", tmp_path, *part, "--model.solver.features2d.channels=16", *SHORT))
    checkpoint = f"--ckpt_path={tmp_path}/run/checkpoints/last.ckpt"
    main(words("test", tmp_path, checkpoint, *part))
    message = fails(*words("test", tmp_path, checkpoint))
    assert "last.ckpt has a test_lightning_command.Flat, which is not a class of bpnp. Name it" in message
    # The options of the checkpoint stay where a configuration before has another class, and without the network's name.
    other = tmp_path / "other.yaml"
    other.write_text(
        "model:\n  solver:\n    class_path: bpnp.models.BPnPNet\n    init_args:\n      features2d:\n"
        "        class_path: bpnp.models.nets.ImageFeatures\n        init_args:\n          scale: 4.0\n"
    )
    for options in ([f"--config={other}", part[-1]], part[-1:]):
        main(words("test", tmp_path, checkpoint, *options))
    assert read_results(tmp_path / "run/test").settings["solver"]["init_args"]["features2d"]["init_args"] == {
        "coordinates": 2,
        "channels": 16,
    }
    message = fails(*words("test", tmp_path, checkpoint, part[-1], "--model.solver.features2d.channels=8"))
    assert "features2d.channels=8 (saved: 16)" in message


class Flat(nn.Module):
    """A user's features: a linear map."""

    def __init__(self, coordinates: int = 2, *, channels: int = 4) -> None:
        super().__init__()
        self.coordinates, self.channels = coordinates, channels
        self.map = nn.Linear(coordinates, channels)

    def forward(self, points: torch.Tensor, mask: torch.Tensor) -> torch.Tensor:
        return nn.functional.normalize(self.map(points), dim=-1)


def test_a_training_is_continued_and_never_overwritten(tmp_path: Path, fails: Callable[..., str]) -> None:
    main(words("fit", tmp_path, *SMALL_NET, *SHORT))
    files = {path: path.read_bytes() for path in (tmp_path / "run").rglob("*.*") if path.is_file()}
    message = fails(*words("fit", tmp_path, *SMALL_NET, *SHORT))
    assert "run holds a training. Continue it with --ckpt_path last, or set --trainer.default_root_dir" in message
    assert "holds a training" in fails(*words("fit", tmp_path, "--ckpt_path=procedural-so3", *SHORT))
    main(words("fit", tmp_path, *SMALL_NET, *SHORT, "--trainer.fast_dev_run=true"))
    assert {path: path.read_bytes() for path in files} == files
    main(words("fit", tmp_path, *SHORT[1:], "--ckpt_path=last", "--trainer.max_epochs=2"))
    last = torch.load(tmp_path / "run/checkpoints/last.ckpt", weights_only=True)
    assert last["epoch"] == 1
    kept = {path: content for path, content in files.items() if path.suffix != ".ckpt"}
    assert {path: path.read_bytes() for path in kept} == kept


class Recording(Logger):
    """A logger of a user's whose `save_dir` is the working directory by default, as W&B's."""

    made: list["Recording"] = []

    def __init__(self, save_dir: str = ".") -> None:
        self.folder, self.metrics, self.params = save_dir, set[str](), dict[str, Any]()
        self.made.append(self)

    name = version = "recording"

    @property
    def save_dir(self) -> str:
        return self.folder

    def log_metrics(self, metrics: dict[str, float], step: int | None = None) -> None:
        self.metrics |= metrics.keys()

    def log_hyperparams(self, params: Any, *args: Any, **kwargs: Any) -> None:
        self.params |= dict(params)


def test_everything_of_a_run_is_in_its_folder_and_in_its_logger(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    monkeypatch.chdir(elsewhere)
    Recording.made.clear()
    logger = ["--trainer.logger=test_lightning_command.Recording", "--trainer.log_every_n_steps=1"]
    main(words("fit", tmp_path, *SMALL_NET, *SHORT, *logger, "--model.learning_rate=1e-4"))
    first = {path: path.read_bytes() for path in (tmp_path / "run").rglob("config.yaml")}
    main(words("test", tmp_path, *logger, "--ckpt_path=last"))
    assert not list(elsewhere.iterdir())
    assert {path: path.read_bytes() for path in first} == first
    assert {path.relative_to(tmp_path / "run").as_posix() for path in (tmp_path / "run").rglob("config.yaml")} == {
        "logs/version_0/config.yaml",
        "logs/version_1/config.yaml",
    }
    fit, test = Recording.made
    assert Path(fit.folder) == tmp_path / "run"
    assert fit.params["learning_rate"] == 1e-4
    assert test.params["ckpt_path"] == f"{tmp_path}/run/checkpoints/last.ckpt"
    assert fit.params["data"]["init_args"]["num_points"] == 24
    assert fit.params["solver"]["settings"]["features2d"]["settings"]["channels"] == 16
    json.dumps(fit.params)
    # These names are stored in the W&B and CSV files of users. Each figure is logged once.
    stages = {"val": ("ransac", "pnp"), "test": ("ransac", "pnp", "refined")}
    for stage, recorded in (("val", fit), ("test", test)):
        named = {name for name in recorded.metrics if name.startswith(f"{stage}/")}
        figures = {"translation_q2", "rotation_q2_deg", "rotation_q1_deg", "recall_rotation_20deg"}
        assert {f"{stage}/{estimate}/{figure}" for estimate in stages[stage] for figure in figures} <= named
        assert {name for name in named if name.count("/") == 1} == {
            f"{stage}/correspondence_loss",
            f"{stage}/pose_error",
        }
    names = {"loss", "correspondence_loss", "gradient_norm", "skipped_steps", "sinkhorn_iterations"}
    assert {f"train/{name}" for name in names} <= fit.metrics


def test_the_best_checkpoint_is_of_the_last_objective(tmp_path: Path) -> None:
    """Every epoch is worse than the one before, so that the best is the first one of its objective."""
    callbacks = [
        "--trainer.callbacks=bpnp.training.PoseLossWarmup",
        "--trainer.callbacks.start_epoch=2",
        "--trainer.callbacks.weight=0.5",
        "--trainer.callbacks+=test_lightning_command.Worse",
    ]
    main(words("fit", tmp_path, *SMALL_NET, *SHORT[1:], *callbacks, "--trainer.max_epochs=4"))
    folder = tmp_path / "run" / "checkpoints"
    epochs = {file.stem: torch.load(file, weights_only=True)["epoch"] for file in folder.iterdir()}
    assert epochs == {"best": 2, "last": 3, "before_pose_loss": 2}
    steps = {file.stem: torch.load(file, weights_only=True)["global_step"] for file in folder.iterdir()}
    assert steps == {"best": 6, "last": 8, "before_pose_loss": 4}


class Worse(Callback):
    def on_validation_epoch_end(self, trainer: Trainer, pl_module: Any) -> None:
        pl_module.log("val/pose_error", float(trainer.current_epoch))


def test_a_moved_run_keeps_its_best_checkpoint(tmp_path: Path) -> None:
    """The first epoch is the best one by its number; an epoch has two steps."""
    options = [*SMALL_NET, *SHORT, "--best_checkpoint.monitor=epoch"]
    main(words("fit", tmp_path, *options))
    moved = (tmp_path / "run").rename(tmp_path / "moved")
    more = ["--ckpt_path=last", "--trainer.max_epochs=2", f"--trainer.default_root_dir={moved}"]
    main(words("fit", tmp_path, *options, *more))
    files = (moved / "checkpoints").iterdir()
    steps = {file.stem: torch.load(file, weights_only=True)["global_step"] for file in files}
    assert steps == {"best": 2, "last": 4}


def test_best_checkpoints_of_one_name_are_refused(tmp_path: Path, fails: Callable[..., str]) -> None:
    several = words("fit", tmp_path, *SMALL_NET, *SHORT, "--best_checkpoint.save_top_k=2")
    assert "each checkpoint would be best.ckpt. Give a name with the epoch" in fails(*several)
    main([*several, "--best_checkpoint.filename=best-{epoch}"])
    assert (tmp_path / "run/checkpoints/best-epoch=0.ckpt").is_file()


def test_an_unknown_metric_of_a_callback_is_one_clear_error(tmp_path: Path, fails: Callable[..., str]) -> None:
    stop = ["--trainer.callbacks=EarlyStopping", "--trainer.callbacks.monitor=val/nothing"]
    assert "metric `val/nothing` which is not available" in fails(*words("fit", tmp_path, *SMALL_NET, *SHORT, *stop))


def test_the_pose_error_is_the_pose_loss_of_the_medians(trained: Path) -> None:
    (file,) = (trained / "run").glob("logs/version_0/metrics.csv")
    rows = [row for row in csv.DictReader(file.open()) if row["val/pose_error"]]
    expected = np.radians(float(rows[-1]["val/pnp/rotation_q2_deg"])) + float(rows[-1]["val/pnp/translation_q2"])
    assert float(rows[-1]["val/pose_error"]) == pytest.approx(expected, rel=1e-5)


FAR = np.array([639_208.0, 4_812_345.0, 310.0])


class FarScenes(LightningDataModule):
    """A user's scenes in geographic coordinates, given in another order than they are numbered."""

    def predict_dataloader(self) -> DataLoader[Batch]:
        problems = []
        for number in range(4):
            scene = plant(1, 12, seed=number, dtype=torch.float64)
            pose = scene.rotation[0].numpy(), scene.translation[0].numpy()
            matches = np.arange(12)
            problems.append(
                Problem.from_matches(
                    f"photo{number}", scene.points2d[0].numpy(), scene.points3d[0].numpy(), *pose, matches, 1.0, FAR
                )
            )
        order = [[2, 0], [3, 1]]
        return DataLoader(
            [stack_problems([problems[i] for i in part], torch.tensor(part)) for part in order], batch_size=None
        )


def truth() -> list[tuple[np.ndarray, np.ndarray]]:
    """World-to-camera poses in the scenes' own coordinates, which lie around `FAR`."""
    scenes = [plant(1, 12, seed=number, dtype=torch.float64) for number in range(4)]
    return [(r := scene.rotation[0].numpy(), scene.translation[0].numpy() - r @ FAR) for scene in scenes]


class Truth(nn.Module):
    """A solver that returns the pose of the batch in float32, as networks do."""

    estimates = ("pnp",)

    def forward(self, batch: Batch) -> Any:
        return Prediction(poses={"pnp": posed(batch.rotation.float(), batch.translation.float())})


@pytest.mark.parametrize("format", ["csv", "json"])
def test_predictions_are_in_the_frame_of_the_user_and_named(
    format: str, tmp_path: Path, fails: Callable[..., str]
) -> None:
    line = ["predict", "--data=test_lightning_command.FarScenes", "--model.solver=test_lightning_command.Truth"]
    line += [f"--trainer.default_root_dir={tmp_path}", f"--predictions.format={format}"]
    main(line)
    text = (tmp_path / f"predictions.{format}").read_text()
    if format == "csv":
        rows = list(csv.DictReader(text.splitlines()))
        translations = [[float(row[f"t{axis}"]) for axis in "xyz"] for row in rows]
        quaternions = torch.tensor([[float(row[f"q{axis}"]) for axis in "xyzw"] for row in rows], dtype=torch.float64)
        rotations = quaternion_rotation(quaternions).numpy()
    else:
        rows = json.loads(text)
        translations, rotations = ([row[key] for row in rows] for key in ("translation", "rotation"))
    assert [row["id"] for row in rows] == [f"photo{number}" for number in range(4)]
    for (rotation, translation), found, moved in zip(truth(), rotations, translations, strict=True):
        np.testing.assert_allclose(found, rotation, atol=1e-6)
        # The camera's place, for the translation turns with the rounding of the rotation.
        centre = -np.asarray(found).T @ np.asarray(moved)
        np.testing.assert_allclose(centre, -rotation.T @ translation, atol=1e-5)
    assert "exists. Use --predictions.folder" in fails(*line)
    main([*line, "--predictions.overwrite=true"])


def test_a_trainer_returns_predictions_with_names(tmp_path: Path) -> None:
    found = quiet_trainer(tmp_path).predict(BlindPnPTask(Truth()), FarScenes())
    assert [name for part in found for name in part.ids] == ["photo2", "photo0", "photo3", "photo1"]
    rotation, translation = truth()[2]
    centre = -found[0].poses["pnp"].rotation[0].T @ found[0].poses["pnp"].translation[0]
    np.testing.assert_allclose(centre, -rotation.T @ translation, atol=1e-5)


class Broken(Callback):
    """A callback with a bug of the user's."""

    def on_train_start(self, trainer: Trainer, pl_module: Any) -> None:
        _first, _second = (1, 2, 3)  # type: ignore[misc]


class Warned(Callback):
    def on_train_start(self, trainer: Trainer, pl_module: Any) -> None:
        warnings.warn("a warning of the user's", stacklevel=1)


def test_a_users_own_error_keeps_its_traceback(tmp_path: Path) -> None:
    broken = "--trainer.callbacks=test_lightning_command.Broken"
    with pytest.raises(ValueError, match="too many values to unpack") as error:
        main(words("fit", tmp_path, *SMALL_NET, *SHORT, broken))
    assert error.traceback[-1].name == "on_train_start"


def test_warnings_reach_the_user(tmp_path: Path) -> None:
    with pytest.warns(UserWarning, match="a warning of the user's"):
        main(words("fit", tmp_path, *SMALL_NET, *SHORT, "--trainer.callbacks=test_lightning_command.Warned"))


def test_a_training_in_a_pipe_prints_a_line_an_epoch(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    main(words("fit", tmp_path, *SMALL_NET, *SHORT[1:], "--trainer.max_epochs=2"))
    lines = [line for line in capsys.readouterr().out.splitlines() if line.startswith("epoch")]
    (file,) = (tmp_path / "run").rglob("metrics.csv")
    values = [
        float(row["val/pnp/rotation_q2_deg"]) for row in csv.DictReader(file.open()) if row["val/pnp/rotation_q2_deg"]
    ]
    assert [re.sub(r", val/pnp/translation.*", "", line.split(" val/pnp/rotation_q2_deg ")[1]) for line in lines] == [
        f"{value:.4g}" for value in values
    ]
    assert [line.split(":")[0] for line in lines] == ["epoch 1/2, step 2", "epoch 2/2, step 4"]


def test_option_names_stored_in_recipes_and_runs_are_kept() -> None:
    """The YAML files of users have these names."""
    assert set(inspect.signature(BlindPnPTask.__init__).parameters) == {
        "self", "solver", "weights", "learning_rate", "weight_decay", "warmup_steps", "decay_start", "decay_steps",
        "pose_weight", "pose_loss", "matching_loss", "correspondence_angle", "loss", "refine_validation",
    }  # fmt: skip
    assert set(inspect.signature(BPnPNet.__init__).parameters) == {
        "self", "features2d", "features3d", "transport", "ransac", "pnp", "refinement", "rounds", "headings",
        "vertical",
    }  # fmt: skip


def test_the_configuration_of_a_continued_run_has_its_network(trained: Path) -> None:
    loss_of_test(trained, "again")
    configs = sorted((trained / "run/logs").glob("version_*/config.yaml"), key=lambda path: path.stat().st_mtime_ns)
    solver = yaml.safe_load(configs[-1].read_text())["model"]["solver"]
    assert solver["init_args"]["features2d"]["init_args"]["scale"] == 4.0
