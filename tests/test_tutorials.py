"""The tutorials run from the first line to the last and print what they show."""

import re
import shlex
from pathlib import Path
from typing import Any

import pytest
import tutorial
import yaml
from small_data import SMALL_FEATURES

from bpnp.cli import main

pytestmark = pytest.mark.nightly

ROOT = Path(__file__).parents[1]
BLOCK = re.compile(r"^```(\w*)\n(.*?)^```$", re.DOTALL | re.MULTILINE)
NUMBER = re.compile(r"-?\d+\.?\d*(?:e-?\d+)?")
VALUE = re.compile(rf"(?<!\w){NUMBER.pattern}(?!\.?\w)")  # not the number within a name such as 04.png
SHORT = {
    "trainer": {
        "max_epochs": 3,
        "limit_train_batches": 1,
        "log_every_n_steps": 1,
        "limit_val_batches": 1,
        "limit_test_batches": 2,
    }
}


def run(language: str, code: str, names: dict[str, Any]) -> None:
    """Run a block of Python, or of commands; trainings and tables are cut short."""
    if language == "python":
        exec(compile(code, "tutorial", "exec"), names)
        return
    for line in code.splitlines():
        words = shlex.split(line.replace("--limit 10", "--limit 2 --time_limit 2"))
        assert words[0] == "bpnp"
        if words[1] in ("fit", "test"):
            words += ["--config", "short.yaml", "--data.num_workers", "0", "--model.weights", "null", *SMALL_FEATURES]
        main(words[1:])


def shows(printed: str, expected: str, *, numbers: bool) -> None:
    """Every expected line begins a printed one, in this order, but for spaces and the values of numbers, which are
    compared to half of their size if `numbers`."""
    lines = iter(printed.splitlines())
    for line in expected.splitlines():
        words = " ".join(NUMBER.sub("#", line).split())
        same = next((p for p in lines if " ".join(NUMBER.sub("#", p).split()).startswith(words)), None)
        assert same is not None, f"expected {line!r} in\n{printed}"
        if numbers:
            values, shown = ([float(x) for x in VALUE.findall(text)] for text in (same, line))
            assert values == pytest.approx(shown, rel=0.5, abs=0.02)


@pytest.mark.filterwarnings("ignore:The pose loss joins at epoch 6")  # the training with L_c alone
@pytest.mark.parametrize("name", ["photo", "leds", "targets", "verify", "hloc", "train"])
def test_a_tutorial_runs_and_prints_what_it_shows(
    name: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    request: pytest.FixtureRequest,
) -> None:
    monkeypatch.chdir(tmp_path)
    if name == "hloc":  # skipped without the photos, which are not part of this project
        (tmp_path / "sacre_coeur").symlink_to(request.getfixturevalue("shared_data") / "photos" / "sacre_coeur")
    monkeypatch.setenv("COLUMNS", tutorial.WIDTH if name == "train" else "80")
    (tmp_path / "short.yaml").write_text(yaml.safe_dump(SHORT))
    names: dict[str, Any] = {"__name__": "tutorial"}
    blocks = BLOCK.findall((ROOT / "docs" / "tutorials" / f"{name}.md").read_text(encoding="utf-8"))
    assert [language for language, _ in blocks].count("text") > 2
    printed, language_before = "", ""
    for language, code in blocks:
        if language == "sh":  # a download
            continue
        if language == "text":
            shows(printed, code, numbers=language_before == "python")
            continue
        run(language, code, names)
        printed, language_before = capsys.readouterr().out, language
