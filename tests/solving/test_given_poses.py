from dataclasses import replace

import numpy as np
import torch
from planted import plant

from bpnp.search.annealing import Deadline
from bpnp.search.verdict import SearchResult
from bpnp.solving.given_poses import joined, scored
from bpnp.solving.problem import Problem, problem_from


def ended(problem: Problem, pose: tuple[torch.Tensor, torch.Tensor]) -> SearchResult:
    """A search that ended near this pose and was sure of it."""
    rotation, translation = (values.numpy() for values in pose)
    found = scored(problem, rotation, translation + rotation @ problem.origin, Deadline())
    return replace(found, verdict="confident")


def test_the_better_pose_of_two_searches_is_first_whichever_found_it() -> None:
    planted = plant(1, 60, noise=0.001)
    problem = problem_from(planted.points2d[0], planted.points3d[0], None)
    right, wrong = ended(problem, planted.pose), ended(problem, planted.near(1.0))
    for both in (joined(problem, right, wrong), joined(problem, wrong, right)):
        np.testing.assert_allclose(both.best[0], right.best[0], atol=1e-6)
        assert both.verdict == "confident"
        assert both.batches == right.batches + wrong.batches


def test_two_searches_that_end_at_one_wrong_pose_are_not_believed() -> None:
    planted = plant(1, 60, noise=0.001)
    problem = problem_from(planted.points2d[0], planted.points3d[0], None)
    wrong = ended(problem, planted.near(1.0))
    assert wrong.log10_false_alarms > 0
    assert joined(problem, wrong, wrong).verdict == "failed"
