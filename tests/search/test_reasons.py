"""Reasons of verdicts: every code is documented, and a solution has the code of what its points show."""

import re
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

import bpnp
from bpnp.search.solution import Solution
from bpnp.search.verdict.reasons import CLAUSES, CONFIDENT, confident

PAGE = Path(__file__).parents[2] / "docs" / "verdict.md"


def test_every_reason_code_is_in_the_table_of_the_page() -> None:
    table = PAGE.read_text(encoding="utf-8").split("## Reasons")[1].split("\n## ")[0]
    cells = re.findall(r"^\| [^|]+ \| ([^|]+) \|", table, re.MULTILINE)[1:]
    codes = re.findall(r"`([a-z_]+)`", re.sub(r"\([^)]*\)", "", " ".join(cells)))
    assert codes[0] == CONFIDENT
    assert sorted(codes[1:]) == sorted(CLAUSES)


def test_the_sentence_of_a_confident_pose_is_that_of_the_page() -> None:
    assert confident(-69.1, 3.0, 0.213) in " ".join(PAGE.read_text(encoding="utf-8").split())


def image_of(scene: np.ndarray) -> np.ndarray:  # type: ignore[type-arg]
    camera = scene @ Rotation.from_euler("xyz", [0.5, 0.3, -0.7]).as_matrix().T + [0, 0, 6]
    return camera[:, :2] / camera[:, 2:]


def test_a_planted_pose_is_confident_and_unrelated_points_fit_by_chance() -> None:
    rng = np.random.default_rng(0)
    scene = rng.normal(size=(20, 3))
    found = bpnp.solve(rng.permutation(image_of(scene)), scene)
    unrelated = bpnp.solve(rng.uniform(-0.3, 0.3, (20, 2)), scene, time_limit=2, solver="search")
    assert (found.verdict, found.reason_code) == ("confident", "confident")
    assert unrelated.reason_code in ("chance", "insignificant")
    assert Solution.from_json(found.to_json()).reason_code == "confident"


def test_an_object_of_two_equal_halves_has_a_competing_pose() -> None:
    rng = np.random.default_rng(1)
    half = rng.normal(size=(8, 3))
    scene = np.concatenate([half, half * [-1, -1, 1]])
    solution = bpnp.solve(rng.permutation(image_of(scene)), scene, solver="search")
    assert (solution.verdict, solution.reason_code) == ("ambiguous", "competing_pose")


def test_the_pose_of_an_equal_part_beside_it_is_named_by_its_distance() -> None:
    """Two equal parts, side by side: the competing pose has the same rotation."""
    rng = np.random.default_rng(2)
    part = rng.uniform(-1, 1, (20, 3))
    image = part[:, :2] / (part[:, 2:] + 8)
    solution = bpnp.solve(image, np.concatenate([part, part + [4, 0, 0]]), solver="search")
    assert (solution.verdict, solution.reason_code) == ("ambiguous", "competing_pose")
    assert re.match("A competing pose 4[6-9] % of the distance away fits about as well", solution.reason)  # 4 of 8.3


def test_points_on_a_line_are_degenerate() -> None:
    line = np.outer(np.arange(8.0), [1, 2, 0.5])
    solution = bpnp.solve(image_of(line), line)
    assert (solution.verdict, solution.reason_code) == ("failed", "degenerate")
    rig = [(np.eye(3), np.array([x, 0.0, 0.0])) for x in (0.0, 0.5)]
    solution = bpnp.solve([image_of(line + shift) for _, shift in rig], line, rig=rig)
    assert (solution.verdict, solution.reason_code) == ("failed", "degenerate")
