"""Words of the command line that argparse would take for something else."""

import pytest

from bpnp.commands.parser import parse_arguments


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
