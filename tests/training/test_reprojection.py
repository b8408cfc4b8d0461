"""The loss without labels: its value by hand, its gradient by finite differences, and that labels do not matter."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from planted import Planted, padded, plant, posed
from torch import Tensor

from bpnp.layers import weighted_pnp
from bpnp.training import ReprojectionLoss
from bpnp.types import Pose, Prediction, SolveStats


def solved(planted: Planted, assignment: Tensor, start: tuple[Tensor, Tensor]) -> Prediction:
    rotation, translation, stats = weighted_pnp(
        assignment, planted.bearings, planted.points3d, *start, tolerance=1e-13, max_iterations=100
    )
    return Prediction(assignment, poses={"pnp": Pose(rotation, translation, stats)})


def test_the_reprojection_loss_is_the_mean_angle_of_the_assigned_points() -> None:
    """The numbers with numpy: angles by arccos, the assignment as weights."""
    planted = plant(2, 10, outliers2d=3, outliers3d=2)
    assignment = 5 * planted.diffuse(0.3)
    prediction = Prediction(assignment, poses={"pnp": Pose(*planted.near(0.2), SolveStats.of(torch.ones(2) > 0))})
    values = ReprojectionLoss()(prediction, planted.batch())
    for k in range(2):
        r, t = (x[k].numpy() for x in planted.near(0.2))
        y = planted.points3d[k].numpy() @ r.T + t
        f = planted.bearings[k].numpy()
        angles = np.arccos(np.clip(f @ (y / np.linalg.norm(y, axis=-1, keepdims=True)).T, -1, 1))
        weights = assignment[k].numpy()
        assert float(values[k]) == pytest.approx((weights * angles).sum() / weights.sum(), rel=1e-5)


def test_true_matches_at_the_true_pose_have_none() -> None:
    planted = plant(3, 10)
    prediction = Prediction(planted.permutation(), poses={"pnp": Pose(*planted.pose, SolveStats.of(torch.ones(3) > 0))})
    assert ReprojectionLoss()(prediction, planted.batch()).max() < 1e-6


def test_the_gradient_of_the_reprojection_loss_is_finite_differences() -> None:
    planted = plant(1, 6, outliers2d=2, seed=3)
    start, batch = planted.near(0.02), planted.batch().to(torch.float64)

    def value(assignment: Tensor) -> Tensor:
        return ReprojectionLoss()(solved(planted, assignment, start), batch)[0]

    at = planted.diffuse(0.2).requires_grad_()
    (gradient,) = torch.autograd.grad(value(at), at)
    for i, j in ((0, 0), (3, 2), (7, 5)):
        step = torch.zeros_like(at)
        step[0, i, j] = 1e-6
        numeric = (value(at + step) - value(at - step)) / 2e-6
        assert float(gradient[0, i, j]) == pytest.approx(float(numeric), rel=1e-4, abs=1e-6)


def test_labels_do_not_matter_and_a_sample_without_a_pose_has_no_loss() -> None:
    planted = plant(2, 10)
    labelled = planted.batch()
    unlabelled = replace(labelled, rotation=None, translation=None, match3d=None)
    prediction = solved(planted, planted.diffuse(0.2), planted.near(0.05))
    values = ReprojectionLoss()(prediction, labelled)
    assert values.equal(ReprojectionLoss()(prediction, unlabelled))
    pose = prediction.poses["pnp"]
    missing = Pose(pose.rotation, pose.translation, SolveStats.of(torch.tensor([False, True])))
    assert ReprojectionLoss()(replace(prediction, poses={"pnp": missing}), labelled).isnan().tolist() == [True, False]


def test_mass_at_padded_points_does_not_count() -> None:
    large, small = plant(1, 10), plant(1, 6, seed=1)
    assignment = torch.rand(2, 10, 10, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    poses = [torch.cat(values) for values in zip(large.near(0.1), small.near(0.1), strict=True)]
    both = ReprojectionLoss()(Prediction(assignment, poses={"pnp": posed(*poses)}), padded([large, small]))
    alone = Prediction(assignment[1:, :6, :6], poses={"pnp": posed(*small.near(0.1))})
    torch.testing.assert_close(both[1:], ReprojectionLoss()(alone, small.batch()))


def test_a_solver_without_an_assignment_is_one_error() -> None:
    with pytest.raises(ValueError, match="has no assignment; ReprojectionLoss trains"):
        ReprojectionLoss()(Prediction(), plant(1, 6).batch())
