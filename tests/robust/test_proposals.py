import torch
from planted import Planted, plant
from torch import Tensor

from bpnp.geometry import project, transform
from bpnp.metrics import rotation_error
from bpnp.models.evaluation import refine
from bpnp.robust.proposals import pose_hypotheses
from bpnp.types import Batch


def blurred(scene: Planted, share: float) -> Tensor:
    """Each 3D point equally likely to be any of the `share` of the 2D points that are nearest to where it is seen."""
    seen = project(transform(*scene.pose, scene.points3d))
    distance = torch.cdist(scene.points2d, seen)
    nearest = distance.argsort(1).argsort(1) < share * scene.points2d.shape[1]
    return nearest / nearest.sum((-2, -1), keepdim=True)


def errors(rotation: Tensor, scene: Planted) -> Tensor:
    """Degrees (b, s), infinite in empty slots."""
    b, s = rotation.shape[:2]
    truth = scene.rotation.unsqueeze(1).expand(b, s, 3, 3)
    error = rotation_error(rotation.flatten(0, 1), truth.flatten(0, 1)).view(b, s)
    return torch.where(rotation.isfinite().all((-2, -1)), error, torch.inf)


def test_a_blurred_assignment_proposes_the_pose() -> None:
    scene = plant(60, 200, noise=0.0025)
    assignment = blurred(scene, 0.1)
    on_truth = (assignment * (scene.permutation() > 0)).sum((-2, -1))
    assert on_truth.max() < 0.06
    rotation, translation, stats = pose_hypotheses(assignment, scene.points2d, scene.points3d, count=16)
    error = errors(rotation, scene)
    assert (error.amin(-1) < 15).double().mean() >= 0.95
    assert (error[:, 0] < 15).double().mean() < (error.amin(-1) < 15).double().mean()
    nearest = error.argmin(-1)
    shift = (translation[torch.arange(60), nearest] - scene.translation).norm(dim=-1)
    assert shift.median() < 1.5  # of about 5 units; a blurred triple tells the depth badly
    assert stats.converged.all()


def test_an_assignment_that_is_right_gives_the_exact_pose_first() -> None:
    scene = plant(3, 30)
    moved = scene.points3d + 1000
    rotation, translation, stats = pose_hypotheses(scene.permutation(), scene.points2d, moved, count=4)
    assert errors(rotation, scene)[:, 0].max() < 1e-5
    expected = scene.translation - scene.rotation @ torch.full((3,), 1000.0, dtype=torch.float64)
    torch.testing.assert_close(translation[:, 0], expected, atol=1e-5, rtol=0)
    assert (stats.residual < 1e-5).all()


def test_a_sample_without_pairs_has_no_pose_and_the_others_do() -> None:
    scene = plant(4, 20)
    assignment = scene.permutation()
    assignment[0] = 0
    assignment[1, 3, 3] = torch.nan
    mask3d = torch.ones(4, 20, dtype=torch.bool)
    mask3d[2, 2:] = False
    rotation, translation, stats = pose_hypotheses(assignment, scene.points2d, scene.points3d, count=2, mask3d=mask3d)
    assert rotation[:3].isnan().all()
    assert translation[:3].isnan().all()
    assert stats.converged.tolist() == [False, False, False, True]
    assert stats.residual[:3].isinf().all()
    assert stats.iterations.tolist()[:3] == [0, 0, 0]
    assert errors(rotation, scene)[3, 0] < 1e-5


def test_refinement_finds_the_start_that_is_roughly_right_among_many() -> None:
    scene = plant(2, 100, noise=0.0005, seed=3)
    rotation = plant(60, 1, seed=9).rotation.expand(2, 60, 3, 3).clone()
    translation = scene.translation.unsqueeze(1).repeat(1, 60, 1)
    rotation[:, 37], translation[:, 37] = scene.near(0.15)
    rotation[:, 5] = torch.nan
    refined = refine(scene.batch(), rotation, translation)
    assert errors(refined.rotation.unsqueeze(1), scene).max() < 0.5
    assert (refined.translation - scene.translation).norm(dim=-1).max() < 0.05
    assert (refined.stats.iterations > 59).all()
    alone = refine(Batch.from_arrays(scene.points2d[1:], scene.points3d[1:]), rotation[1:], translation[1:])
    assert torch.equal(alone.rotation[0], refined.rotation[1])
