"""The benchmark of fine-tuning tests the packaged weights and the tuned ones on the same photos."""

import json
from pathlib import Path
from types import SimpleNamespace

import finetune
import paper_tables
import pytest
from planted_model import plant_model

from bpnp.cli import main


def test_photos_are_tested_before_and_after_and_the_page_is_filled(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plant_model(tmp_path / "colmap" / "scene" / "sparse" / "0", seed=0)
    page = tmp_path / "train.md"
    page.write_text("<!-- finetune: scenes -->\nold\n<!-- end of finetune -->\n")
    monkeypatch.setattr(finetune, "PAGES", (page,))
    short = ["--trainer.max_steps=2", "--data.batch_size=2"]
    runner = SimpleNamespace(run=lambda command, check: main([*command[3:], *short]))
    monkeypatch.setattr(finetune, "subprocess", runner)
    paths = ["--data", str(tmp_path), "--run", str(tmp_path / "run"), "--output", str(tmp_path / "record.json")]
    monkeypatch.setattr("sys.argv", ["finetune", *paths, "--scenes", "scene"])
    finetune.main()
    rows = json.loads((tmp_path / "record.json").read_text())["rows"]
    assert list(rows) == [f"scene|{when}|{estimate}" for when in ("before", "after") for estimate in ("ransac", "pnp")]
    assert rows["scene|before|pnp"]["rotation"] != rows["scene|after|pnp"]["rotation"]
    assert paper_tables.trained_steps(tmp_path / "run" / "scene" / "checkpoints" / "last.ckpt") == 2
    assert "| scene, `pnp`, after | 120 |" in page.read_text()
    monkeypatch.setattr("sys.argv", ["finetune", *paths, "--check"])
    finetune.main()
