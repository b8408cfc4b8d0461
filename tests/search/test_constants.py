"""Constants of the search, of maps and of RANSAC: each has a unit and an origin where it stands."""

import ast
import re
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import chi2

import bpnp
from bpnp.search.possible_matches import FARTHEST_MATCH, MATCH_REACH
from bpnp.search.propose.known_matches import MOST_TRIPLES
from bpnp.search.propose.repetitions import BASES_OF_SCENE
from bpnp.search.propose.symmetries import BASES, FIRST_SAMPLED
from bpnp.search.refine.gauss_newton import DIFFERENCE_STEP
from bpnp.search.verdict.covariance import FAR_SQUARED
from bpnp.search.verdict.false_alarms import FARTHEST_PAIR
from bpnp.search.verdict.uncertainty import EXCEEDED

PACKAGE = Path(bpnp.__file__).parent
FILES = [file for folder in ("search", "maps", "layers/ransac") for file in sorted((PACKAGE / folder).rglob("*.py"))]
ORIGINS = ("calibration", "chosen on ", "measured, ", "derived", "convention", "cost", "numerics", "not tuned")


def constants(source: str) -> dict[str, str]:
    """Return the comments of the names in capitals to which a module assigns numbers; tables are no constants."""
    found, lines = dict[str, str](), source.splitlines()
    for node in ast.parse(source).body:
        if isinstance(node, ast.Assign | ast.AnnAssign) and node.value is not None:
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            parts = list(ast.walk(node.value))
            is_table = any(isinstance(part, ast.Dict) or getattr(part, "attr", "") == "array" for part in parts)
            values = [part.value for part in parts if isinstance(part, ast.Constant)]
            if any(type(value) in (int, float) for value in values) and not is_table and str not in map(type, values):
                names = [part.id for target in targets for part in ast.walk(target) if isinstance(part, ast.Name)]
                comments = [line.partition("  # ")[2] for line in lines[node.lineno - 1 : node.end_lineno]]
                found |= {name: "\n".join(filter(None, comments)) for name in names if name.strip("_").isupper()}
    return found


def test_constants_are_found_in_every_form() -> None:
    source = "A, B = 1, 2.0  # a\nC: int = 3\nD = {1: 2}\nE = f(4)\nG = True\n_H = 1 << 2\nn = 1\nK = (  # k\n 1,\n)"
    assert constants(source) == {"A": "a", "B": "a", "C": "", "E": "", "_H": "", "K": "k"}


@pytest.mark.parametrize("file", FILES, ids=lambda file: str(file.relative_to(PACKAGE)))
def test_constants_have_a_unit_and_an_origin(file: Path) -> None:
    for name, comment in constants(file.read_text()).items():
        assert mistake_in(name, comment) is None


def mistake_in(name: str, comment: str) -> str | None:
    """Return what the comment of a constant lacks, None if nothing."""
    tag = re.search(r"\[([^\[\];]+); ([^\[\];]+)\]$", comment, re.MULTILINE)
    if tag is not None and tag[2].startswith(ORIGINS):
        return None
    found = "no [unit; origin]" if tag is None else f"the origin {tag[2]!r}"
    allowed = ", ".join(origin.strip(" ,") for origin in ORIGINS)
    return f"the comment of {name} has {found}; an origin is one of {allowed}, which CONTRIBUTING.md explains"


def test_a_mistake_in_a_comment_names_the_origins() -> None:
    origins = "calibration, chosen on, measured, derived, convention, cost, numerics, not tuned"
    for comment, found in (("a number", "no [unit; origin]"), ("a [m; guess]", "the origin 'guess'")):
        text = f"the comment of A has {found}; an origin is one of {origins}, which CONTRIBUTING.md explains"
        assert mistake_in("A", comment) == text
    assert mistake_in("A", "a [m; chosen on walk_2]") is None


def test_fields_of_density_map_searches_have_a_unit_and_an_origin() -> None:
    source = (PACKAGE / "search" / "settings.py").read_text()
    numbers = re.findall(r"^    \w+: (?:int|float|tuple)[^=\n]* = (?![A-Z])(.*)$", source, re.MULTILINE)
    assert len(numbers) == 19
    for number in numbers:
        assert re.search(r"  # .*\[[^\[\];]+; (calibration|derived|cost)\]$", number), number


def test_derived_constants_follow_from_their_laws() -> None:
    """The numbers that the documentation derives: quantiles, probabilities of a miss, tails of a normal density."""
    assert chi2.ppf(1 - EXCEEDED, 6) == pytest.approx(FAR_SQUARED, abs=0.1)
    assert pytest.approx(9) == FARTHEST_PAIR**2 / 2
    assert pytest.approx(8) == FARTHEST_MATCH**2 / 2
    assert chi2.cdf(MATCH_REACH**2, 2) == pytest.approx(0.989, abs=5e-4)
    assert pytest.approx(3e-4, rel=0.1) == (1 - 0.2**3) ** MOST_TRIPLES
    assert pytest.approx(0.014, rel=0.05) == (1 - 0.5**3) ** BASES
    assert pytest.approx(1 / 17, rel=0.05) == (1 - 1 / 3) ** FIRST_SAMPLED
    assert pytest.approx(0.008, rel=0.05) == (1 - 1 / 27) ** BASES_OF_SCENE
    assert pytest.approx(np.cbrt(np.finfo(float).eps), rel=0.02) == DIFFERENCE_STEP
