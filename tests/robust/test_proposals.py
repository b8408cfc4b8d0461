from dataclasses import replace

import torch
from planted import Planted, plant
from torch import Tensor

from bpnp.geometry import project, transform
from bpnp.metrics import rotation_error
from bpnp.robust.proposals import pose_hypotheses


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


def proposed(scene: Planted, assignment: Tensor, count: int, mask3d: Tensor | None = None) -> tuple[Tensor, Tensor]:
    masks = torch.ones_like(assignment[:, :, 0], dtype=torch.bool), torch.ones_like(assignment[:, 0], dtype=torch.bool)
    return pose_hypotheses(
        assignment, scene.points2d, scene.points3d, masks[0], masks[1] if mask3d is None else mask3d, count=count
    )


def test_a_blurred_assignment_proposes_the_pose() -> None:
    scene = plant(60, 200, noise=0.0025)
    assignment = blurred(scene, 0.1)
    on_truth = (assignment * (scene.permutation() > 0)).sum((-2, -1))
    assert on_truth.max() < 0.06
    rotation, translation = proposed(scene, assignment, 16)
    error = errors(rotation, scene)
    assert (error.amin(-1) < 15).double().mean() >= 0.95
    assert (error[:, 0] < 15).double().mean() < (error.amin(-1) < 15).double().mean()
    nearest = error.argmin(-1)
    shift = (translation[torch.arange(60), nearest] - scene.translation).norm(dim=-1)
    assert shift.median() < 1.5  # of about 5 units; a blurred triple tells the depth badly


def test_an_assignment_that_is_right_gives_the_exact_pose_first() -> None:
    scene = plant(3, 30)
    moved = replace(scene, points3d=scene.points3d + 1000)
    rotation, translation = proposed(moved, scene.permutation(), 4)
    assert errors(rotation, scene)[:, 0].max() < 1e-5
    expected = scene.translation - scene.rotation @ torch.full((3,), 1000.0, dtype=torch.float64)
    torch.testing.assert_close(translation[:, 0], expected, atol=1e-5, rtol=0)


def test_a_sample_without_pairs_has_no_pose_and_the_others_do() -> None:
    scene = plant(4, 20)
    assignment = scene.permutation()
    assignment[0] = 0
    assignment[1, 3, 3] = torch.nan
    mask3d = torch.ones(4, 20, dtype=torch.bool)
    mask3d[2, 2:] = False
    rotation, translation = proposed(scene, assignment, 2, mask3d)
    assert rotation[:3].isnan().all()
    assert translation[:3].isnan().all()
    assert errors(rotation, scene)[3, 0] < 1e-5
