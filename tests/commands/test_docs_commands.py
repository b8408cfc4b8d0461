"""The four commands of each data set in docs/data.md, as written, on small trees of the same layout."""

import re
import shlex
from pathlib import Path

import pytest
import torch
import yaml
from authors_network import Released, checkpoint
from authors_pickles import sample, write
from planted_model import plant_model
from small_data import SMALL_FEATURES, write_mesh_tree

from bpnp.cli import main

pytestmark = pytest.mark.nightly

ROOT = Path(__file__).parents[2]
SHORT = {"trainer": {"max_epochs": 1, "limit_train_batches": 1, "limit_val_batches": 1, "limit_test_batches": 1}}


def commands(heading: str) -> list[list[str]]:
    text = (ROOT / "docs" / "data.md").read_text(encoding="utf-8")
    section = text.split(f"\n## {heading}\n")[1].split("\n## ")[0]
    block = re.search(r"```\n(.*?)```", section, re.DOTALL)
    assert block is not None
    return [shlex.split(line)[1:] for line in block[1].splitlines() if line.startswith("bpnp ")]


def modelnet40(folder: Path) -> None:
    write_mesh_tree(folder / "ModelNet40", train=4)


def megadepth(folder: Path) -> None:
    for i in range(5):
        plant_model(folder / "MegaDepth_v1_SfM" / f"{i:04d}" / "sparse" / "manhattan" / "0", seed=i)


def authors(folder: Path) -> None:
    write(folder / "FOLDER", [sample(i) for i in range(8)])
    torch.save(checkpoint(Released()), folder / "ModelNet40_LcLp.pth.tar")
    modelnet40(folder)
    main(["prepare", "modelnet40", "ModelNet40", "--output", "data/modelnet40", "--processes", "1"])


@pytest.mark.filterwarnings("ignore:The pose loss joins at epoch")  # the run is cut before
@pytest.mark.parametrize(
    ("heading", "plant"),
    [("ModelNet10 and ModelNet40", modelnet40), ("MegaDepth", megadepth), ("The authors' files", authors)],
)
def test_the_commands_run_as_written(
    heading: str, plant: object, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Only the length of the run and the width of the net are cut; released weights keep theirs."""
    monkeypatch.setenv("WANDB_MODE", "disabled")
    monkeypatch.chdir(tmp_path)
    plant(tmp_path)  # type: ignore[operator]
    (tmp_path / "short.yaml").write_text(yaml.safe_dump(SHORT))
    found = commands(heading)
    assert [words[0] for words in found] in (["prepare", "fit", "test"], ["prepare", "fit", "convert-weights", "test"])
    for words in found:
        released = "released.ckpt" in words
        if words[0] == "prepare":
            words += [] if words[1] == "authors" else ["--processes", "1"]
        elif words[0] != "convert-weights":
            words += ["--config", "short.yaml", "--data.num_workers", "0", "--data.batch_size", "2"]
            words += [] if released else SMALL_FEATURES
        main(words)
    assert list(tmp_path.glob("runs/*/test/summary.json"))
