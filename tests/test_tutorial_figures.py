"""The benchmark of the tutorial runs the commands of its page, and fills the page with what they give."""

import io
import json
import shlex
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pages
import pytest
import tutorial
from report_data import row
from rich.console import Console

from bpnp.report import ProblemRow, write_results
from bpnp.report.tables import read_runs, results_table

pytestmark = pytest.mark.nightly

PAGE = """
```
bpnp fit --config quickstart
```
```
bpnp test --results.folder runs/quickstart/Lc
bpnp test --results.folder runs/quickstart/LcLp
bpnp report runs/quickstart/Lc runs/quickstart/LcLp
```
<!-- tutorial: test -->
old
<!-- end of tutorial -->
<!-- tutorial: effect -->
old
<!-- end of tutorial -->
```
bpnp table --methods search
```
<!-- tutorial: compare -->
<!-- end of tutorial -->
## Change something
```
bpnp fit --config another
```
"""
# Errors of `pnp` in degrees and scene units; of the other estimate they are the same before and after.
PLANTED = {"Lc": (7.0, 0.4), "LcLp": (8.0, 0.125), "search": (0.5, 0.01)}


def planted_rows(name: str, estimates: tuple[str, ...]) -> list[ProblemRow]:
    degrees, shift = PLANTED[name]
    errors = {"rotation_error_deg": degrees, "translation_error": shift, "reprojection_error_deg": 1.0}
    same = errors | {"rotation_error_deg": 2.0, "translation_error": 0.1}
    return [row(i, each, **(same if each == "refined" else errors)) for i in range(8) for each in estimates]


@pytest.fixture
def ran(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The commands that were run: they write planted results and print their table."""
    lines: list[str] = []

    def run(words: list[str], *, cwd: Path, **_: Any) -> SimpleNamespace:
        lines.append(shlex.join(words[2:]))
        text, name = "", Path(words[-1]).name
        if words[3] == "test":
            write_results(cwd / words[-1], planted_rows(name, ("refined", "pnp")))
        elif words[3] == "table":
            write_results(cwd / "runs" / "table" / "search", planted_rows("search", ("search",)))
        elif words[3] == "report":
            terminal = Console(file=io.StringIO(), width=80)
            terminal.print("wrote curves.png")
            terminal.print(results_table(read_runs([cwd / word for word in words[4:]])))
            text = terminal.file.getvalue()
            for picture in tutorial.DRAWN:
                (cwd / picture).write_text(f"{picture}, {len(lines)} commands")
        return SimpleNamespace(stdout=text.encode())

    (tmp_path / "train.md").write_text(PAGE)
    (tmp_path / "pictures").mkdir()
    (tmp_path / "README.md").write_text("<!-- tutorial: test -->\nold\n<!-- end of tutorial -->\n")
    monkeypatch.setattr(tutorial, "PAGE", tmp_path / "train.md")
    monkeypatch.setattr(pages, "PAGES", (tmp_path / "train.md", tmp_path / "README.md"))
    monkeypatch.setattr(tutorial, "FILE", tmp_path / "record.json")
    monkeypatch.setattr(tutorial.subprocess, "run", run)
    paths = {name: str(tmp_path / name) for name in ("run", "pictures")}
    monkeypatch.setattr("sys.argv", ["tutorial", *(f"--{name}={path}" for name, path in paths.items())])
    monkeypatch.setattr("record.commit", lambda: f"commit {len(lines)}")
    return lines


def test_the_page_is_filled_with_what_its_commands_give(
    ran: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tutorial.main()
    assert ran == [line for line in PAGE.splitlines() if line.startswith("bpnp ")][:-1]
    text = (tmp_path / "train.md").read_text()
    lines = [line.split() for line in text.splitlines()]
    assert ["LcLp:", "pnp", *["8.00"] * 3, *["0.12"] * 3, *["1.00"] * 3] in [line[:11] for line in lines]
    assert ["Lc:", "refined", *["2.00"] * 3, *["0.10"] * 3, *["1.00"] * 3] in [line[:11] for line in lines]
    assert "| `pnp` | 8 | +1 [+1, +1], better in 0 % | -0.28 [-0.28, -0.28], better in 100 % |" in text
    assert "| `refined` | 8 | +0 [+0, +0], better in 0 % | +0 [+0, +0], better in 0 % |" in text
    assert "| search | 8 | 0.5 / 0.5 [0.5, 0.5] / 0.5 | 0.01 / 0.01 [0.01, 0.01] / 0.01 |" in text
    assert "\nold\n" not in text
    table = text.split("<!-- tutorial: test -->\n")[1].split("<!-- end")[0]
    assert table in (tmp_path / "README.md").read_text()
    assert text.index("| `pnp` |") < text.index("| `refined` |")
    assert (tmp_path / "pictures" / "recall.png").read_text() == "recall.png, 4 commands"
    assert json.loads((tmp_path / "record.json").read_text())["measured"]["commit"] == "commit 0"


def test_a_second_run_repeats_nothing_and_a_changed_command_those_after_it(
    ran: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tutorial.main()
    text = (tmp_path / "train.md").read_text()
    tutorial.main()
    assert len(ran) == 5
    assert (tmp_path / "train.md").read_text() == text
    monkeypatch.setitem(PLANTED, "LcLp", (9.0, 0.125))
    (tmp_path / "train.md").write_text(text.replace("bpnp test --results", "bpnp test --quiet --results"))
    tutorial.main()
    assert len(ran) == 9, "the training is not run again"
    assert "+2 [+2, +2]" in (tmp_path / "train.md").read_text()


def test_the_page_says_what_the_record_shows() -> None:
    record = json.loads(tutorial.FILE.read_text())
    text = tutorial.PAGE.read_text(encoding="utf-8")
    assert "lowers the translation error of `pnp`" in text
    value, low, high = record["effects"]["pnp"]["translation"]
    assert low <= value <= high < 0
    assert "not its rotation error" in text
    _, low, high = record["effects"]["pnp"]["rotation"]
    assert low <= 0 <= high
