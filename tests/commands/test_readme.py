"""Commands, options and files in the README and the documentation exist."""

import argparse
import os
import re
import runpy
import shlex
import subprocess
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest
import torch

from bpnp.cli import COMMANDS, LIGHTNING, main
from bpnp.commands.parser import parse_arguments
from bpnp.datamodules import StoredDataModule
from bpnp.geometry import project, transform

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[2]
TEXTS = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
BLOCK = re.compile(r"^```(\w*)\n(.*?)^```$", re.DOTALL | re.MULTILINE)
INLINE = re.compile(r"`([^`]+)`")
COMMAND = re.compile(r"((bpnp|lightning|make)\s+[a-z]|python\s+-m\s+benchmarks\s+[a-z])")
# What a reader replaces, and what stands for it here.
STAND_INS = {
    "my.module.Solver": "bpnp.models.Search",
    "my_file.MissedMass": "bpnp.training.ReprojectionLoss",
    "harder.yaml": "presets/debug",
}


def blocks(text: Path, language: str) -> list[str]:
    return [code for name, code in BLOCK.findall(text.read_text(encoding="utf-8")) if name == language]


def command_lines() -> Iterator[tuple[str, str]]:
    """Commands of the blocks, and those in the text that have arguments."""
    for text in TEXTS:
        for line in "".join(blocks(text, "")).replace("\\\n", " ").splitlines():
            if COMMAND.match(line):
                yield text.name, line.split("#")[0].strip()
        for span in INLINE.findall(BLOCK.sub("", text.read_text(encoding="utf-8"))):
            if COMMAND.match(span):
                yield text.name, " ".join(span.split())


COMMAND_LINES = list(dict.fromkeys(command_lines()))


class Parsed(Exception):
    """Raised in place of running a benchmark whose options were parsed."""


