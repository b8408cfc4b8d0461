import itertools

import pytest
import torch
from planted import padded, plant, posed
from small_data import small_net
from torch import Tensor

from bpnp import Batch, BPnPNet, Prediction
from bpnp.layers import RansacPnP, sinkhorn
from bpnp.metrics import rotation_error
from bpnp.models import Refinement
from bpnp.models.nets import PointFeatures
from bpnp.models.pose_stages import round_widths
from bpnp.report.results import rows_from
from bpnp.search.propose.density_map import COPIES
from bpnp.training.losses import correspondence_loss, pose_terms


def different_sizes(*sizes: int, dtype: torch.dtype = torch.float64) -> Batch:
    return padded([plant(1, n, outliers2d=n // 4, seed=n, dtype=dtype) for n in sizes])


@pytest.fixture(scope="module")
def overfitted() -> tuple[BPnPNet, Batch, list[float]]:
    """A small net after a few dozen steps of the correspondence loss on one pair."""
    torch.manual_seed(0)
    net = small_net(32, 4, centre=True, normalise=True, threshold=0.02)
    batch = plant(1, 14, seed=5, dtype=torch.float32).batch()
    assert batch.match3d is not None
    optimiser = torch.optim.Adam(net.parameters(), lr=2e-3)
    losses = []
    for _ in range(50):
        loss = correspondence_loss(net.match(batch).assignment, batch.match3d).mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        losses.append(loss.item())
    return net.eval(), batch, losses


def test_bpnpnet_returns_an_assignment_and_all_poses() -> None:
    batch = different_sizes(12, 20, dtype=torch.float32)
    prediction = (net := small_net()).eval()(batch)
    assert prediction.assignment.shape == (2, 25, 20)
    assert prediction.assignment_stats.converged.all()
    assert tuple(prediction.poses) == net.estimates == ("ransac", "pnp", "refined")
    for pose in prediction.poses.values():
        assert (pose.rotation.shape, pose.translation.shape) == ((2, 3, 3), (2, 3))
        assert pose.rotation.dtype == torch.float32
    torch.testing.assert_close(prediction.assignment.sum((-2, -1)), torch.ones(2))
    assert not prediction.assignment[~(batch.mask2d.unsqueeze(-1) & batch.mask3d.unsqueeze(1))].any()


def test_refinement_runs_only_in_evaluation_and_only_if_enabled() -> None:
    batch = different_sizes(12, 20, dtype=torch.float32)
    assert tuple(small_net().train()(batch).poses) == ("ransac", "pnp")
    without = small_net(refine=False).eval()
    assert tuple(without(batch).poses) == without.estimates == ("ransac", "pnp")


def test_refinement_of_exact_problems_converges() -> None:
    """Exact problems with the true matches: the pose is right, and a report must not call it unconverged."""
    batch = different_sizes(30, dtype=torch.float32)
    pose = small_net().eval()(batch).poses["refined"]
    assert bool((rotation_error(pose.rotation, batch.rotation) < 1).all())
    assert pose.stats.converged.all()


def test_refinement_starts_from_hypotheses_too_unless_there_are_none() -> None:
    batch = different_sizes(30, dtype=torch.float32)
    torch.manual_seed(0)
    net = small_net().eval()
    crowd = net(batch).poses["refined"].stats.iterations
    net.refinement.hypotheses = 0
    alone = net(batch).poses["refined"].stats.iterations
    assert int(alone) <= 2 * (1 + COPIES) < int(crowd)
    with pytest.raises(ValueError, match="`hypotheses` is -1; it must be 0 or more"):
        Refinement(hypotheses=-1)


def test_refinement_without_hypotheses_needs_no_assignment() -> None:
    """A pose of a solver without an assignment, 0.05 radians off, is refined to the planted one."""
    planted = plant(1, 30, outliers2d=5, seed=4)
    prediction = Refinement(hypotheses=0)(Prediction(poses={"given": posed(*planted.near(0.05))}), planted.batch())
    assert float(rotation_error(prediction.poses["refined"].rotation, planted.rotation)) < 0.1


@pytest.mark.parametrize("rounds", [1, 2, 5])
def test_the_last_of_any_number_of_rounds_has_the_width_of_ransac(rounds: int) -> None:
    widths = round_widths(rounds, RansacPnP(threshold=0.02))
    assert len(widths) == rounds
    assert widths[-1] == pytest.approx(0.02)
    ratios = [width / following for width, following in itertools.pairwise(widths)]
    assert all(ratio == pytest.approx(ratios[0]) and ratio > 1 for ratio in ratios)


def test_the_cost_is_the_distance_between_unit_features() -> None:
    net = small_net(scale=2.0).eval().double()
    batch = different_sizes(9)
    z2d = PointFeatures.forward(net.features2d, 2 * batch.points2d, batch.mask2d)
    aligned = net.features3d.align(batch.points3d, batch.mask3d)
    z3d = PointFeatures.forward(net.features3d, aligned, batch.mask3d)
    torch.testing.assert_close(net.cost(batch), torch.cdist(z2d, z3d), atol=1e-7, rtol=0)


def test_bpnpnet_overfits_one_problem(overfitted: tuple[BPnPNet, Batch, list[float]]) -> None:
    net, batch, losses = overfitted
    assert losses[0] > 0.6
    assert losses[-1] < -0.8
    prediction = net(batch)
    for pose in prediction.poses.values():
        assert pose.stats.converged.all()
    found = prediction.poses["ransac"]
    assert sum(pose_terms(found.rotation, found.translation, batch.rotation, batch.translation).values()).max() < 0.1


def first_layers(net: BPnPNet) -> list[Tensor]:
    weights = (net.features2d.enter.weight, net.features3d.enter.weight, net.features3d.align.linears[0].weight)
    return [w.grad for w in weights if w.grad is not None]


def test_the_pose_loss_reaches_the_first_layers(overfitted: tuple[BPnPNet, Batch, list[float]]) -> None:
    """And a step against its gradient lowers it."""
    net, batch, _ = overfitted
    net.zero_grad()

    def loss() -> Tensor:
        pose = net(batch).poses["pnp"]
        assert pose.stats.converged.all()
        return sum(pose_terms(pose.rotation, pose.translation, batch.rotation, batch.translation).values()).mean()

    before = loss()
    before.backward()
    gradients = [p.grad for p in net.parameters() if p.grad is not None]
    assert len(first_layers(net)) == 3
    assert all(g.isfinite().all() for g in gradients)
    assert all(g.norm() > 1e-6 for g in first_layers(net))
    squared = sum(float((g**2).sum()) for g in gradients)
    saved = {k: v.clone() for k, v in net.state_dict().items()}
    step = 0.05 * before.item() / squared  # to first order, 5 % less
    with torch.no_grad():
        for p in net.parameters():
            if p.grad is not None:
                p -= step * p.grad
    after = loss().item()
    net.load_state_dict(saved)
    assert 0.9 < after / before.item() < 0.99


def test_a_problem_of_three_points_affects_no_other(overfitted: tuple[BPnPNet, Batch, list[float]]) -> None:
    net, batch, _ = overfitted
    tiny = plant(1, 3, dtype=torch.float32)
    both = padded([batch, tiny])
    prediction, alone = net(both), net(batch)
    pose = prediction.poses["pnp"]
    assert pose.stats.converged.tolist() == [True, False]
    assert pose.found.tolist() == [True, False]
    torch.testing.assert_close(pose.rotation[:1], alone.poses["pnp"].rotation, atol=1e-4, rtol=0)
    net.zero_grad()
    losses = sum(pose_terms(pose.rotation, pose.translation, both.rotation, both.translation).values())
    total = torch.where(pose.stats.converged, losses, 0) + correspondence_loss(prediction.assignment, both.match3d)
    total.sum().backward()
    assert all(p.grad.isfinite().all() for p in net.parameters() if p.grad is not None)
    assert all(g.norm() > 0 for g in first_layers(net))


def test_autocast_reaches_the_nets_and_not_the_layers() -> None:
    torch.manual_seed(0)
    net = small_net()
    batch = Batch.from_arrays(torch.rand(2, 30, 2), torch.rand(2, 30, 3))
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert net.features2d.enter(batch.points2d).dtype == torch.bfloat16
        cost = net.cost(batch)
        prediction = net(batch)
    expected, _ = sinkhorn(cost.float())
    assert torch.equal(prediction.assignment, expected)
    assert (prediction.assignment.double().sum(-1) - 1 / 30).abs().sum(-1).max() < 2e-6


def test_each_estimate_has_the_seconds_until_it_was_found() -> None:
    """They rise in the order of the pipeline, a test records them, and training does not measure."""
    net, batch = small_net().eval(), plant(2, 20, dtype=torch.float32).batch()
    with torch.no_grad():
        prediction = net(batch)
    seconds = [prediction.seconds[name] for name in ("ransac", "pnp", "refined")]
    assert 0 < seconds[0] < seconds[1] < seconds[2]
    rows = rows_from(prediction, batch, 100.0)
    assert [row.seconds for row in rows[::2]] == [value / 2 for value in seconds]
    assert net.train()(batch).seconds == {}
