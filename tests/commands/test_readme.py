"""What the README and the documentation tell users to type exists."""

import inspect
import re
import shlex
import typing
from collections.abc import Mapping
from pathlib import Path

import pytest
import yaml

from bpnp.cli import COMMANDS, LIGHTNING
from bpnp.commands.parser import run_command
from bpnp.configs import packaged_config

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
def test_commands_are_parsed(text: str, line: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Every command that the documentation shows is one, with options that it has."""
    words = shlex.split(line)
    if words[0] == "make":
        assert re.search(rf"^{words[1]}:", (ROOT / "Makefile").read_text(), re.MULTILINE)
        return
    name, rest = words[1], words[2:]
    if name in LIGHTNING:
        for option, value in zip(rest, rest[1:], strict=False):
            if option == "--config" and value != "FILE":
                assert yaml.safe_load(Path(packaged_config(value)).read_text())
        return
    command = COMMANDS[name]
    if isinstance(command, Mapping):
        name, command, rest = f"{name} {rest[0]}", command[rest[0]], rest[1:]
    called = []

    def fake(**chosen: object) -> None:
        called.append(chosen)

    fake.__signature__ = inspect.signature(command)  # type: ignore[attr-defined]
    fake.__annotations__ = command.__annotations__
    fake.__doc__ = command.__doc__
    hints_of = typing.get_type_hints(command)
    monkeypatch.setattr("typing.get_type_hints", lambda _: hints_of)
    run_command(name, fake, rest)
    assert called


@pytest.mark.parametrize("text", TEXTS, ids=lambda path: path.name)
def test_links_lead_somewhere(text: Path) -> None:
    for target in re.findall(r"\]\(([^)#]+)\)", text.read_text(encoding="utf-8")):
        if not target.startswith("http"):
            assert (text.parent / target).exists(), target
