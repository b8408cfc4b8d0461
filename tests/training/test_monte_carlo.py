"""The Monte Carlo pose loss: a density that integrates to one, Laplace's integral, finite differences, and laws."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from planted import Planted, padded, plant, posed
from scipy.integrate import quad
from scipy.spatial.transform import Rotation
from scipy.stats import multivariate_t
from torch import Tensor

from bpnp import Batch, Prediction
from bpnp.geometry import retract
from bpnp.layers import weighted_pnp
from bpnp.training import MonteCarloPoseLoss
from bpnp.training.monte_carlo import (
    Proposal,
    Samples,
    log_measure,
    log_weight,
    negative_log_likelihood,
    weighted_bearings,
)


def solved(planted: Planted, assignment: Tensor) -> Prediction:
    rotation, translation, _ = weighted_pnp(assignment, planted.bearings, planted.points3d, *planted.pose)
    return Prediction(assignment, poses={"pnp": posed(rotation, translation)})


def value(loss: MonteCarloPoseLoss, prediction: Prediction, batch: Batch) -> Tensor:
    return loss(prediction, batch)["monte_carlo"]


def test_the_volume_of_rotations_is_that_of_so3() -> None:
    """8 pi^2 with the measure that is that of rotation vectors at the identity."""
    shell = quad(lambda a: 4 * math.pi * a**2 * math.exp(float(log_measure(torch.tensor([a, 0.0, 0.0])))), 0, math.pi)
    assert shell[0] == pytest.approx(8 * math.pi**2, rel=1e-5)


def test_the_density_of_a_proposal_is_scipys_and_its_steps_have_its_quartiles() -> None:
    root = torch.randn(6, 6, generator=torch.Generator().manual_seed(0), dtype=torch.float64).tril()
    root.diagonal().abs_().add_(0.3)
    mean = torch.arange(6.0, dtype=torch.float64)
    proposal = Proposal(mean[None], root[None])
    numbers = torch.randn(1, 4000, 9, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    steps = proposal.draw(numbers)
    theirs = multivariate_t(mean.numpy(), (root @ root.mT).numpy(), df=3)
    np.testing.assert_allclose(proposal.log_density(steps)[0], theirs.logpdf(steps[0].numpy()), rtol=1e-9)
    drawn = theirs.rvs(4000, random_state=np.random.default_rng(0))
    for quarter in (0.25, 0.5, 0.75):
        np.testing.assert_allclose(np.quantile(steps[0], quarter, 0), np.quantile(drawn, quarter, 0), atol=0.15)


def test_the_density_integrates_to_one() -> None:
    """Over uniform rotations, by scipy, and translations in the ball that it is a density of."""
    planted, rng = plant(1, 12, seed=2), np.random.default_rng(0)
    loss = MonteCarloPoseLoss(width=0.7, samples=4000, rounds=3)
    kappa = 12 / 0.7**2
    weighted = kappa * weighted_bearings(planted.permutation(), planted.batch())
    points = planted.points3d - planted.points3d.mean(1, keepdim=True)
    rotation, translation = planted.rotation, (planted.rotation @ planted.points3d.mean(1)[..., None])[..., 0]
    translation = translation + planted.translation
    limit = torch.tensor([2.0], dtype=torch.float64)
    samples = loss.draw(weighted, points, rotation, translation, rotation, translation, limit)
    count = 100_000
    turns = torch.from_numpy(Rotation.random(count, rng=rng).as_matrix())
    ways = rng.normal(size=(count, 3))
    ways *= (2.0 * rng.uniform(size=(count, 1)) ** (1 / 3)) / np.linalg.norm(ways, axis=1, keepdims=True)
    shifts = translation + torch.from_numpy(ways)
    constant = negative_log_likelihood(weighted, points, rotation, translation, samples) + log_weight(
        weighted, points, rotation[:, None], translation[:, None]
    ).squeeze(1)
    density = (log_weight(weighted, points, turns[None], shifts[None]) - constant[:, None]).exp()[0]
    volume = 8 * math.pi**2 * 4 / 3 * math.pi * 2.0**3
    error = float(volume * density.std() / count**0.5)
    assert error < 0.05
    assert float(volume * density.mean()) == pytest.approx(1, abs=3 * error + 0.03)


def test_a_narrow_density_has_the_integral_of_laplace() -> None:
    """-log p = E(true) - E(best) + 3 log 2 pi - log det(H) / 2, with the Hessian by differences."""
    planted = plant(2, 25, noise=0.001, seed=3)
    assignment = planted.diffuse(0.01)
    prediction, batch, width = solved(planted, assignment), planted.batch(), 2e-3
    found = value(MonteCarloPoseLoss(width=width, samples=500), prediction, batch)
    best = prediction.poses["pnp"]
    weighted = 25 / width**2 * weighted_bearings(assignment, batch)
    for k in range(2):

        def energy(step: Tensor, pose: tuple[Tensor, Tensor], k: int = k) -> Tensor:
            rotation, translation = retract(step, *pose)
            return -log_weight(weighted[k : k + 1], planted.points3d[k : k + 1], rotation[None, None],
                               translation[None, None])[0, 0]  # fmt: skip

        zero, at = torch.zeros(6, dtype=torch.float64), (best.rotation[k], best.translation[k])
        step, four = 1e-4 * torch.eye(6, dtype=torch.float64), ((1, 1), (1, -1), (-1, 1), (-1, -1))
        hessian = torch.tensor([
            [sum(u * v * energy(u * a + v * b, at) for u, v in four) / 4e-8 for b in step] for a in step
        ])  # fmt: skip
        expected = energy(zero, (planted.rotation[k], planted.translation[k])) - energy(zero, at)
        expected = expected + 3 * math.log(2 * math.pi) - torch.logdet(hessian) / 2
        assert float(found[k]) == pytest.approx(float(expected), abs=0.05)


def test_the_gradient_is_that_of_finite_differences(monkeypatch: pytest.MonkeyPatch) -> None:
    """With the same samples: no gradient goes through their choice."""
    planted = plant(1, 6, outliers2d=2, outliers3d=1, seed=4)
    batch, loss, at = planted.batch(), MonteCarloPoseLoss(width=0.1, samples=16, rounds=2), planted.diffuse(0.2)
    prediction = solved(planted, at)
    kept: list[Samples] = []
    draw = loss.draw
    monkeypatch.setattr(loss, "draw", lambda *given: kept.append(draw(*given)) or kept[0])
    value(loss, prediction, batch)
    assert torch.autograd.gradcheck(
        lambda p: value(loss, replace(prediction, assignment=p), batch), at.clone().requires_grad_()
    )


def test_the_loss_follows_the_unit_of_the_scene_and_not_its_frame() -> None:
    """Translations twice as large have an eighth of the density; another frame and origin change nothing."""
    planted = plant(1, 15, noise=0.002, seed=5)
    assignment, loss = planted.diffuse(0.03), MonteCarloPoseLoss(samples=2000)
    first = value(loss, solved(planted, assignment), planted.batch())
    larger = replace(planted, points3d=2 * planted.points3d, translation=2 * planted.translation)
    twice = value(loss, solved(larger, assignment), larger.batch())
    assert float(twice - first) == pytest.approx(3 * math.log(2), abs=0.02)
    turn = torch.from_numpy(Rotation.from_rotvec([0.3, -1.0, 0.5]).as_matrix())
    origin = torch.tensor([3.0, -2.0, 5.0], dtype=torch.float64)
    rotation = planted.rotation @ turn.mT
    moved = replace(
        planted, points3d=planted.points3d @ turn.mT + origin, rotation=rotation,
        translation=planted.translation - (rotation @ origin),
    )  # fmt: skip
    assert float(value(loss, solved(moved, assignment), moved.batch()) - first) == pytest.approx(0, abs=0.03)


def test_padding_and_other_samples_do_not_matter_and_a_sample_without_a_pose_has_none() -> None:
    scenes = [plant(1, 9, seed=6), plant(1, 6, seed=7)]
    batch, loss = padded(scenes), MonteCarloPoseLoss(samples=16)
    mass = torch.rand(2, 9, 9, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    near = [scene.near(0.05) for scene in scenes]
    pose = posed(*(torch.cat(parts) for parts in zip(*near, strict=True)))
    both = value(loss, Prediction(mass, poses={"pnp": pose}), batch)
    alone = value(loss, Prediction(mass[1:, :6, :6], poses={"pnp": posed(*near[1])}), scenes[1].batch())
    torch.testing.assert_close(both[1:], alone, rtol=1e-5, atol=1e-5)  # the padded batch is in float64 too
    pose.rotation[0] = torch.nan
    missing = replace(pose, stats=replace(pose.stats, converged=torch.tensor([False, True])))
    mass.requires_grad_()
    found = value(loss, Prediction(mass, poses={"pnp": missing}), batch)
    assert found.isnan().tolist() == [True, False]
    (slope,) = torch.autograd.grad(found[1], mass)
    assert not slope[0].any()
    assert slope[1, :6, :6].isfinite().all()


def test_an_assignment_with_more_mass_on_true_matches_is_likelier() -> None:
    planted = plant(4, 20, noise=0.003, seed=8)
    loss, losses = MonteCarloPoseLoss(), []
    for mixed in (0.6, 0.3, 0.0):
        assignment = (1 - mixed) * planted.permutation() + mixed / 400
        losses.append(float(value(loss, solved(planted, assignment), planted.batch()).mean()))
    assert losses == sorted(losses, reverse=True)


def test_a_solver_without_an_assignment_is_one_error() -> None:
    planted = plant(1, 6)
    with pytest.raises(ValueError, match="the solver returns no assignment"):
        MonteCarloPoseLoss()(Prediction(poses={"pnp": posed(*planted.pose)}), planted.batch())
