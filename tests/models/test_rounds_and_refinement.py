"""Rounds of matching and the choice of the refinement: their formulas written out, and planted poses."""

import math
from typing import Any

import numpy as np
import pytest
import torch
from planted import padded, plant, posed
from torch import Tensor

import bpnp.models.refinement
from bpnp import Batch, Pose, Prediction
from bpnp.geometry import choose, rotation_angle
from bpnp.layers import Sinkhorn, WeightedPnP
from bpnp.models import Refinement
from bpnp.models.pose_stages import cost_under_pose, match_again
from bpnp.models.refinement import log_support


def chord(batch: Batch, pose: Pose, b: int, i: int, j: int) -> float:
    """Distance of bearing i from the direction of scene point j, by numpy."""
    ray = np.append(batch.points2d[b, i].numpy(), 1.0)
    camera = pose.rotation[b].numpy() @ batch.points3d[b, j].numpy() + pose.translation[b].numpy()
    return float(np.linalg.norm(ray / np.linalg.norm(ray) - camera / np.linalg.norm(camera)))


def sizes() -> Batch:
    return padded([plant(1, 9, seed=1), plant(1, 6, outliers2d=2, outliers3d=1, seed=2)])


def test_the_cost_of_a_round_is_the_features_and_a_limited_residual() -> None:
    """0.03 M + mu min(r^2 / (2 s^2), 12), and M where there is no pose."""
    batch, cost = sizes(), torch.rand(2, 9, 9, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    assert batch.rotation is not None
    pose = posed(batch.rotation.clone(), batch.translation + 0.1)
    pose.rotation[1] = torch.nan
    found = cost_under_pose(cost, batch, pose, width=0.02, mu=0.3)
    energies = [chord(batch, pose, 0, i, j) ** 2 / (2 * 0.02**2) for i in range(9) for j in range(9)]
    assert min(energies) < 12 < max(energies)
    expected = 0.03 * cost[0].flatten() + 0.3 * torch.tensor(energies).clamp(max=12)
    torch.testing.assert_close(found[0].flatten(), expected)
    assert torch.equal(found[1], cost[1])


@pytest.mark.parametrize("bins", [False, True])
def test_the_support_of_a_pose_is_the_likelihood_ratio_of_the_bearings(bins: bool) -> None:
    """By loops over the real points, for a pose near the truth; -inf without a pose."""
    batch, generator = sizes(), torch.Generator().manual_seed(0)
    assert batch.rotation is not None
    real = batch.mask2d[:, :, None] & batch.mask3d[:, None]
    p = torch.rand(2, 9, 9, generator=generator, dtype=torch.float64) * real
    left = torch.rand(2, 9, generator=generator, dtype=torch.float64) * batch.mask2d
    prediction = Prediction(p, unmatched2d=left if bins else None)
    pose = posed(batch.rotation, batch.translation + 0.02)
    batch.points2d[1, 0] = pose.translation[1, :2] / pose.translation[1, 2]  # where padded scene points would be seen
    found = log_support(prediction, batch, pose)
    for b, (m, n) in enumerate(((9, 9), (8, 7))):
        rays = np.column_stack([batch.points2d[b, :m].numpy(), np.ones(m)])
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        variance = ((rays - rays.mean(0)) ** 2).sum(1).mean()
        total = 0.0
        for i in range(m):
            mass = float(p[b, i].sum() + (left[b, i] if bins else 0))
            density = [variance / 0.01**2 * math.exp(-(chord(batch, pose, b, i, j) ** 2) / 2e-4) for j in range(n)]
            total += math.log(
                0.2 + 0.8 * sum((0.7 * float(p[b, i, j]) / mass + 0.3 / n) * density[j] for j in range(n))
            )
        assert float(found[b]) == pytest.approx(total, rel=1e-6)
    missing = posed(batch.rotation * torch.nan, batch.translation)
    assert log_support(prediction, batch, missing).tolist() == [-math.inf] * 2


def test_rounds_find_the_matches_that_no_feature_tells_apart() -> None:
    """From a pose 0.02 radians off: all costs are equal, so that the pose alone decides."""
    batch = plant(2, 20, seed=3).batch().to(torch.float64)
    assert batch.rotation is not None
    start = posed(*plant(2, 20, seed=3).near(0.02))
    prediction = Prediction(torch.full((2, 20, 20), 1 / 400), poses={"ransac": start, "pnp": start})
    cost = torch.ones(2, 20, 20, dtype=torch.float64)
    layers: dict[str, Any] = {"transport": Sinkhorn(), "pnp": WeightedPnP()}
    found = match_again(prediction, cost, batch, **layers, widths=[0.05, 0.01, 0.002])
    assert found.rematched is not None
    assert batch.match3d is not None
    assert (found.rematched.argmax(1) == batch.match3d).double().mean() > 0.9
    assert rotation_angle(found.poses["pnp"].rotation, batch.rotation).max() < 0.005
    assert found.poses["ransac"] is start
    one = match_again(prediction, cost, batch, **layers, widths=[0.05])
    assert rotation_angle(one.poses["pnp"].rotation, batch.rotation).max() > 0.005
    assert match_again(prediction, cost, batch, **layers, widths=[]) is prediction


def test_an_unsupported_refined_pose_gives_way_to_a_supported_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """The assignment is that of the planted pose, and the first search ends elsewhere in all samples but the first.

    The second search, from the poses of the network, finds it in the first two samples.
    """
    planted = plant(3, 20, seed=4)
    batch, wrong = planted.batch(), (planted.near(1.0), planted.near(2.0))
    results: list[tuple[Tensor, Tensor]] = []

    def refined(batch: Batch, rotation: Tensor, translation: Tensor) -> Pose:
        results.append((rotation, translation))
        right = torch.tensor([True, len(results) == 2, False])
        pairs = zip(planted.pose, wrong[len(results) - 1], strict=True)
        return posed(*(choose(right, true, other) for true, other in pairs))

    monkeypatch.setattr(bpnp.models.refinement, "refine", refined)
    network = posed(*planted.near(0.01))
    prediction = Prediction(planted.permutation(), poses={"pnp": network})
    found = Refinement(hypotheses=3)(prediction, batch).poses["refined"]
    assert rotation_angle(found.rotation, planted.rotation).tolist() == pytest.approx([0, 0, 1], abs=1e-6)
    assert [rotation.shape[1] for rotation, _ in results] == [4, 1]
    assert results[1][1].isnan().all(-1).flatten().tolist() == [True, False, False]
