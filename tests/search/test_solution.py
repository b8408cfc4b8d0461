"""A `Solution` and its JSON."""

from pathlib import Path

import numpy as np
import pytest
from planted import plant

from bpnp import Solution, solve


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


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"format": 2}', "\0"])
def test_a_text_that_is_no_solution_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match="not the JSON of a solution"):
        Solution.from_json(text)
