"""Rounds of matching again under a pose, and refinement."""

import math

import pytest
import torch
from planted import Planted, plant, posed
from torch import Tensor

from bpnp import Batch, Pose, Prediction, SolveStats
from bpnp.geometry import is_finite
from bpnp.layers import RansacPnP, Sinkhorn, WeightedPnP, sinkhorn
from bpnp.metrics import rotation_error
from bpnp.models import Refinement, evaluation
from bpnp.models.evaluation import (
    ALONE,
    TRUST,
    WIDTH,
    log_support,
    match_again,
    pnp_pose,
    round_widths,
)

MU = 0.1


def solved(scene: Planted, start: tuple[Tensor, Tensor], cost: Tensor, rounds: int) -> Prediction:
    """The answer of some rounds to an assignment of this cost, when RANSAC finds `start`."""
    batch = scene.batch()
    first = posed(*start)
    assignment, _ = sinkhorn(cost, mu=MU)
    prediction = Prediction(
        assignment, poses={"ransac": first, "pnp": pnp_pose(WeightedPnP(), assignment, batch, first)}
    )
    widths = round_widths(rounds, RansacPnP(threshold=0.003))
    transport = Sinkhorn(mu=MU, tolerance=1e-12)
    return match_again(prediction, cost, batch, transport=transport, pnp=WeightedPnP(), widths=widths)


def test_rounds_find_the_pose_and_the_pairs_from_a_rough_pose_alone() -> None:
    """The features tell nothing: every pair costs the same."""
    scene = plant(4, 150, noise=0.002, seed=3)
    cost = torch.ones(4, 150, 150, dtype=torch.float64)
    errors, masses = [], []
    for rounds in (0, 8):
        prediction = solved(scene, scene.near(0.03), cost, rounds)
        errors.append(rotation_error(prediction.poses["pnp"].rotation, scene.rotation))
        assignment = prediction.assignment if prediction.rematched is None else prediction.rematched
        masses.append((assignment * (scene.permutation() > 0)).sum((1, 2)))
        assert torch.equal(prediction.assignment, sinkhorn(cost, mu=MU)[0])
    assert errors[0].min() > 5
    assert errors[1].max() < 0.3
    assert masses[0].max() < 0.01
    assert masses[1].min() > 0.7


def support(
    plan: Tensor, planted: Planted, rotation: Tensor, translation: Tensor, batch: Batch | None = None
) -> Tensor:
    return log_support(Prediction(plan), batch or planted.batch(), posed(rotation, translation))


def test_is_the_sum_over_bearings_written_out() -> None:
    planted = plant(1, 6, outliers2d=2, outliers3d=1)
    plan = planted.diffuse(0.05)
    found = support(plan, planted, *planted.pose)
    rays = planted.bearings[0]
    area = float(((rays - rays.mean(0)) ** 2).sum(1).mean()) * 2 * math.pi
    total = 0.0
    for i, ray in enumerate(rays):
        inner = 0.0
        for j, p in enumerate(planted.points3d[0]):
            seen = planted.rotation[0] @ p + planted.translation[0]
            chord = float((seen / seen.norm() - ray).norm())
            given = TRUST * float(plan[0, i, j] / plan[0, i].sum()) + (1 - TRUST) / len(planted.points3d[0])
            inner += given * area * math.exp(-(chord**2) / 2 / WIDTH**2) / (2 * math.pi * WIDTH**2)
        total += math.log(ALONE + (1 - ALONE) * inner)
    assert float(found[0]) == pytest.approx(total, rel=1e-7)


def test_a_pose_that_the_assignment_contradicts_gives_way_to_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    """Annealing is made to end at a wrong pose wherever it starts from proposals; the sure sample keeps its pose."""
    planted = plant(2, 40, noise=1e-4)
    refinement, batch = Refinement(), planted.batch()
    wrong, calls = planted.near(2.5), []

    def annealed(_: Batch, rotation: Tensor, translation: Tensor) -> Pose:
        calls.append(rotation.shape[1])
        crowd = rotation.shape[1] > 2
        ends = (torch.stack([planted.rotation[0], wrong[0][1]]), torch.stack([planted.translation[0], wrong[1][1]]))
        turned, shifted = ends if crowd else planted.pose
        missing = ~is_finite(rotation, translation).any(1)
        turned = turned.masked_fill(missing[:, None, None], torch.nan)
        shifted = shifted.masked_fill(missing[:, None], torch.nan)
        return Pose(turned, shifted, SolveStats(torch.full((2,), len(calls)), torch.zeros(2), ~missing))

    monkeypatch.setattr(evaluation, "refine", annealed)
    own = posed(*planted.near(0.02))
    refined = refinement(Prediction(planted.permutation(), poses={"ransac": own, "pnp": own}), batch).poses["refined"]
    assert calls[0] > 2
    assert calls[1] == 2
    torch.testing.assert_close(refined.rotation, planted.rotation)
    torch.testing.assert_close(refined.translation, planted.translation)
    assert refined.stats.iterations.tolist() == [1, 2]
    assert refined.stats.converged.all()
