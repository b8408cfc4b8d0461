"""Rounds of matching again under a pose, and refinement."""

import torch
from planted import Planted, plant, posed
from torch import Tensor

from bpnp import Prediction
from bpnp.layers import RansacPnP, Sinkhorn, WeightedPnP, sinkhorn
from bpnp.metrics import rotation_error
from bpnp.models.evaluation import match_again, pnp_pose, round_widths

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
