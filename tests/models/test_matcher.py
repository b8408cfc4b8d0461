from dataclasses import replace

import pytest
import torch
from planted import padded, plant
from small_data import small_matcher

from bpnp import Batch
from bpnp.models import Matcher
from bpnp.models.matcher import image_of
from bpnp.models.nets import Attention, Neighbourhood
from bpnp.training.losses import matching_likelihood_loss


def cluttered(*sizes: int) -> Batch:
    """Pairs with a third of clutter on each side, padded to the largest."""
    return padded([plant(1, n, outliers2d=n // 3, outliers3d=n // 3 + 1, seed=n) for n in sizes])


def test_the_mass_of_each_point_is_split_between_matches_and_its_dustbin() -> None:
    batch = cluttered(9, 21)
    prediction = small_matcher().match(batch)
    total = (batch.count2d + batch.count3d).unsqueeze(-1).double()
    torch.testing.assert_close(prediction.assignment.sum(2) + prediction.unmatched2d, batch.mask2d / total)
    torch.testing.assert_close(prediction.assignment.sum(1) + prediction.unmatched3d, batch.mask3d / total)


def test_points_behind_a_view_lie_at_the_edge_of_its_image() -> None:
    points = torch.tensor([[1.0, -2.0, 4.0], [30.0, 40.0, 1.0], [3.0, 4.0, -5.0], [0.0, 0.0, -1.0]])
    expected = torch.tensor([[0.25, -0.5], [2.4, 3.2], [2.4, 3.2], [0.0, 0.0]])
    torch.testing.assert_close(image_of(points[None])[0], expected)


def test_features_of_each_side_depend_on_the_other() -> None:
    """Unlike those of BPnPNet, the features of the image change with the scene."""
    net, batch = small_matcher(), cluttered(12)
    other = replace(batch, points3d=batch.points3d.flip(-1) ** 3)
    assert (net.features(other)[0] - net.features(batch)[0]).abs().max() > 1e-3


def test_neighbourhoods_look_alike_at_every_scale_and_ignore_padding() -> None:
    torch.manual_seed(0)
    layer, points = Neighbourhood(3, 8, neighbours=4).double(), torch.randn(1, 20, 3, dtype=torch.float64)
    mask = torch.ones(1, 20, dtype=torch.bool)
    plain = layer(points, mask)
    torch.testing.assert_close(layer(1e3 * points, mask), plain)
    padded = torch.cat([points, torch.zeros(1, 5, 3)], 1)
    torch.testing.assert_close(layer(padded, torch.arange(25)[None] < 20)[:, :20], plain)


def test_a_point_alone_has_the_same_features_in_a_padded_batch() -> None:
    torch.manual_seed(0)
    layer, point = Neighbourhood(2, 8, neighbours=4), torch.randn(1, 1, 2)
    padded = torch.cat([point, torch.zeros(1, 3, 2)], 1)
    alone = layer(point, torch.ones(1, 1, dtype=torch.bool))
    torch.testing.assert_close(alone, layer(padded, torch.tensor([[True, False, False, False]]))[:, :1])
    assert alone.shape == (1, 1, 8)


@pytest.mark.nightly
def test_the_matcher_overfits_matches_and_outliers_of_one_problem() -> None:
    torch.manual_seed(0)
    batch = plant(1, 12, outliers2d=4, outliers3d=4, seed=3, dtype=torch.float32).batch()
    net = Matcher(channels=32, depth=2, heads=2)
    optimiser = torch.optim.Adam(net.parameters(), lr=3e-3)
    for _ in range(120):
        loss = matching_likelihood_loss(net.match(batch), batch).mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    prediction = net.eval()(batch)
    paired = batch.match3d[0] >= 0
    assert (prediction.assignment[0].argmax(0)[paired] == batch.match3d[0][paired]).all()
    total = batch.points2d.shape[1] + batch.points3d.shape[1]
    unmatched = prediction.unmatched3d[0] * total
    assert unmatched[~paired].min() > 0.8
    assert unmatched[paired].max() < 0.2
    cosine = (torch.einsum("bij,bij->b", prediction.poses["refined"].rotation, batch.rotation) - 1) / 2
    assert float(cosine) > 0.9999


def test_wrong_options_of_a_matcher_are_named() -> None:
    with pytest.raises(ValueError, match=r"`channels` 30 is no multiple of `heads` 4"):
        Attention(30, 4)
    with pytest.raises(ValueError, match=r"`mu` is 0.0; it must be above 0"):
        Matcher(mu=0.0)
