"""The network of a checkpoint is the one that the checkpoint describes, whichever way it is loaded."""

import json
import math
from pathlib import Path
from typing import Any

import pytest
import torch
from planted import padded, plant
from small_data import quiet_trainer, small_meshes, small_net
from torch import Tensor, nn

from bpnp import Batch, BPnPNet, Matcher
from bpnp.layers import RansacPnP, Sinkhorn
from bpnp.models import TrainedNet
from bpnp.models.nets import ImageFeatures, SceneFeatures
from bpnp.models.weights import checkpoint_path, pretrained_names, read_checkpoint
from bpnp.training import BlindPnPTask, PoseLossWarmup

pytestmark = pytest.mark.slow


def asked() -> Batch:
    generator = torch.Generator().manual_seed(5)
    return Batch.from_arrays(torch.rand(9, 2, generator=generator), torch.rand(12, 3, generator=generator))


def assignment(solver: nn.Module) -> Tensor:
    with torch.no_grad():
        return solver.eval().match(asked()).assignment  # type: ignore[operator]


def save(task: BlindPnPTask, path: Path) -> Path:
    trainer = quiet_trainer(path.parent, max_epochs=0)
    trainer.strategy.connect(task)
    trainer.save_checkpoint(path)
    return path


class Flat(nn.Module):
    """A user's features: a linear map."""

    def __init__(self, coordinates: int, *, channels: int = 4) -> None:
        super().__init__()
        self.coordinates, self.channels = coordinates, channels
        self.map = nn.Linear(coordinates, channels)

    def forward(self, points: Tensor, mask: Tensor) -> Tensor:
        return nn.functional.normalize(self.map(points), dim=-1)


class Scaled(BPnPNet):
    """A user's network, derived from one of this package."""

    def __init__(self, factor: float = 1.0) -> None:
        super().__init__(ImageFeatures(channels=8, depth=1), SceneFeatures(channels=8, depth=1))
        self.factor = factor

    def cost(self, batch: Batch) -> Tensor:
        return self.factor * super().cost(batch)


class Squares(nn.Module):
    """A user's loss with an option."""

    def __init__(self, power: float) -> None:
        super().__init__()
        self.power = power


@pytest.mark.parametrize("name", pretrained_names())
def test_every_way_of_loading_gives_the_same_assignment(name: str, tmp_path: Path) -> None:
    task = BlindPnPTask.load_from_checkpoint(name)
    tested = BlindPnPTask.load_from_checkpoint(name)
    for parameter in tested.parameters():
        nn.init.zeros_(parameter)
    run = quiet_trainer(tmp_path, limit_test_batches=1)
    file = str(checkpoint_path(name))
    run.test(tested, datamodule=small_meshes(tmp_path), ckpt_path=file, verbose=False, weights_only=True)
    expected = assignment(TrainedNet.from_pretrained(name))
    for solver in (
        task.solver,
        tested.solver,
        TrainedNet.from_checkpoint(name),
        BlindPnPTask(weights=name).solver,
        BlindPnPTask(TrainedNet.from_checkpoint(name), weights=name).solver,
    ):
        torch.testing.assert_close(assignment(solver), expected, rtol=0, atol=1e-6)


def test_the_task_of_a_checkpoint_has_its_solver_and_its_options(tmp_path: Path) -> None:
    """The widths are those of the default network of this size; everything else is not."""
    net = small_net(centre=True, scale=4.0, normalise=True, threshold=0.004, rounds=2, transport=Sinkhorn(mu=0.2))
    task = BlindPnPTask(net, learning_rate=3e-4, warmup_steps=7, loss=Squares(3.0))
    file = save(task, tmp_path / "task.ckpt")
    assert "hyper_parameters" not in torch.load(file, weights_only=True)
    again = BlindPnPTask.load_from_checkpoint(file, parts=[Squares], warmup_steps=5)
    torch.testing.assert_close(assignment(again.solver), assignment(net), rtol=0, atol=1e-6)
    assert (again.solver.features2d.scale, again.solver.rounds, again.solver.ransac.threshold) == (4.0, 2, 0.004)
    assert (again.hparams.learning_rate, again.learning_rate, again.warmup_steps) == (3e-4, 3e-4, 5)
    assert again.loss.power == 3.0
    with pytest.raises(ValueError, match=r"task.ckpt: .*Squares"):
        BlindPnPTask.load_from_checkpoint(file)


