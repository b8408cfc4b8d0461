"""Losses against their formulas written out as loops, and what a training step makes of them."""

import math
from dataclasses import replace
from unittest.mock import Mock

import pytest
import torch
from planted import Planted, padded, plant
from scipy.spatial.transform import Rotation
from torch import Tensor, nn

from bpnp import Batch, Prediction
from bpnp.geometry import bearings, within_angle
from bpnp.training.losses import (
    Losses,
    correspondence_loss,
    correspondence_losses,
    matching_likelihood_loss,
    matching_losses,
    own_losses,
    pose_terms,
)
from bpnp.training.task import BlindPnPTask


def random_assignment(planted: Planted, *, seed: int = 0) -> Tensor:
    shape = (*planted.points2d.shape[:2], planted.points3d.shape[1])
    weights = torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return weights / weights.sum((-2, -1), keepdim=True)


def angle(planted: Planted, b: int, i: int, j: int) -> float:
    """Angle of bearing i and 3D point j by the law of cosines, apart from what is tested."""
    f = bearings(planted.points2d[b, i])
    y = planted.rotation[b] @ planted.points3d[b, j] + planted.translation[b]
    return math.acos(max(-1.0, min(1.0, float(f @ y / y.norm()))))


def test_correspondence_loss_is_equation_11_with_a_dense_matrix() -> None:
    planted = plant(4, 9, outliers2d=3, outliers3d=5)
    assignment = random_assignment(planted)
    correct = (planted.permutation() > 0).double()
    expected = (assignment * (1 - 2 * correct)).sum((-2, -1))
    torch.testing.assert_close(correspondence_loss(assignment, planted.match3d), expected)


@pytest.mark.parametrize("threshold", [0.003, 0.03, 0.3])
def test_correspondence_loss_from_the_pose_is_equation_11_by_a_loop(threshold: float) -> None:
    planted = plant(2, 12, noise=0.01, outliers2d=3)
    assignment = random_assignment(planted)
    within = within_angle(planted.points2d, planted.points3d, *planted.pose, threshold)
    found = correspondence_losses(Prediction(assignment), planted.batch(), angle=threshold)
    assert found is not None
    for b in range(2):
        expected = 0.0
        for i, j in torch.cartesian_prod(torch.arange(15), torch.arange(12)).tolist():
            close = angle(planted, b, i, j) <= threshold
            assert bool(within[b, i, j]) == close
            expected += float(assignment[b, i, j]) * (1 - 2 * close)
        assert abs(float(found[b]) - expected) < 1e-12
    assert 0 < within.sum() < within.numel()


def test_a_point_is_within_its_own_angle_and_not_within_less() -> None:
    planted = plant(1, 6, noise=0.1)
    points = planted.points2d, planted.points3d, *planted.pose
    for i, j in torch.cartesian_prod(torch.arange(6), torch.arange(6)).tolist():
        exact = angle(planted, 0, i, j)
        assert within_angle(*points, exact * (1 + 1e-7))[0, i, j]
        assert not within_angle(*points, exact * (1 - 1e-7))[0, i, j]


class Mass(nn.Module):
    """A user's loss: -log of the mass on the true matches, NaN where it is below a quarter."""

    def forward(self, prediction: Prediction, batch: Batch) -> Tensor:
        assert prediction.assignment is not None
        assert batch.match3d is not None
        mass = prediction.assignment.gather(1, batch.match3d[:, None]).sum((1, 2))
        return torch.where(mass < 0.25, torch.nan, -mass.log())


def test_the_loss_of_a_user_is_the_mean_over_the_samples_that_have_one() -> None:
    planted = plant(3, 8)
    masses = torch.tensor([0.8, 0.1, 0.4], dtype=torch.float64)[:, None, None]
    assignment = (masses * planted.permutation()).requires_grad_()
    losses = own_losses(Mass(), Prediction(assignment), planted.batch())
    assert losses.matched.tolist() == [True, False, True]
    assert losses.total.item() == pytest.approx(-(math.log(0.8) + math.log(0.4)) / 2)
    losses.total.backward()
    assert assignment.grad is not None
    assert assignment.grad.amin((1, 2)).tolist() == pytest.approx([-1 / (2 * 0.8), 0, -1 / (2 * 0.4)])


