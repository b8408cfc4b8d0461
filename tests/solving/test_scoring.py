from dataclasses import replace

import numpy as np
import pytest
import torch
from planted import plant

from bpnp.search.annealing import Deadline
from bpnp.search.verdict import SearchResult
from bpnp.solving.problem import Problem, problem_from
from bpnp.solving.scoring import joined, scored


def ended(problem: Problem, pose: tuple[torch.Tensor, torch.Tensor], *, sure: bool) -> SearchResult:
    """A search that ended at this pose, sure of it or not."""
    rotation, translation = (values.numpy() for values in pose)
    found = scored(problem, rotation, translation + rotation @ problem.origin, Deadline())
    return replace(found, verdict="confident" if sure else "ambiguous")


@pytest.mark.parametrize(
    ("around", "anywhere", "safe"), [(True, False, True), (False, True, True), (False, False, False)]
)
def test_two_searches_that_end_alike_are_safe_if_one_is_sure(around: bool, anywhere: bool, safe: bool) -> None:
    planted = plant(1, 60, noise=0.001)
    problem = problem_from(planted.points2d[0], planted.points3d[0], None)
    first, second = (ended(problem, planted.pose, sure=sure) for sure in (around, anywhere))
    assert (joined(problem, first, second).verdict == "confident") == safe


def test_a_better_pose_that_the_other_search_did_not_find_is_not_safe() -> None:
    planted = plant(1, 60, noise=0.001)
    problem = problem_from(planted.points2d[0], planted.points3d[0], None)
    right, wrong = ended(problem, planted.pose, sure=True), ended(problem, planted.near(1.0), sure=True)
    assert right.candidates.score[0] > wrong.candidates.score[0]
    both = joined(problem, right, wrong)
    np.testing.assert_allclose(both.best[0], right.best[0], atol=1e-6)
    assert both.verdict != "confident"
