from dataclasses import replace
from typing import Any

import pytest
import torch
from planted import Planted, plant
from torch import Tensor

from bpnp.geometry import project, quaternion_rotation, transform
from bpnp.metrics import rotation_error
from bpnp.models.evaluation import refine
from bpnp.robust.proposals import drawn_poses, pose_hypotheses
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


def test_the_poses_are_apart_and_the_best_comes_first() -> None:
    scene = plant(1, 80)
    rotation, _, _ = pose_hypotheses(blurred(scene, 0.1), scene.points2d, scene.points3d, count=12)
    found = rotation[0][rotation[0].isfinite().all((-2, -1))]
    assert len(found) > 3
    cosine = (torch.einsum("sij,tij->st", found, found).fill_diagonal_(-1) - 1) / 2
    assert cosine.max() <= torch.tensor(15.0).deg2rad().cos() + 1e-5
    fewer, _, _ = pose_hypotheses(blurred(scene, 0.1), scene.points2d, scene.points3d, count=3)
    assert torch.equal(fewer[0], rotation[0, :3])


def test_neighbours_and_padding_change_nothing() -> None:
    scenes = [plant(1, n, outliers2d=n // 4, seed=n) for n in (40, 9, 25)]
    size2d, size3d = 60, 50
    assignment = torch.zeros(3, size2d, size3d, dtype=torch.float64)
    points2d, points3d = torch.full((3, size2d, 2), 9.0).double(), torch.full((3, size3d, 3), 9.0).double()
    mask2d, mask3d = torch.zeros(3, size2d, dtype=torch.bool), torch.zeros(3, size3d, dtype=torch.bool)
    for i, scene in enumerate(scenes):
        m, n = scene.points2d.shape[1], scene.points3d.shape[1]
        assignment[i, :m, :n], points2d[i, :m], points3d[i, :n] = (
            blurred(scene, 0.2)[0],
            scene.points2d[0],
            scene.points3d[0],
        )
        mask2d[i, :m], mask3d[i, :n] = True, True
    assignment[:, -1, -1] = 1  # of no point
    together = pose_hypotheses(assignment, points2d, points3d, count=6, mask2d=mask2d, mask3d=mask3d)
    for i, scene in enumerate(scenes):
        alone = pose_hypotheses(blurred(scene, 0.2), scene.points2d, scene.points3d, count=6)
        for a, b in zip(together[:2], alone[:2], strict=True):
            torch.testing.assert_close(a[i], b[0], atol=0, rtol=0, equal_nan=True)


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


@pytest.mark.parametrize("options", [{"count": 0}, {"threshold": 0.0}, {"threshold": -0.1}])
def test_options_out_of_range_are_named(options: dict[str, Any]) -> None:
    scene = plant(1, 8)
    with pytest.raises(ValueError, match=rf"expected.*`{next(iter(options))}`"):
        pose_hypotheses(scene.permutation(), scene.points2d, scene.points3d, **{"count": 2, **options})


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


def test_in_axes_near_the_camera_s_fewer_poses_are_drawn_and_more_of_them_are_near_the_true_one() -> None:
    """The scene's axes are 17 degrees off those of the camera; a tenth of the image is as likely as the true place."""
    scene = plant(4, 200, noise=0.0025)
    tilt = quaternion_rotation(torch.tensor([0.1, -0.1, 0.05, 1.0], dtype=torch.float64))
    turned = replace(scene, points3d=scene.points3d @ scene.rotation.mT @ tilt.mT, rotation=tilt.mT.expand(4, 3, 3))
    drawn = {
        aligned: drawn_poses(
            blurred(turned, 0.1), turned.points2d, turned.points3d, triples=8000, seed=0, aligned=aligned
        )[..., :3]
        for aligned in (False, True)
    }
    near = {aligned: int((errors(rotation, turned) < 10).sum()) for aligned, rotation in drawn.items()}
    solved = {aligned: int(rotation.isfinite().all((-2, -1)).sum()) for aligned, rotation in drawn.items()}
    assert solved[True] < 0.51 * solved[False]
    assert near[True] / solved[True] > 1.3 * near[False] / solved[False]
