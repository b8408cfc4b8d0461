"""What the README and the documentation tell users to type exists."""

import re
import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bpnp.cli import COMMANDS, LIGHTNING, main
from bpnp.commands.parser import parsed_arguments
from bpnp.examples import load

ROOT = Path(__file__).parents[2]
TEXTS = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
COMMAND_LINES = [
    (text.name, line.split("#")[0].strip())
    for text in TEXTS
    for block in re.findall(r"```\n(.*?)```", text.read_text(encoding="utf-8"), re.DOTALL)
    for line in block.splitlines()
    if line.startswith(("bpnp ", "make "))
]


def test_there_are_commands_to_test() -> None:
    assert len(COMMAND_LINES) > 12


@pytest.mark.parametrize(("text", "line"), COMMAND_LINES)
def test_commands_are_parsed(text: str, line: str, capsys: pytest.CaptureFixture[str]) -> None:
    """Every command that the documentation shows is one, with options that it has."""
    words = shlex.split(line)
    if words[0] == "make":
        assert re.search(rf"^{words[1]}:", (ROOT / "Makefile").read_text(), re.MULTILINE)
        return
    name, rest = words[1], words[2:]
    if name in LIGHTNING:
        if "FILE" not in rest and not (rest and rest[0] == "--help"):
            with pytest.raises(SystemExit) as stop:
                main([name, *rest, "--print_config"])  # parses everything and runs nothing
            assert stop.value.code in (0, None), capsys.readouterr().err
        return
    command = COMMANDS[name]
    if isinstance(command, Mapping):
        name, command, rest = f"{name} {rest[0]}", command[rest[0]], rest[1:]
    assert parsed_arguments(name, command, rest)


@pytest.mark.parametrize("text", TEXTS, ids=lambda path: path.name)
def test_links_lead_somewhere(text: Path) -> None:
    for target in re.findall(r"\]\(([^)#]+)\)", text.read_text(encoding="utf-8")):
        if not target.startswith("http"):
            assert (text.parent / target).exists(), target


def test_the_readme_is_short() -> None:
    lines = (ROOT / "README.md").read_text(encoding="utf-8").splitlines()
    assert len(lines) <= 100
    assert max(map(len, lines)) <= 120


def test_the_code_of_the_readme_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    blocks = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(encoding="utf-8"), re.DOTALL)
    assert len(blocks) == 2
    names: dict[str, Any] = {}
    exec(blocks[0], names)
    assert names["example"].rotation_error_deg(names["solution"].rotation) < 0.5  # the map is off by depth noise
    assert (tmp_path / "pose.png").stat().st_size > 5000
    mesh = load("mesh")
    bearings = np.c_[mesh.points2d, np.ones(200)] @ np.linalg.inv(mesh.camera).T
    names |= {"points2d": bearings[:, :2], "points3d": mesh.points3d}
    exec(blocks[1], names)
    assert names["pose"].rotation.shape == (1, 3, 3)
