"""Ctrl-C, and checkpoints that are not there: no work is lost in silence."""

import errno
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from lightning.pytorch import Callback
from small_data import MESHES, SMALL_NET

from bpnp.cli import main
from bpnp.report import read_results
from bpnp.report.points import read_points
from bpnp.training.checkpoints import SafeCheckpointIO

pytestmark = pytest.mark.nightly


class Stop(Callback):
    """Ctrl-C after the second batch."""

    def on_train_batch_end(self, trainer: Any, module: Any, outputs: Any, batch: Any, batch_idx: int, *_: int) -> None:
        if batch_idx == 1:
            raise KeyboardInterrupt

    on_test_batch_end = on_train_batch_end


class StopWithin(Callback):
    """Ctrl-C within the second batch, before its step."""

    batches = 0

    def on_before_optimizer_step(self, *_: Any) -> None:
        self.batches += 1
        if self.batches == 2:
            raise KeyboardInterrupt


def arguments(command: str, folder: Path) -> list[str]:
    return [command, *MESHES, *SMALL_NET, f"--data.cache_dir={folder}", f"--trainer.default_root_dir={folder}/run"]


def interrupted(words: list[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main([*words, "--trainer.callbacks=test_interruptions.Stop"])
    assert stop.value.code == 130


def test_an_interrupted_training_keeps_its_checkpoint(tmp_path: Path) -> None:
    interrupted(arguments("fit", tmp_path))
    kept = tmp_path / "run" / "checkpoints" / "interrupted.ckpt"
    assert kept.is_file()
    main([*arguments("fit", tmp_path), f"--ckpt_path={kept}", "--trainer.max_epochs=1"])
    assert {file.name for file in kept.parent.iterdir()} == {"best.ckpt", "last.ckpt"}  # it is not needed any more


def test_the_batch_within_which_a_training_was_stopped_is_repeated(tmp_path: Path) -> None:
    weights = {}
    for name in ("whole", "stopped"):
        words = [*arguments("fit", tmp_path / name), "--trainer.max_epochs=1"]
        if name == "stopped":
            with pytest.raises(SystemExit):
                main([*words, "--trainer.callbacks=test_interruptions.StopWithin"])
            words.append("--ckpt_path=last")
        main(words)
        weights[name] = torch.load(tmp_path / name / "run" / "checkpoints" / "last.ckpt", weights_only=True)
    assert weights["stopped"]["global_step"] == weights["whole"]["global_step"]
    torch.testing.assert_close(weights["stopped"]["state_dict"], weights["whole"]["state_dict"], rtol=0, atol=0)
    loops = [each["loops"]["fit_loop"] for each in weights.values()]
    for key in ("epoch_loop.batch_progress", "epoch_loop.state_dict"):
        assert loops[0][key] == loops[1][key]


class Broken(Callback):
    """A bug in the second batch."""

    def on_train_batch_end(self, trainer: Any, module: Any, outputs: Any, batch: Any, batch_idx: int, *_: int) -> None:
        if batch_idx == 1:
            raise RuntimeError("a bug of the user's")


def test_a_training_that_an_error_stops_is_continued(tmp_path: Path) -> None:
    with pytest.raises(RuntimeError, match="a bug of the user's"):
        main([*arguments("fit", tmp_path), "--trainer.callbacks=test_interruptions.Broken"])
    folder = tmp_path / "run" / "checkpoints"
    assert torch.load(folder / "interrupted.ckpt", weights_only=True)["global_step"] == 2
    main([*arguments("fit", tmp_path), "--ckpt_path=last", "--trainer.max_epochs=1"])
    assert torch.load(folder / "last.ckpt", weights_only=True)["global_step"] == 6


def test_an_interrupted_test_keeps_its_finished_pairs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    interrupted([*arguments("test", tmp_path), "--data.eval_batch_size=2"])
    results = read_results(tmp_path / "run" / "test")
    assert results.problems == 2  # of the first batch; the second ended in the interruption
    assert results.settings["complete"] is False
    assert len(read_points(tmp_path / "run" / "test")) == 2
    assert "weights of the solver are untrained" in capsys.readouterr().err


def test_a_full_disk_leaves_the_checkpoint_before_and_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, disk = tmp_path / "last.ckpt", SafeCheckpointIO()
    disk.save_checkpoint({"state_dict": {"step": torch.tensor(1)}}, path)

    def full(self: Path, content: bytes) -> None:
        self.open("wb").write(content[:100])
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(OSError, match="No space left on device: .*last.ckpt"):
        disk.save_checkpoint({"state_dict": {"step": torch.tensor(2)}}, path)
    assert disk.load_checkpoint(path)["state_dict"]["step"] == 1
    assert list(tmp_path.iterdir()) == [path]


def test_a_last_checkpoint_that_is_not_there_is_no_new_training(tmp_path: Path, fails: Callable[..., str]) -> None:
    assert "has no last checkpoint. A new training has no --ckpt_path" in fails(
        *arguments("fit", tmp_path), "--ckpt_path=last"
    )
