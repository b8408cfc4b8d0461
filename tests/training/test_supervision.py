import math
from dataclasses import replace

import pytest
import torch
from planted import Planted, plant, posed
from small_data import small_net

from bpnp import Batch, Pose, Prediction
from bpnp.models import Matcher
from bpnp.training.losses import matching_likelihood_loss, matching_losses, reprojection_loss
from bpnp.training.task import BlindPnPTask


def solved(planted: Planted, converged: list[bool]) -> Pose:
    found = torch.tensor(converged)
    rotation = torch.where(found[:, None, None], planted.rotation, torch.nan)
    return posed(rotation, torch.where(found[:, None], planted.translation, torch.nan), converged)


def test_the_angle_under_the_solved_pose_is_a_mean_over_the_assigned_mass() -> None:
    planted = plant(1, 6)
    wrong = planted.permutation().roll(1, -1)
    total = 0.0
    for i, j in wrong[0].nonzero().tolist():
        seen = planted.rotation[0] @ planted.points3d[0, j] + planted.translation[0]
        total += math.acos(float(planted.bearings[0, i] @ seen / seen.norm())) / 6
    for mass in (1.0, 0.3):
        loss = reprojection_loss(mass * wrong, planted.batch(), solved(planted, [True]))
        assert float(loss[0]) == pytest.approx(total, rel=1e-9)
    right = reprojection_loss(planted.permutation(), planted.batch(), solved(planted, [True]))
    assert float(right[0]) < 1e-6


def test_a_sample_without_a_pose_has_no_such_loss_and_no_gradient() -> None:
    planted = plant(2, 6)
    plan = planted.permutation().roll(1, -1).requires_grad_()
    losses = reprojection_loss(plan, planted.batch(), solved(planted, [True, False]))
    (gradient,) = torch.autograd.grad(losses.sum(), plan)
    assert losses[0] > 0
    assert losses[1] == 0
    assert gradient[0].abs().max() > 0
    assert not gradient[1].any()


def test_samples_without_a_pose_do_not_dilute_the_mean_of_a_training_step() -> None:
    planted = plant(2, 6)
    plan = planted.permutation().roll(1, -1)
    prediction = Prediction(plan, poses={"pnp": solved(planted, [True, False])})
    task = BlindPnPTask(small_net(8, 1), matching_loss="reprojection")
    alone = reprojection_loss(plan, planted.batch(), solved(planted, [True, True]))[0]
    torch.testing.assert_close(task.losses(prediction, planted.batch()).total.mean(), alone)


def test_learns_from_points_alone() -> None:
    """Neither pairs nor pose are in the batch, and still the angle between matched points falls."""
    torch.manual_seed(0)
    planted = plant(1, 10, seed=2, dtype=torch.float32)
    batch = Batch.from_arrays(planted.points2d, planted.points3d)
    net = small_net(32, centre=True, normalise=True, threshold=0.2, refine=False)
    task = BlindPnPTask(net, matching_loss="reprojection")
    optimiser, losses = torch.optim.Adam(net.parameters(), lr=1e-3), []
    for _ in range(25):
        loss = task.losses(net(batch), batch).total.mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        losses.append(loss.item())
    assert min(losses[-5:]) < 0.8 * losses[0]


def test_the_likelihood_is_what_its_name_says() -> None:
    torch.manual_seed(0)
    batch = plant(2, 9, outliers3d=3, dtype=torch.float32).batch()
    prediction = Matcher(channels=16, depth=1, heads=2).match(batch)
    losses = matching_losses(prediction, batch, kind="likelihood", angle=None)
    torch.testing.assert_close(losses.total, matching_likelihood_loss(prediction, batch))
    assert losses.matched.all()


def test_says_what_is_missing() -> None:
    batch = plant(1, 6).batch()
    with pytest.raises(ValueError, match="expected a solver with an assignment to train, got none"):
        matching_losses(Prediction(), batch, kind="likelihood", angle=None)
    with pytest.raises(ValueError, match="expected pairs with `match3d` for matching_loss correspondence"):
        matching_losses(
            Prediction(plant(1, 6).permutation()), replace(batch, match3d=None), kind="correspondence", angle=None
        )
    with pytest.raises(ValueError, match="with matching_loss correspondence, got likelihood"):
        BlindPnPTask(matching_loss="likelihood", correspondence_angle=0.1)
