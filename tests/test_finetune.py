"""The benchmark of fine-tuning tests the packaged weights and the tuned ones on the same problems."""

import json
from pathlib import Path
from types import SimpleNamespace

import finetune
import pages
import paper_tables
import pytest
from planted_model import plant_model
from report_data import row
from small_data import write_mesh_tree

from bpnp.cli import main
from bpnp.models import TrainedNet
from bpnp.models.weights import describe_module


@pytest.mark.nightly
def test_photos_and_shapes_are_tested_before_and_after_and_the_page_is_filled(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plant_model(tmp_path / "colmap" / "scene" / "sparse" / "0", seed=0, images=5)
    write_mesh_tree(tmp_path / "shapes")
    page = tmp_path / "train.md"
    page.write_text("<!-- finetune: data -->\nold\n<!-- end of finetune -->\n")
    monkeypatch.setattr(pages, "PAGES", (page,))
    monkeypatch.setattr(finetune, "FILE", tmp_path / "record.json")
    monkeypatch.setattr(finetune, "TEST_SHAPES", 2)
    monkeypatch.setenv("BPNP_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(finetune, "STEPS", 2)
    small = ["--data.batch_size=2"]
    runner = SimpleNamespace(run=lambda command, check: main([*command[3:], *small]))
    monkeypatch.setattr(finetune, "subprocess", runner)
    paths = ["--data", str(tmp_path), "--run", str(tmp_path / "run"), "--output", str(tmp_path / "record.json")]
    paths += ["--picture", str(tmp_path / "recall.png")]
    monkeypatch.setattr("sys.argv", ["finetune", *paths, "--scenes", "scene", "--shapes", "shapes"])
    finetune.main()
    rows = json.loads((tmp_path / "record.json").read_text())["rows"]
    parts = ["scene|tuned on", "scene|not tuned on", "shapes|not tuned on"]
    ends = [f"{when}|{estimate}" for when in ("before", "after") for estimate in ("ransac", "pnp")]
    assert list(rows) == [f"{part}|{end}" for part in parts for end in ends]
    assert [rows[f"{part}|after|pnp"]["problems"] for part in parts] == [3, 2, 2]
    for part in parts:
        assert rows[f"{part}|before|pnp"]["rotation"] != rows[f"{part}|after|pnp"]["rotation"]
    for name in ("scene", "shapes"):
        checkpoint = tmp_path / "run" / name / "checkpoints" / "last.ckpt"
        assert paper_tables.trained_steps(checkpoint) == 2
        tested = TrainedNet.from_checkpoint(checkpoint)  # as `bpnp test` does: the paper's inference, as in the table
        assert describe_module(tested) == describe_module(paper_tables.network(checkpoint))
        assert tested.estimates == ("ransac", "pnp")
    (line,) = (line for line in page.read_text().splitlines() if line.startswith("| scene, not tuned on, `pnp` | 2 |"))
    medians = (rows[f"scene|not tuned on|{when}|pnp"]["rotation"][1][0] for when in ("before", "after"))
    assert [float(cell.split(" [")[0]) for cell in line.split(" | ")[2:4]] == pytest.approx(list(medians), rel=0.05)
    assert (tmp_path / "recall.png").stat().st_size > 0
    pages.write_pages(check=True)
    picture = tmp_path / "picture.png"
    monkeypatch.setattr(finetune, "PICTURE", picture)
    options = paths[: paths.index("--picture")]
    monkeypatch.setattr("sys.argv", ["finetune", *options, "--scenes", "scene", "--shapes"])
    finetune.main()
    assert not picture.is_file(), "the picture of the page has all data of the record"
    monkeypatch.setattr("sys.argv", ["finetune", *options, "--scenes", "scene", "--shapes", "shapes"])
    finetune.main()
    assert picture.stat().st_size > 0


def test_the_picture_has_the_problems_that_were_not_tuned_on() -> None:
    rows = {
        f"{name}|{part}|{when}|{estimate}": [row(0, rotation_error_deg=2.0 * factor), row(1, rotation_error_deg=factor)]
        for name in ("one", "two")
        for part, factor in ((finetune.TUNED, 100.0), (finetune.HELD_OUT, 3.0))
        for when in ("before", "after")
        for estimate in ("ransac", "pnp")
    }
    one, two = finetune.recall_picture(rows).axes
    assert [axes.get_title() for axes in (one, two)] == ["one", "two"]
    assert {line.get_label() for line in two.lines} == {
        f"{estimate}, {when}" for estimate in ("pnp", "ransac") for when in ("after", "before")
    }
    assert [line.get_xdata().tolist() for line in one.lines] == [[3.0, 6.0]] * 4
    assert [line.get_ydata().tolist() for line in one.lines] == [[50.0, 100.0]] * 4
