"""Words of the command line that argparse would take for something else."""

from pathlib import Path

import pytest

from bpnp.commands.parser import closest_option, parse_arguments


def move(scale: float, *, translation: tuple[float, float, float] | None = None) -> None:
    """Move.

    Args:
        scale: a number.
        translation: three numbers.
    """


@pytest.mark.parametrize("text", ["-2e-05", "-2.5E+3", "-.5e1", "-3", "-0.25", "-1.", "4e-3"])
def test_negative_numbers_with_an_exponent_are_numbers(text: str) -> None:
    chosen = parse_arguments("move", move, [text, "--translation", "1", text, "3"])
    assert chosen == {"scale": float(text), "translation": (1.0, float(text), 3.0)}


def write(files: list[Path], *, name: str | None = None, output: Path | None = None, limit: float = 1.0) -> None:
    """Write.

    Args:
        files: files.
        name: a name.
        output: a file.
        limit: a number.
    """


@pytest.mark.parametrize(
    "text", ["caf\udce9 é.jpg", "a: b.csv", "null", "#1.csv", "&a", "- x", "[1].csv", "true", "1e3", "'q'", "inf"]
)
def test_names_of_files_are_taken_as_they_are(text: str) -> None:
    """In YAML some of these are null, and \udce9 stands for a byte that is not UTF-8."""
    expected = {"files": [Path(text)], "name": text, "output": Path(text), "limit": float("inf")}
    assert parse_arguments("write", write, [text, "--name", text, "--output", text, "--limit", "inf"]) == expected
    assert parse_arguments("write", write, [text, f"--name={text}", f"--output={text}", "--limit=inf"]) == expected


@pytest.mark.parametrize(
    ("unknown", "meant"),
    [
        ("--model.lr", "--model.learning_rate"),
        ("--model.learnign_rate", "--model.learning_rate"),
        ("--lr", "--model.learning_rate"),
        ("--modle.solver", "--model.solver"),
        ("--epochs", "--trainer.max_epochs"),
        ("--ckpt", "--ckpt_path"),
        ("--model.xyz", None),
    ],
)
def test_a_misspelt_option_is_found_by_its_name_in_the_group(unknown: str, meant: str | None) -> None:
    options = ["--config", "--model", "--model.solver", "--model.learning_rate", "--model.loss"]
    options += ["--trainer.max_epochs", "--trainer.min_epochs", "--optimizer.lr_decay", "--ckpt_path"]
    assert closest_option(unknown, options) == meant
