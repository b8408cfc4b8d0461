import pytest
import torch
from planted import plant

from bpnp.search.many import Candidates
from bpnp.solving.problem import Problem, problem_from
from bpnp.solving.scoring import merged, scored


def ended(problem: Problem, pose: tuple[torch.Tensor, torch.Tensor], *, sure: bool) -> Candidates:
    """A search that ended at this pose, sure of it or not."""
    rotation, translation = pose
    shift = translation + (rotation @ torch.as_tensor(problem.origin).unsqueeze(-1)).squeeze(-1)
    found = scored(problem, rotation.numpy(), shift.numpy())
    found.stats.converged[:] = sure
    return found


@pytest.mark.parametrize(
    ("around", "anywhere", "safe"), [(True, False, True), (False, True, True), (False, False, False)]
)
def test_two_searches_that_end_alike_are_safe_if_one_is_sure(around: bool, anywhere: bool, safe: bool) -> None:
    planted = plant(1, 60, noise=0.001)
    problem = problem_from(planted.points2d[0], planted.points3d[0], None)
    first, second = (ended(problem, planted.pose, sure=sure) for sure in (around, anywhere))
    assert bool(merged(problem, first, second).stats.converged[0]) == safe


def test_a_better_pose_that_the_other_search_did_not_find_is_not_safe() -> None:
    planted = plant(1, 60, noise=0.001)
    problem = problem_from(planted.points2d[0], planted.points3d[0], None)
    right, wrong = ended(problem, planted.pose, sure=True), ended(problem, planted.near(1.0), sure=True)
    assert right.score[0, 0] > wrong.score[0, 0]
    both = merged(problem, right, wrong)
    torch.testing.assert_close(both.rotation[0, 0], right.rotation[0, 0])
    assert not both.stats.converged[0]
