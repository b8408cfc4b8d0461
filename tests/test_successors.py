"""The benchmark of later losses and networks trains each from the same start, and a run that was stopped goes on."""

import json
from pathlib import Path
from types import SimpleNamespace

import pages
import paper_tables
import pytest
import successors
import torch

from bpnp.cli import main
from bpnp.datamodules import MeshDataModule
from bpnp.models import TrainedNet
from bpnp.training import BlindPnPTask


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.filterwarnings(
    "ignore:The pose loss joins at epoch", "ignore:`ModelCheckpoint", "ignore:It is recommended"
)
def test_each_loss_starts_from_the_same_weights_and_is_compared(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("BPNP_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(successors, "EPOCH", 1)
    small = {"num_points": 16, "val_shapes": 2, "test_shapes": 3}
    monkeypatch.setattr(successors, "MeshDataModule", lambda *_, **__: MeshDataModule(None, **small))
    page = tmp_path / "page.md"
    tables = "".join(f"<!-- successors: {name} -->\n<!-- end of successors -->\n" for name in ("losses", "networks"))
    page.write_text(f"{tables}[rows](successors.csv), [effects](successors-effects.csv)\n")
    monkeypatch.setattr(pages, "PAGES", (page,))
    monkeypatch.setattr(successors, "FILE", tmp_path / "record.json")
    shrunk = ["--data.train_shapes=4", "--data.train_problems=4", "--data.batch_size=2", "--data.num_points=16"]
    commands: list[list[str]] = []

    def run(command: list[str], check: bool) -> None:
        commands.append(command)
        main([*command[3:], *shrunk, "--data.val_shapes=2"])

    monkeypatch.setattr(paper_tables, "subprocess", SimpleNamespace(run=run))
    options = ["--run", str(tmp_path / "run"), "--output", str(tmp_path / "record.json"), "--problems", "2"]
    monkeypatch.setattr("sys.argv", ["successors", *options, "--steps", "1", "--network_steps", "1"])
    successors.main()
    assert len(commands) == len(successors.LOSSES) + len(successors.NETWORKS)
    rows, effects = (json.loads((tmp_path / "record.json").read_text())[part] for part in ("rows", "effects"))
    assert {key: row["steps"] for key, row in rows.items() if key.startswith("0|start")} == {
        "0|start|pnp": 0, "0|start|ransac": 0,
    }  # fmt: skip
    assert {key.split("|")[1] for key in effects} == {
        name for name, one in (successors.LOSSES | successors.NETWORKS).items() if one.compared
    }
    assert "| Lc + EPro-PnP | 1 |" in page.read_text()
    folder = tmp_path / "run" / "seed0"
    kinds = {
        name: type(
            BlindPnPTask.load_from_checkpoint(
                folder / successors.file_name(name) / "checkpoints" / "last.ckpt"
            ).pose_loss
        )
        for name in successors.LOSSES
    }
    assert [kind.__name__ for kind in kinds.values()] == [
        *["PoseLoss"] * 4, "MonteCarloPoseLoss", "ChamferLoss",
    ]  # fmt: skip
    start = TrainedNet.from_pretrained(successors.START).state_dict()
    for name in successors.LOSSES:  # one step of Adam moves no weight by more than its rate
        state = TrainedNet.from_checkpoint(
            folder / successors.file_name(name) / "checkpoints" / "last.ckpt"
        ).state_dict()
        moved = [(state[key] - start[key]).abs().max() for key in state if key.endswith(("weight", "bias"))]
        assert 0 < float(torch.stack(moved).max()) <= 1.01e-4
    monkeypatch.setattr(paper_tables, "subprocess", SimpleNamespace(run=lambda *_, **__: pytest.fail("trained again")))
    successors.main()
    assert json.loads((tmp_path / "record.json").read_text())["rows"] == rows