@pytest.mark.parametrize(
    ("found", "message"),
    [
        (torch.zeros(()), r"returned shape \(\); a tensor of shape \(2,\) is needed"),
        (torch.zeros(2, 1), r"returned shape \(2, 1\); a tensor"),
        (0.5, "returned float; a tensor"),
    ],
    ids=["scalar", "column", "number"],
)
def test_a_loss_of_a_user_has_one_value_per_problem(found: object, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        own_losses(Mock(nn.Module, return_value=found), Prediction(), plant(2, 6).batch())


def test_a_batch_without_any_pose_has_no_pose_loss() -> None:
    matching, none = torch.tensor([0.5, -0.1]), torch.zeros(2, dtype=torch.bool)
    losses = Losses(matching, ~none, {"rotation": torch.zeros(2)}, none, 2.0)
    assert losses.pose_means() == {"rotation": 0.0}
    assert losses.total.item() == pytest.approx(0.2)


def test_the_mean_over_processes_is_the_loss_of_the_whole_batch(monkeypatch: pytest.MonkeyPatch) -> None:
    """Also its gradient, where the processes have other numbers of samples with a loss, or none."""
    values = torch.tensor([0.3, 0.0, 0.5, 0.2, 0.9, 0.4], requires_grad=True)
    matched = torch.tensor([True, False, True, True, True, True])
    posed = torch.tensor([False, False, False, True, True, False])

    def losses(part: slice) -> Losses:
        kept = values[part]
        return Losses(kept * matched[part], matched[part], {"rotation": kept**2 * posed[part]}, posed[part], 2.0)

    whole = losses(slice(0, 6)).total
    halves = [losses(slice(0, 3)), losses(slice(3, 6))]
    numbers = sum(torch.tensor([int(half.matched.sum()), int(half.posed.sum()), 3]) for half in halves)
    monkeypatch.setattr("torch.distributed.is_initialized", lambda: True)
    monkeypatch.setattr("torch.distributed.get_world_size", lambda: 2)
    monkeypatch.setattr("torch.distributed.all_reduce", lambda counts: counts.copy_(numbers))
    mean = sum(half.over_processes().total for half in halves) / 2
    torch.testing.assert_close(mean, whole)
    means = [half.over_processes().matching_mean for half in halves]
    torch.testing.assert_close(sum(means) / 2, losses(slice(0, 6)).matching_mean)
    torch.testing.assert_close(*(torch.autograd.grad(loss, values)[0] for loss in (mean, whole)))


def test_pose_loss_is_scipys_angle_and_the_distance() -> None:
    planted = plant(50, 4)
    rotation, translation = planted.near(0.7)
    found = sum(pose_terms(rotation, translation, *planted.pose).values())
    turn = Rotation.from_matrix(planted.rotation.numpy()).inv() * Rotation.from_matrix(rotation.numpy())
    distance = (translation - planted.translation).pow(2).sum(-1).sqrt()
    assert (found - torch.from_numpy(turn.magnitude()) - distance).abs().max() < 1e-12


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_gradients_are_finite_at_the_truth(dtype: torch.dtype) -> None:
    planted = plant(3, 6, dtype=dtype)
    rotation, translation = (x.clone().requires_grad_() for x in planted.pose)
    loss = sum(pose_terms(rotation, translation, *planted.pose).values())
    assert loss.max() < 1e-2
    loss.sum().backward()
    assert all(x.grad is not None and x.grad.isfinite().all() for x in (rotation, translation))


def _with_bins(planted: Planted, *, seed: int = 0) -> tuple[Prediction, Batch]:
    """A random plan with bins, as nested lists would have it: rows and columns of one total mass."""
    b, m, n = len(planted.points2d), planted.points2d.shape[1], planted.points3d.shape[1]
    plan = torch.rand(b, m + 1, n + 1, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    plan = plan / plan.sum((-2, -1), keepdim=True)
    prediction = Prediction(plan[:, :-1, :-1], unmatched2d=plan[:, :-1, -1], unmatched3d=plan[:, -1, :-1])
    return prediction, planted.batch()


def test_matching_likelihood_loss_is_the_sum_over_points_written_out() -> None:
    planted = plant(3, 6, outliers2d=2, outliers3d=4)
    prediction, batch = _with_bins(planted)
    losses = matching_likelihood_loss(prediction, batch)
    for b in range(3):
        p, left2d, left3d = prediction.assignment[b], prediction.unmatched2d[b], prediction.unmatched3d[b]
        partner = planted.match3d[b].tolist()
        paired, alone = [], []
        for j, i in enumerate(partner):
            to_j = float(p[:, j].sum() + left3d[j])
            if i < 0:
                alone.append(-math.log(float(left3d[j]) / to_j))
                continue
            to_i = float(p[i].sum() + left2d[i])
            paired.append(-math.log(float(p[i, j]) / to_j))
            paired.append(-math.log(float(p[i, j]) / to_i))
        for i in set(range(p.shape[0])) - set(partner):
            alone.append(-math.log(float(left2d[i] / (p[i].sum() + left2d[i]))))
        assert float(losses[b]) == pytest.approx(sum(paired) / len(paired) + sum(alone) / len(alone))


def test_an_image_point_with_two_scene_points_is_not_alone() -> None:
    """Points 0 and 1 of the scene are seen as image point 0: the points alone are image point 1 and scene point 2."""
    planted = plant(1, 3)
    points = planted.points2d[0, :2], planted.points3d[0]
    batch = Batch.from_arrays(*points, match3d=torch.tensor([0, 0, -1]))
    torch.manual_seed(0)
    mass = torch.rand(1, 3, 4, dtype=torch.float64)
    inner, left2d, left3d = mass[:, :2, :3], mass[:, :2, 3], mass[:, 2, :3]
    left2d.requires_grad_()
    loss = matching_likelihood_loss(Prediction(inner, unmatched2d=left2d, unmatched3d=left3d), batch)
    rows, cols = (inner.sum(2) + left2d)[0].tolist(), (inner.sum(1) + left3d)[0].tolist()
    pairs = [math.log(float(inner[0, 0, j]) / cols[j]) + math.log(float(inner[0, 0, j]) / rows[0]) for j in (0, 1)]
    alone = [math.log(float(left2d[0, 1]) / rows[1]), math.log(float(left3d[0, 2]) / cols[2])]
    assert loss.item() == pytest.approx(-sum(pairs) / 4 - sum(alone) / 2, rel=1e-12)
    (slope,) = torch.autograd.grad(loss.sum(), left2d)
    assert slope[0, 1] < 0  # more mass in the bin of a point that is alone is better
    assert slope[0, 0] > 0  # and worse in that of a point with matches


def test_matching_likelihood_loss_ignores_padding_and_has_its_derivative() -> None:
    alone = plant(1, 5, outliers3d=2)
    prediction, batch = _with_bins(alone)
    both = padded([alone, plant(1, 9, outliers3d=1)])
    pad = torch.nn.functional.pad
    plan, left2d, left3d = prediction.assignment, prediction.unmatched2d, prediction.unmatched3d
    wide = pad(plan, (0, 3, 0, 4)), pad(left2d, (0, 4)), pad(left3d, (0, 3))
    assignment, unmatched2d, unmatched3d = (torch.cat([x, torch.full_like(x, 0.01)]) for x in wide)
    grown = Prediction(assignment, unmatched2d=unmatched2d, unmatched3d=unmatched3d)
    torch.testing.assert_close(matching_likelihood_loss(grown, both)[:1], matching_likelihood_loss(prediction, batch))

    def loss(p: Tensor, left2d: Tensor, left3d: Tensor) -> Tensor:
        return matching_likelihood_loss(Prediction(p, unmatched2d=left2d, unmatched3d=left3d), batch)

    assert torch.autograd.gradcheck(loss, tuple(x.clone().requires_grad_() for x in (plan, left2d, left3d)))


def test_a_loss_without_its_labels_names_what_is_missing() -> None:
    batch = plant(1, 6).batch()
    with pytest.raises(ValueError, match="returns no assignment to train"):
        matching_losses(Prediction(), batch, kind="likelihood", angle=None)
    with pytest.raises(ValueError, match="matching_loss correspondence needs problems with `match3d`"):
        matching_losses(
            Prediction(plant(1, 6).permutation()), replace(batch, match3d=None), kind="correspondence", angle=None
        )
    with pytest.raises(ValueError, match="for the matching loss correspondence, not for likelihood"):
        BlindPnPTask(matching_loss="likelihood", correspondence_angle=0.1)


@pytest.mark.parametrize("angle", [10.0, 1.0, 0.0, -0.1, math.nan])
def test_an_angle_that_is_not_in_radians_is_refused(angle: float) -> None:
    with pytest.raises(ValueError, match="correspondence_angle is .* radians .*above 0 and at most 0.5"):
        BlindPnPTask(correspondence_angle=angle)


def test_an_improbable_true_match_has_the_derivative_of_its_logarithm() -> None:
    """dL/dP = -2 / (2 n P) for n true matches, and a little for the sums of its row and column."""
    n, smallest = 5, 1e-20
    batch = plant(1, n).batch()
    assert batch.match3d is not None
    planted = torch.full((1, n, n), 0.04).scatter_(1, batch.match3d[:, None], smallest).requires_grad_()
    matching_likelihood_loss(Prediction(planted), batch).sum().backward()
    assert planted.grad is not None
    found = planted.grad.gather(1, batch.match3d[:, None])
    assert found.flatten().tolist() == pytest.approx([-1 / (n * smallest)] * n, rel=1e-5)


@pytest.mark.parametrize("probability", [0.0, 1e-45, 1e-38, 1e-31, 1e-29])
def test_the_gradient_of_the_likelihood_is_finite_however_small_the_probability(probability: float) -> None:
    """A loss scale of 2^16, that of training in half precision, included."""
    batch = plant(1, 5, outliers3d=1).batch()
    assert batch.match3d is not None
    assignment = torch.full((1, 5, 6), 0.03)
    j = int((batch.match3d[0] >= 0).nonzero()[0])
    assignment[0, int(batch.match3d[0, j]), j] = probability
    assignment.requires_grad_()
    bins = torch.zeros(1, 5), torch.zeros(1, 6)
    loss = matching_likelihood_loss(Prediction(assignment, unmatched2d=bins[0], unmatched3d=bins[1]), batch)
    (2**16 * loss).sum().backward()
    assert loss.isfinite().all()
    assert assignment.grad is not None
    assert assignment.grad.isfinite().all()
    assert assignment.grad.any()
