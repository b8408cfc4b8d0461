"""Constants of the engine: one file, each with unit and origin."""

import ast
import dataclasses
import inspect
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.stats import chi2

from bpnp.search import config
from bpnp.search.config import ALARMS, MATCHES, PRECISION, REFINER, SYMMETRIES, Repetitions

PACKAGE = Path(config.__file__).parents[1]
FILES = [file for folder in ("search", "maps", "robust") for file in sorted((PACKAGE / folder).rglob("*.py"))]
GROUPS = [each for each in vars(config).values() if inspect.isclass(each) and each.__module__ == config.__name__]
ORIGINS = ("calibration", "chosen on ", "measured, ", "derived", "convention", "cost", "numerics", "not tuned")
# Numbers that cannot be chosen, by file.
FIXED = {
    "search/enumeration/search.py": {"ORDERS"},  # permutations
    "search/focal_length.py": {"RADIAL_PLACES", "AROUND"},  # indices of parameters; 1 and the step of `OtherFocal`
    "search/hypotheses.py": {"SIGNIFICANT"},  # above every log-likelihood
    "search/kernels/dense.py": {"POWER"},  # eight squarings
    "search/kernels/sides.py": {"FORWARD"},  # axis of the camera
    "search/propose/known_matches.py": {"FIXING"},  # three points fix a pose
    "search/propose/mirror.py": {"MIRROR"},  # reflection at z = 0
    "search/rig/search.py": {"BEFORE"},  # above every evidence
    "search/solution.py": {"FORMAT", "READERS"},  # version of a file, and shapes
    "search/verdict/covariance.py": {"ONE_SIGMA"},  # normal distribution
    "search/verdict/decide.py": {"HALF_TURN"},  # the largest angle between rotations
    "search/verdict/uncertainty.py": {"MANY", "STRAINS", "POSE"},  # infinity; a basis of matrices; unknowns of a pose
    "maps/index.py": {"FORMAT"},  # version of a file
    "maps/localize.py": {"RANKS"},  # order of the verdicts
    "maps/localized_picture.py": {"BOUND"},  # 99.9 % of a normal distribution in the plane
    "maps/photos.py": {
        # Numbers of EXIF and of COLMAP's database, and the size of 35 mm film.
        *("IFD_EXIF", "FOCAL_LENGTH", "FOCAL_LENGTH_35MM", "RESOLUTION_X", "RESOLUTION_UNIT", "ORIENTATION"),
        *("UP_OF_ORIENTATION", "PIXELS_X", "PIXELS_Y", "DIAGONAL_35MM", "MILLIMETRES", "COLUMNS"),
    },
}


def numeric_constants(source: str) -> set[str]:
    """Return the names in capitals to which a module assigns an expression with a number."""
    found: set[str] = set()
    for node in ast.parse(source).body:
        if isinstance(node, ast.Assign | ast.AnnAssign) and node.value is not None:
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            values = [each.value for each in ast.walk(node.value) if isinstance(each, ast.Constant)]
            if any(type(value) in (int, float) for value in values):
                names = {each.id for target in targets for each in ast.walk(target) if isinstance(each, ast.Name)}
                found |= {name for name in names if name.strip("_").isupper()}
    return found


def test_numeric_constants_are_found_in_every_form() -> None:
    source = "A, B = 1, 2.0\nC: int = 3\nD = {1: 'x'}\nE = f(4)\nF = 'x'\nG = True\n_H = 1 << 2\nn = 1\n"
    assert numeric_constants(source) == {"A", "B", "C", "D", "E", "_H"}


@pytest.mark.parametrize("file", FILES, ids=lambda file: str(file.relative_to(PACKAGE)))
def test_constants_that_can_be_chosen_are_in_one_file(file: Path) -> None:
    name = str(file.relative_to(PACKAGE))
    found = numeric_constants(file.read_text())
    if name != "search/config.py":
        assert found == FIXED.get(name, set())


def default_groups() -> list[str]:
    """Return the classes outside the configuration that are named like a group of it."""
    classes = (node for file in FILES for node in ast.parse(file.read_text()).body if isinstance(node, ast.ClassDef))
    return [one.name for one in classes if re.search(r"(Settings|Rules)$", one.name)]


def test_groups_of_constants_are_in_one_file() -> None:
    assert set(default_groups()) <= {group.__name__ for group in GROUPS}


def fields_of(group: Any) -> list[str]:
    return [one.name for one in dataclasses.fields(group)] if dataclasses.is_dataclass(group) else list(group._fields)


def is_group(value: Any) -> bool:
    return isinstance(value, tuple(group for group in GROUPS))


@pytest.mark.parametrize("group", GROUPS, ids=lambda group: group.__name__)
def test_constants_have_unit_and_origin(group: Any) -> None:
    text = inspect.getdoc(group) or ""
    entries = re.findall(r"^    (\w+): ((?:.*\n?)(?:        .*\n?)*)", text.partition("Attributes:\n")[2], re.MULTILINE)
    assert [name for name, _ in entries] == fields_of(group)
    for name, entry in entries:
        if not is_group(getattr(group, name, None)):
            tag = re.search(r"\. \[([^\[\];]+); ([^\[\];]+)\]$", " ".join(entry.split()))
            assert tag is not None, f"{group.__name__}.{name} ends without [unit; origin]"
            assert tag[2].startswith(ORIGINS), f"{group.__name__}.{name} has the origin {tag[2]!r}"


def test_derived_constants_follow_from_their_laws() -> None:
    """The numbers that the documentation derives: quantiles, probabilities of a miss, tails of a normal density."""
    assert chi2.ppf(1 - PRECISION.exceeded, 6) == pytest.approx(PRECISION.far, abs=0.1)
    assert ALARMS.farthest**2 / 2 == pytest.approx(9)
    assert MATCHES.farthest**2 / 2 == pytest.approx(8)
    assert chi2.cdf(MATCHES.reach**2, 2) == pytest.approx(0.989, abs=5e-4)
    assert (1 - 0.2**3) ** MATCHES.triples == pytest.approx(3e-4, rel=0.1)
    assert (1 - 0.5**3) ** SYMMETRIES.bases == pytest.approx(0.014, rel=0.05)
    assert (1 - 1 / 3) ** SYMMETRIES.first == pytest.approx(1 / 17, rel=0.05)
    assert (1 - 1 / 27) ** Repetitions.bases_of_scene == pytest.approx(0.008, rel=0.05)
    assert REFINER.difference == pytest.approx(np.cbrt(np.finfo(float).eps), rel=0.02)
