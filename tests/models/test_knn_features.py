"""Features from neighbourhoods: the authors' convolution of edges written out, padding, and order."""

import numpy as np
import torch
from planted import plant
from scipy.spatial import KDTree
from torch import nn

from bpnp import Batch, BPnPNet
from bpnp.models import KnnFeatures
from bpnp.models.knn_features import NeighbourBlock, edges, neighbour_mean
from bpnp.models.nets import normalise_points3d


def points(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def test_the_neighbours_are_those_of_a_tree_and_the_mean_of_edge_features_is_that_of_a_convolution() -> None:
    """The convolution of all edges (x_j - x_i, x_i), then their mean, as in the paper; neighbours by scipy."""
    x = points(1, 30, 5)
    mask = torch.ones(1, 30, dtype=torch.bool)
    _, index = KDTree(x[0].numpy()).query(x[0].numpy(), k=10)
    around = x[0][torch.from_numpy(index)]
    torch.testing.assert_close(neighbour_mean(x, mask, 10)[0], around.mean(1))
    linear = nn.Linear(10, 7).double()
    each = linear(torch.cat([around - x[0][:, None], x[0][:, None].expand(-1, 10, -1)], -1)).mean(1)
    torch.testing.assert_close(linear(edges(x, mask, 10))[0], each)


def test_a_block_is_two_normalised_maps_of_edges_and_a_shortcut() -> None:
    """With torch's own norms: instance norm has the biased variance, so that the unbiased one is written out."""
    x, mask = points(3, 20, 4), torch.ones(3, 20, dtype=torch.bool)
    block = NeighbourBlock(4, 5).double().train()
    z = x
    for linear in block.linears:
        y = linear(edges(z, mask, 5))
        y = (y - y.mean(1, keepdim=True)) / (y.var(1, keepdim=True) + 1e-3).sqrt()
        z = torch.relu(nn.BatchNorm1d(4, affine=False).double()(y.mT).mT)
    torch.testing.assert_close(block(x, mask), x + z)


def test_features_do_not_depend_on_padding_and_follow_the_order_of_the_points() -> None:
    net = KnnFeatures(3, channels=8, depth=2, neighbours=4, normalise=True).double().eval()
    x = points(2, 12, 3)
    mask = torch.tensor([[True] * 12, [True] * 7 + [False] * 5])
    found = net(x, mask)
    torch.testing.assert_close(net(x[1:, :7], mask[1:, :7]), found[1:, :7])
    torch.testing.assert_close(found.norm(dim=-1)[mask], torch.ones(19, dtype=torch.float64))
    order = torch.randperm(12, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(net(x[:, order], mask[:, order])[0], found[0, order])
    moved = 3 * x + 5  # another unit and origin
    torch.testing.assert_close(net(moved, mask)[0], found[0])
    few = mask.clone()
    few[1, 2:] = False  # fewer points than neighbours
    assert net(x, few)[1, :2].isfinite().all()
    assert normalise_points3d(x, few)[1, 2:].abs().max() == 0


def test_the_gradient_of_the_mean_is_finite_differences() -> None:
    x, mask = points(1, 6, 2).requires_grad_(), torch.tensor([[True] * 5 + [False]])
    assert torch.autograd.gradcheck(lambda x: neighbour_mean(x, mask, 3)[:, :5], x)


def test_a_bpnpnet_has_them_as_parts() -> None:
    planted = plant(2, 16, dtype=torch.float32)
    sizes = {"channels": 8, "depth": 2}
    net = BPnPNet(KnnFeatures(2, **sizes), KnnFeatures(3, **sizes))
    prediction = net(planted.batch())
    assert prediction.assignment is not None
    np.testing.assert_allclose(prediction.assignment.sum((1, 2)).detach(), 1, atol=1e-5)
    prediction.assignment.square().sum().backward()
    assert all(p.grad is not None and p.grad.isfinite().all() for p in net.parameters())
    one = Batch.from_arrays(torch.rand(1, 2), torch.rand(1, 3))
    assert net.eval()(one).assignment is not None
