"""The benchmark for a GPU that is at hand for minutes: what it keeps, and that a second run goes on."""

import json
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import clock
import gpu
import numpy as np
import pytest
import torch
from planted_model import plant_model
from small_data import quiet_trainer, small_meshes, small_net

from bpnp import BPnPNet
from bpnp.cli import main
from bpnp.datamodules import ColmapDataModule
from bpnp.training import BlindPnPTask

SMALL = ["--data.train_shapes=4", "--data.train_problems=4", "--data.batch_size=2", "--data.val_shapes=2"]


def test_the_clock_ends_a_training_and_saves_it(tmp_path: Path) -> None:
    ends = clock.Clock(0.0, str(tmp_path / "clock.json"))
    trainer = quiet_trainer(tmp_path, max_epochs=-1, callbacks=[ends])
    trainer.fit(BlindPnPTask(small_net()), datamodule=small_meshes(tmp_path))
    assert trainer.global_step == clock.WARM_UP + 1
    found = json.loads((tmp_path / "clock.json").read_text())
    assert found["steps"] == trainer.global_step
    assert 0 < found["seconds"] < 60
    content = torch.load(tmp_path / "checkpoints" / "last.ckpt", weights_only=True)
    assert content["global_step"] == trainer.global_step


def test_a_compact_checkpoint_has_16_mb_and_is_resumed(tmp_path: Path) -> None:
    data, last = small_meshes(tmp_path), tmp_path / "checkpoints" / "last.ckpt"
    trainer = quiet_trainer(tmp_path, max_steps=2)
    trainer.fit(BlindPnPTask(BPnPNet()), datamodule=data)
    trainer.save_checkpoint(last)
    (tmp_path / "checkpoints" / "best.ckpt").write_bytes(b"another")
    (tmp_path / "logs").mkdir()
    before, exact = last.stat().st_size, torch.load(last, weights_only=True)
    gpu.compact(tmp_path)
    assert [path.name for path in (tmp_path / "checkpoints").iterdir()] == ["last.ckpt"]
    assert not (tmp_path / "logs").exists()
    assert last.stat().st_size < 16.5e6 < 24e6 < before
    again, task = quiet_trainer(tmp_path, max_steps=2), BlindPnPTask(BPnPNet())
    again.fit(task, datamodule=data, ckpt_path=last)
    for name, value in exact["state_dict"].items():
        assert torch.equal(task.state_dict()[name], value)
    saved = exact["optimizer_states"][0]["state"]
    for k, moments in enumerate(again.optimizers[0].state.values()):
        assert moments["exp_avg_sq"].dtype == torch.float32
        torch.testing.assert_close(moments["exp_avg_sq"], saved[k]["exp_avg_sq"], rtol=2**-8, atol=1e-30)


def test_the_packed_photos_are_those_of_the_model_and_the_clouds_have_three_digits(tmp_path: Path) -> None:
    plant_model(tmp_path / "colmap" / "scene" / "sparse" / "0", seed=0, images=5)
    points = np.random.default_rng(0).normal(size=(40, 3)) * 100 + 500
    file = tmp_path / "modelnet10" / "chair" / "train" / "chair_1.ply"
    file.parent.mkdir(parents=True)
    head = "ply\nformat ascii 1.0\nelement vertex 40\n" + "".join(f"property float {axis}\n" for axis in "xyz")
    file.write_text(head + "end_header\n" + "".join(f"{x} {y} {z}\n" for x, y, z in points))
    gpu.pack(tmp_path, tmp_path / "packed")
    packed = np.load(tmp_path / "packed" / "modelnet10" / "chair" / "train" / "chair_1.npy")
    assert packed.dtype == np.float16
    around = points - points.mean(0)
    np.testing.assert_allclose(packed, around / np.abs(around).max(), atol=1e-3)
    photos = ColmapDataModule(str(tmp_path / "packed" / "photos"), test_fraction=1.0, val_fraction=0.0)
    assert len(list(gpu.test_problems(photos))) == 5


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.filterwarnings(
    "ignore:The training has ended before", "ignore:`ModelCheckpoint", "ignore:It is recommended"
)
def test_a_second_run_goes_on_where_the_first_was_stopped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Each stage that was recorded is done once; the trainings go on from their checkpoints."""
    monkeypatch.setenv("BPNP_CACHE", str(tmp_path / "cache"))
    commands: list[list[str]] = []
    fit = gpu.fit

    def train(command: list[str], **_: Any) -> SimpleNamespace:
        commands.append(command)
        maps = "synthetic" in " ".join(command).lower()
        shrunk = ["--data.train_problems=8", "--data.batch_size=2"] if maps else SMALL
        main([*command[3:], *shrunk, "--data.num_points=16"])
        return SimpleNamespace(stdout="", stderr="")

    monkeypatch.setattr(gpu, "subprocess", SimpleNamespace(run=train))
    monkeypatch.setattr(gpu, "run_tests", lambda _: "all passed")
    monkeypatch.setattr(gpu, "POINTS", 16)
    monkeypatch.setattr(gpu, "SMALL", gpu.SMALL | {"num_points": 16, "pool_size": 32, "test_shapes": 3})
    monkeypatch.setattr(gpu, "TIMED", 0.0)
    monkeypatch.setattr(gpu, "TESTED", 0.0)
    monkeypatch.setattr(gpu, "FEWEST_SECONDS", 0.0)
    run = gpu.Run(tmp_path / "run", time.monotonic() + 600, 10.0)
    run.folder.mkdir()
    run.record("tests", gpu.device(), "all passed")
    gpu.time_steps(run)
    assert len(commands) == 2
    assert len(run.state()["seconds"]) == 3
    monkeypatch.setattr(gpu, "fit", lambda *given, **named: fit(given[0], given[1], 0.0, **named))
    gpu.train(run)
    first = run.state()["trainings"]
    assert {name: found["all_steps"] for name, found in first.items()} == {"table1": 2, "table2": 2}
    assert [path.name for path in (run.folder / "table1").iterdir()] == ["checkpoints"]
    monkeypatch.setattr("sys.argv", ["gpu", "--run", str(run.folder), "--minutes", "5"])
    monkeypatch.setattr(gpu, "run_tests", lambda _: pytest.fail("tested again"))
    gpu.main()
    assert len(commands) == 6
    state = json.loads((run.folder / "state.json").read_text())
    assert [state["trainings"][name]["all_steps"] for name in ("table1", "table2")] == [4, 4]
    assert state["trainings"]["table1"]["ransac"]["problems"] == 1
    assert state["runs"][0]["minutes"] == 5
    assert '"minutes": 5.0' in capsys.readouterr().out