class Named(BlindPnPTask):
    """A user's task with one more option."""

    def __init__(self, *arguments: Any, label: str = "", **options: Any) -> None:
        super().__init__(*arguments, **options)
        self.label = label
        self.save_hyperparameters("label")


class NamedTwice(Named):
    """A task two classes below ours."""

    def __init__(self, *, second: str = "", **options: Any) -> None:
        super().__init__(**options)
        self.second = second


def test_the_options_that_a_users_task_passes_on_come_back(tmp_path: Path) -> None:
    options: dict[str, Any] = {"learning_rate": 3e-4, "pose_weight": 0.5, "matching_loss": "likelihood"}
    for kind in (Named, NamedTwice):
        file = save(kind(solver=small_net(), label="mine", **options), tmp_path / "task.ckpt")
        again = kind.load_from_checkpoint(file)
        assert {name: getattr(again, name) for name in options} == options
        assert again.label == "mine"


def test_hyperparameters_are_plain_data(tmp_path: Path) -> None:
    net = BPnPNet(Flat(2), Flat(3), ransac=RansacPnP(threshold=0.02))
    hparams = dict(BlindPnPTask(net, learning_rate=2e-4).hparams)
    assert json.loads(json.dumps(hparams)) == hparams
    assert hparams["learning_rate"] == 2e-4
    assert hparams["solver"]["settings"]["ransac"]["settings"]["threshold"] == 0.02


def test_parts_and_networks_of_a_user_come_back(tmp_path: Path) -> None:
    for net, parts in ((BPnPNet(Flat(2), Flat(3)), [Flat]), (Scaled(2.0), [])):
        file = save(BlindPnPTask(net), tmp_path / "own.ckpt")
        task = BlindPnPTask.load_from_checkpoint(file, parts=parts)
        assert type(task.solver) is type(net)
        assert type(TrainedNet.from_checkpoint(file, parts=parts)) is type(net)
        torch.testing.assert_close(assignment(task.solver), assignment(net), rtol=0, atol=0)
    save(BlindPnPTask(BPnPNet(Flat(2), Flat(3))), file)
    with pytest.raises(ValueError, match=r"own.ckpt: .*test_checkpoint_networks.Flat"):
        BlindPnPTask.load_from_checkpoint(file)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"centre": False}, r"features2d.centre=False \(saved: True\), features3d.centre=False \(saved: True\)"),
        ({"scale": 1.0}, r"features2d.scale=1.0 \(saved: 4.0\)"),
        ({"channels": 8}, r"features2d.channels=8 \(saved: 16\)"),
        ({"transport": Sinkhorn(mu=0.3)}, r"transport.mu=0.3 \(saved: 0.1\)"),
    ],
)
def test_a_network_that_contradicts_its_checkpoint_is_refused(changed: Any, message: str, tmp_path: Path) -> None:
    own: dict[str, Any] = {"centre": True, "scale": 4.0}
    file = str(save(BlindPnPTask(small_net(**own)), tmp_path / "own.ckpt"))
    other, run = small_net(**own | changed), quiet_trainer(tmp_path)
    with pytest.raises(ValueError, match=message):
        BlindPnPTask(other, weights=file)
    with pytest.raises(ValueError, match=f"own.ckpt: .*{message}"):
        BlindPnPTask.load_from_checkpoint(file, solver=other)
    with pytest.raises(ValueError, match=message):
        run.test(BlindPnPTask(other), datamodule=small_meshes(tmp_path), ckpt_path=file)


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_weights_that_are_not_finite_are_refused(value: float, tmp_path: Path) -> None:
    """With them every pose is NaN, after the whole test."""
    task = BlindPnPTask(small_net())
    name, weight = next(iter(task.solver.named_parameters()))
    weight.data.view(-1)[0] = value
    file, run = str(save(task, tmp_path / "own.ckpt")), quiet_trainer(tmp_path)
    message = f"own.ckpt: {name} of the checkpoint holds NaN or infinity; use an earlier checkpoint$"
    with pytest.raises(ValueError, match=message):
        BPnPNet.from_checkpoint(file)
    with pytest.raises(ValueError, match=message):
        BlindPnPTask(weights=file)
    with pytest.raises(ValueError, match=message):
        BlindPnPTask.load_from_checkpoint(file)
    with pytest.raises(ValueError, match=message):
        run.test(BlindPnPTask(small_net()), datamodule=small_meshes(tmp_path), ckpt_path=file)


