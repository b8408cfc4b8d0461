"""What the README tells users to type exists."""

import re
import shlex
from pathlib import Path

import pytest
import yaml

from bpnp.cli import COMMANDS

ROOT = Path(__file__).parents[2]
TEXTS = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
COMMAND_LINES = [
    (text.name, line.split("#")[0].strip())
    for text in TEXTS
    for block in re.findall(r"```\n(.*?)```", text.read_text(encoding="utf-8"), re.DOTALL)
    for line in block.splitlines()
    if line.startswith(("bpnp ", "make "))
]


@pytest.mark.parametrize(("text", "line"), COMMAND_LINES)
def test_commands_and_their_recipes_exist(text: str, line: str) -> None:
    words = shlex.split(line)
    if words[0] == "make":
        assert re.search(rf"^{words[1]}:", (ROOT / "Makefile").read_text(), re.MULTILINE)
        return
    assert words[1] in {"fit", "validate", "test", "predict", *COMMANDS}
    for option, value in zip(words, words[1:], strict=False):
        if option == "--config":
            assert yaml.safe_load((ROOT / value).read_text())


@pytest.mark.parametrize("text", TEXTS, ids=lambda path: path.name)
def test_links_lead_somewhere(text: Path) -> None:
    for target in re.findall(r"\]\(([^)#]+)\)", text.read_text(encoding="utf-8")):
        if not target.startswith("http"):
            assert (text.parent / target).exists(), target