def parse_benchmark(words: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """Parse the options of a benchmark with its own parser, and run nothing."""
    parse_args = argparse.ArgumentParser.parse_args

    def stop(parser: argparse.ArgumentParser, *arguments: Any) -> None:
        parse_args(parser, *arguments)
        raise Parsed

    monkeypatch.setattr(argparse.ArgumentParser, "parse_args", stop)
    monkeypatch.setattr("sys.argv", words)
    with pytest.raises(Parsed):
        runpy.run_path(str(ROOT / "benchmarks" / "__main__.py"))["main"]()


def is_long(line: str) -> bool:
    """Return whether the options of a benchmark or all those of Lightning are parsed, for a fifth of a second."""
    words = line.split()
    return words[0] == "python" or (words[0] != "make" and words[1] in LIGHTNING and len(words) > 2)


@pytest.mark.parametrize(
    ("text", "line"),
    [
        pytest.param(text, line, marks=pytest.mark.nightly if is_long(line) and text != "README.md" else ())
        for text, line in COMMAND_LINES
    ],
)
def test_commands_are_parsed(
    text: str, line: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every command that the documentation shows is one, with options that it has."""
    words = shlex.split(line)
    if words[0] == "make":
        targets = re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
        assert set(words[1:]) <= set(targets)
        return
    if words[0] == "python":
        parse_benchmark(words[2:], monkeypatch)
        return
    name, rest = words[1], [STAND_INS.get(word, word) for word in words[2:]]
    assert name in COMMANDS or name in LIGHTNING
    if not rest:  # the text names the command
        return
    # An earlier command writes these checkpoints; packaged weights stand for them.
    if name in LIGHTNING:
        rest = ["procedural-so3" if word == "last" or word.endswith(".ckpt") else word for word in rest]
    if name in LIGHTNING:
        if not {"FILE", "--help"} & set(rest):
            with pytest.raises(SystemExit) as stop:
                main([name, *rest, "--print_config"])  # parses everything and runs nothing
            assert stop.value.code in (0, None), capsys.readouterr().err
        return
    command = COMMANDS[name]
    if isinstance(command, Mapping):
        name, command, rest = f"{name} {rest[0]}", command[rest[0]], rest[1:]
    if not rest or "--help" in rest:
        return
    assert parse_arguments(name, command, rest)


@pytest.mark.parametrize("words", ["benchmarks tables1", "benchmarks table1 --step 3 --dat x --no_such_option"])
def test_a_wrong_command_of_a_benchmark_is_found(words: str, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(SystemExit):
        parse_benchmark(words.split(), monkeypatch)


@pytest.mark.parametrize("text", TEXTS, ids=lambda path: path.name)
def test_links_lead_somewhere(text: Path) -> None:
    """Files, and headings in them."""
    for target, heading in re.findall(r"\]\(([^)#]*)(?:#([^)]*))?\)", text.read_text(encoding="utf-8")):
        if target.startswith("http"):
            continue
        file = (text.parent / target) if target else text
        assert file.exists(), target
        if heading:
            titles = re.findall(r"^#+ (.*)$", file.read_text(encoding="utf-8"), re.MULTILINE)
            slugs = {re.sub(r"[^\w\- ]", "", title).strip().lower().replace(" ", "-") for title in titles}
            assert heading in slugs, f"{target}#{heading}"


def test_the_site_lists_every_page_once() -> None:
    pages = re.findall(r": (\S+\.md)$", (ROOT / "mkdocs.yml").read_text(encoding="utf-8"), re.MULTILINE)
    written = [str(page.relative_to(ROOT / "docs")) for page in (ROOT / "docs").rglob("*.md")]
    assert sorted(pages) == sorted([*written, "changelog.md"])  # docs/hooks.py adds the last


def test_every_picture_is_shown_somewhere() -> None:
    shown = " ".join(text.read_text(encoding="utf-8") for text in TEXTS)
    assert [file.name for file in (ROOT / "docs" / "images").iterdir() if file.name not in shown] == []


def test_the_code_of_the_readme_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (code,) = blocks(ROOT / "README.md", "python")
    names: dict[str, Any] = {}
    exec(code, names)
    assert names["example"].rotation_error_deg(names["solution"].rotation) < 0.5  # the map is off by depth noise
    assert (tmp_path / "pose.png").stat().st_size > 5000
    expected = [line.split("# ")[-1] for line in code.splitlines() if "print(" in line]
    assert capsys.readouterr().out.split() == expected


@pytest.mark.parametrize(
    ("settings", "is_opened"),
    [
        ({"DISPLAY": ":0"}, True),
        ({"WAYLAND_DISPLAY": "wayland-0"}, True),
        ({}, False),
        ({"DISPLAY": ":0", "CI": "1"}, False),
    ],
)
def test_the_quickstart_opens_its_report_where_there_is_a_display(
    settings: dict[str, str], is_opened: bool, tmp_path: Path
) -> None:
    """A browser of the environment gets the page; its path is always printed."""
    browser = tmp_path / "browser"
    browser.write_text(f'#!/bin/sh\necho "$1" > "{tmp_path}/opened"\n')
    browser.chmod(0o755)
    line = ["make", "--no-print-directory", "-f", str(ROOT / "Makefile"), "show-report", f"PYTHON={sys.executable}"]
    environment = {"PATH": os.environ["PATH"], "BROWSER": f"{browser} %s", **settings}
    done = subprocess.run(line, cwd=tmp_path, env=environment, capture_output=True, text=True, check=True)
    page = tmp_path / "runs" / "quickstart" / "report.html"
    assert done.stdout == f"report: {page}\n"
    opened = tmp_path / "opened"
    assert (opened.read_text().strip() if opened.exists() else None) == (f"file://{page}" if is_opened else None)
    assert "show-report" in (ROOT / "Makefile").read_text().split("\nquickstart:")[1].split("\n\n")[0]


def test_the_code_of_the_data_guide_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Problems of a user's own, from a store and on demand: the true poses project the points onto their matches."""
    monkeypatch.chdir(tmp_path)
    stored, on_demand, _ = blocks(ROOT / "docs" / "data.md", "python")
    exec(stored, {})
    names: dict[str, Any] = {}
    exec(on_demand, names)
    for module in (StoredDataModule(root="data/mine"), names["MyDataModule"]()):
        module.setup()
        assert sum(len(module.datasets[part]) for part in ("train", "val", "test")) >= 20
        for batch in module.train_dataloader():
            seen = project(transform(batch.rotation, batch.translation, batch.points3d))
            matched = batch.points2d.gather(1, batch.match3d[..., None].expand(-1, -1, 2))
            torch.testing.assert_close(matched, seen, atol=1e-5, rtol=0)
