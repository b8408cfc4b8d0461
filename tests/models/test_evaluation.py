import pytest
import torch
from planted import Planted, padded, plant, posed
from small_data import small_net
from torch import Tensor, nn

from bpnp import BPnPNet, Prediction
from bpnp.geometry import transform
from bpnp.layers import RansacPnP, Sinkhorn, WeightedPnP, sinkhorn
from bpnp.metrics import rotation_error
from bpnp.models.evaluation import (
    FARTHEST,
    FEATURE_WEIGHT,
    cost_under_pose,
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


def test_the_cost_is_a_gaussian_of_the_angle_with_a_floor() -> None:
    scene = plant(2, 5, noise=0.05, seed=1)
    batch, cost = scene.batch(), torch.rand(2, 5, 5, dtype=torch.float64)
    rotation, translation = scene.near(0.1)
    rotation[1] = torch.nan
    found = cost_under_pose(cost, batch, posed(rotation, translation), width=0.05, mu=MU)
    torch.testing.assert_close(found[1], cost[1])
    directions = nn.functional.normalize(transform(rotation, translation, scene.points3d), dim=-1)
    for i in range(5):
        for j in range(5):
            chord = float((scene.bearings[0, i] - directions[0, j]).norm())
            expected = FEATURE_WEIGHT * cost[0, i, j] + MU * min(chord**2 / (2 * 0.05**2), FARTHEST)
            assert float(found[0, i, j]) == pytest.approx(float(expected), rel=1e-9)


def test_widths_fall_to_the_last() -> None:
    assert round_widths(3, RansacPnP(threshold=0.01)) == pytest.approx([0.05, 0.05 / 5**0.5, 0.01])
    assert round_widths(0, nn.Identity()) == []
    with pytest.raises(ValueError, match="expected a `ransac` with a `threshold`, got Identity; try `rounds` 0"):
        BPnPNet(ransac=nn.Identity(), rounds=1)
    with pytest.raises(ValueError, match="expected a number of `rounds`, got -1"):
        BPnPNet(rounds=-1)


def test_a_pair_depends_neither_on_its_batch_nor_on_padding_and_training_has_no_rounds() -> None:
    torch.manual_seed(0)
    net = small_net(rounds=3, threshold=0.05, refine=False).double().eval()
    scenes = [plant(1, n, outliers2d=n // 3, seed=n) for n in (12, 20, 15)]
    joint = net(padded(scenes)).rematched
    for i, scene in enumerate(scenes):
        alone = net(padded([scene])).rematched[0]
        torch.testing.assert_close(joint[i, : alone.shape[0], : alone.shape[1]], alone, rtol=1e-4, atol=1e-9)
        assert (net.match(padded([scene])).assignment[0] - alone).abs().max() > 1e-4
    assert net.train()(padded(scenes)).rematched is None
