"""A `Solution` and its JSON."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from planted import plant

from bpnp import Solution, solve
from bpnp.search.assemble import Solved
from bpnp.search.inputs import problem_from
from bpnp.search.solvers import Options, solve_problems
from bpnp.search.verdict.reasons import objection


def test_a_solution_is_the_same_after_its_json(tmp_path: Path) -> None:
    planted = plant(1, 30, noise=0.001)
    degenerate = np.ones((30, 3))
    for solution in (solve(planted.points2d[0], planted.points3d[0]), solve(planted.points2d[0], degenerate)):
        text = solution.to_json()
        assert "NaN" not in text
        (tmp_path / "s.json").write_text(text)
        for again in (Solution.from_json(text), Solution.from_json(tmp_path / "s.json")):
            assert again.to_json() == text
            np.testing.assert_array_equal(again.rotation, solution.rotation)
            np.testing.assert_array_equal(again.matches, solution.matches)
            np.testing.assert_array_equal(again.covariance, solution.covariance)
            np.testing.assert_array_equal(again.centre_std, solution.centre_std)
            assert (again.verdict, again.stats.iterations) == (solution.verdict, solution.stats.iterations)
            assert len(again.candidates) == len(solution.candidates)


def test_a_score_without_likelihood_is_the_same_after_its_json() -> None:
    planted = plant(1, 30, noise=0.001)
    solution = solve(planted.points2d[0], planted.points3d[0])
    changed = replace(solution, candidates=(replace(solution.candidates[0], score=-math.inf),))
    assert Solution.from_json(changed.to_json()).candidates[0].score == -math.inf


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", ""),
        ("[]", r"it holds \[\]"),
        ("{}", "its field 'format' is missing"),
        ('{"format": 2}', "format 2 in place of 3; solve the problem again"),
        ('{"format": 3, "verdict": "failed"}', "its field 'rotation' is missing"),
        ("\0", ""),
    ],
)
def test_a_text_that_is_no_solution_is_refused(text: str, reason: str) -> None:
    with pytest.raises(ValueError, match=f"not the JSON of a solution: {reason}"):
        Solution.from_json(text)


def test_values_that_depend_on_the_verdict_change_with_it() -> None:
    """`converged` is true for confident solutions only, and failed ones have no uncertainty."""
    planted = plant(1, 30, noise=0.001)
    problem = problem_from(planted.points2d[0].numpy(), planted.points3d[0].numpy(), None)
    solved = solve_problems({0: problem}, Options())[0]
    solution = solved.solution
    assert (solution.verdict, solution.stats.converged) == ("confident", True)
    case, doubtful = solved.against(objection("incomplete", what="pose", probability="0.1"))
    assert (doubtful.verdict, doubtful.reason_code, doubtful.stats.converged) == ("ambiguous", "incomplete", False)
    assert doubtful.rotation_std_deg == solution.rotation_std_deg
    claim = replace(case, claim=case.candidates[:1])
    better = objection("better_place", -3.5, distance=2.0, degrees=90.0, better=3.5)
    failed = Solved(claim, solution).against(better).solution
    assert failed.reason_code == "better_place"
    assert (failed.verdict, failed.stats.converged) == ("failed", False)
    assert np.isnan([failed.rotation_std_deg, failed.centre_std]).all()
    assert failed.stats.iterations == solution.stats.iterations