def test_settings_that_an_evaluation_may_change_are_printed(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    file, caplog.handler.level = save(BlindPnPTask(small_net(rounds=2)), tmp_path / "own.ckpt"), 0
    with caplog.at_level("INFO", logger="lightning.pytorch.utilities.rank_zero"):
        task = BlindPnPTask.load_from_checkpoint(file, solver=small_net(rounds=0, threshold=0.02))
    assert task.solver.rounds == 0
    assert "ransac.threshold=0.02 (saved: 0.01), rounds=0 (saved: 2)" in caplog.text


def test_the_names_in_a_checkpoint_are_kept(tmp_path: Path) -> None:
    """Renaming any of these makes files of users unreadable."""
    trainer = quiet_trainer(tmp_path, max_epochs=1, limit_train_batches=1, limit_val_batches=0)
    trainer.callbacks.append(PoseLossWarmup(start_epoch=0))
    trainer.fit(BlindPnPTask(BPnPNet(rounds=1)), datamodule=small_meshes(tmp_path))
    trainer.save_checkpoint(tmp_path / "run.ckpt")
    content = torch.load(tmp_path / "run.ckpt", weights_only=True)
    assert {"state_dict", "solver", "task", "skipped_steps"} <= content.keys()
    assert "PoseLossWarmup" in content["callbacks"]
    assert content["task"].keys() == {
        "learning_rate", "weight_decay", "warmup_steps", "decay_start", "decay_steps", "pose_weight", "pose_loss",
        "matching_loss", "correspondence_angle", "loss", "refine_validation",
    }  # fmt: skip
    solver = content["solver"]
    assert solver["class"] == "BPnPNet"
    assert {name for name, part in solver["settings"].items() if not isinstance(part, dict)} == {
        "rounds", "headings", "vertical",
    }  # fmt: skip
    kept = {
        name: (part["class"], set(part["settings"]))
        for name, part in solver["settings"].items()
        if isinstance(part, dict)
    }
    features = {"channels", "depth", "centre"}
    assert kept == {
        "features2d": ("ImageFeatures", features | {"scale"}),
        "features3d": ("SceneFeatures", features | {"normalise"}),
        "transport": ("Sinkhorn", {"mu", "learn_mu", "dustbin", "tolerance", "max_iterations"}),
        "ransac": (
            "RansacPnP",
            {"backend", "matches_factor", "min_matches", "max_matches", "threshold", "max_iterations", "seed"},
        ),
        "pnp": ("WeightedPnP", {"tolerance", "max_iterations", "solver", "clip_columns"}),
        "refinement": ("Refinement", {"hypotheses", "enabled"}),
    }
    assert read_checkpoint(tmp_path / "run.ckpt")["solver"] == solver
    names = {re_numbered(key) for key in content["state_dict"]}
    assert {key for key in names if not key.startswith("solver.features")} == set()
    assert {key for key in names if "align" not in key} == {
        f"solver.features{side}d.{name}.{kind}"
        for side in (2, 3)
        for name in ("enter", *(f"blocks.N.linear_{letter}" for letter in "abc"))
        for kind in ("weight", "bias")
    }


def re_numbered(key: str) -> str:
    return ".".join("N" if part.isdigit() else part for part in key.split("."))


def test_a_checkpoint_of_another_network_is_named(tmp_path: Path) -> None:
    batch = padded([plant(1, 10, seed=10, dtype=torch.float32)])
    file = save(BlindPnPTask(Matcher(channels=16, depth=1, heads=2)), tmp_path / "matcher.ckpt")
    with pytest.raises(ValueError, match="a checkpoint of Matcher, not of BPnPNet"):
        BlindPnPTask(small_net(), weights=str(file))
    assert BlindPnPTask.load_from_checkpoint(file)(batch).poses
