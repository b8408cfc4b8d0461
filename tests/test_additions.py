"""The benchmark of the additions to the training trains with each, and compares it with the training without."""

import json
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import additions
import pages
import paper_tables
import pytest
from additions import Addition
from small_data import write_mesh_tree

from bpnp.cli import main
from bpnp.datamodules import MeshDataModule


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.filterwarnings(
    "ignore:The pose loss joins at epoch", "ignore:`ModelCheckpoint", "ignore:It is recommended"
)
def test_each_addition_is_trained_with_as_many_points_and_compared(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """2 steps of 2 problems with 16 points are 4 of 8 points and one of 16, and 4 of one problem."""
    write_mesh_tree(tmp_path / "modelnet10")
    page = tmp_path / "table1.md"
    links = "[rows](additions.csv) and [effects](additions-effects.csv)\n"
    page.write_text(f"<!-- additions: rows -->\n<!-- end of additions -->\n{links}")
    monkeypatch.setattr(pages, "PAGES", (page,))
    few = Addition(parts=((8, 0.5), (16, 0.5)))
    tried = {
        additions.NONE: Addition(parts=((16, 1.0),), batch=2),
        "few first": Addition(parts=few.parts, batch=2),
        "one": Addition(("--model.matching_loss=likelihood",), parts=((16, 1.0),), batch=1, schedule=True),
    }
    for name, value in {"FILE": tmp_path / "record.json", "ADDITIONS": tried}.items():
        monkeypatch.setattr(additions, name, value)
    for name, value in {"EPOCH": 1, "POINTS": 16, "BATCH": 2}.items():
        monkeypatch.setattr(additions, name, value)
    small = partial(MeshDataModule, str(tmp_path / "modelnet10"), num_points=16, pool_size=32, test_problems=2)
    monkeypatch.setattr(additions, "data_module", lambda *_: small())
    monkeypatch.setenv("BPNP_CACHE", str(tmp_path / "cache"))
    shrunk = ["--data.pool_size=32", "--data.train_problems=8", "--data.val_fraction=0.5"]
    commands: list[list[str]] = []

    def run(command: list[str], check: bool) -> None:
        commands.append(command)
        main([*command[3:], *shrunk])

    monkeypatch.setattr(paper_tables, "subprocess", SimpleNamespace(run=run))
    options = [f"--data={tmp_path}", f"--run={tmp_path / 'run'}", f"--output={tmp_path / 'record.json'}"]
    monkeypatch.setattr("sys.argv", ["additions", *options, "--steps", "2"])
    additions.main()
    lengths = {"0-16": 2, "1-8": 2, "1-16": 3, "2-16": 4}
    for name, steps in lengths.items():
        assert paper_tables.trained_steps(tmp_path / "run" / "seed0" / name / "checkpoints" / "last.ckpt") == steps
    assert len(commands) == len(lengths)
    assert f"{tmp_path}/run/seed0/1-8/checkpoints/last.ckpt" in commands[2]  # goes on from the part before
    assert {"--model.matching_loss=likelihood", "--model.decay_start=2", "--model.decay_steps=2"} <= set(commands[3])
    record = json.loads((tmp_path / "record.json").read_text())
    assert list(record["effects"]) == [f"0|{name}|{end}" for name in list(tried)[1:] for end in ("pnp", "ransac")]
    assert [record["rows"][f"0|{name}|pnp"]["steps"] for name in tried] == [2, 3, 4]
    median = {name: record["rows"][f"0|{name}|pnp"]["rotation"][1][0] for name in tried}
    for name in list(tried)[1:]:
        difference = median[name] - median[additions.NONE]
        assert record["effects"][f"0|{name}|pnp"]["rotation"][0] == pytest.approx(difference, rel=2e-3, abs=1e-3)
    assert "| few first | 3 |" in page.read_text()
    assert "0,few first,ransac,2," in (tmp_path / "additions.csv").read_text()
    assert "0,one,pnp,2," in (tmp_path / "additions-effects.csv").read_text()
    pages.write_pages(check=True)
    additions.main()
    assert len(commands) == len(lengths), "what is there is not trained again"


def test_the_additions_are_those_of_the_packaged_weights() -> None:
    """The words of `paper_weights` that an addition repeats; all together are one row."""
    alone = [one.arguments for name, one in additions.ADDITIONS.items() if name != "all of ours"]
    everything = set(additions.ADDITIONS["all of ours"].arguments)
    assert all(set(words) <= everything for words in alone if words != ("--model.learning_rate=1e-3",))
    assert len(additions.FEATURES) == 6
    assert additions.ADDITIONS[additions.NONE].arguments == ()
