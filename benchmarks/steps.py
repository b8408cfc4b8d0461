"""One training step of the network with our layers, and of the same nets with the paper's."""

from collections.abc import Callable

import torch
from paper_layers import paper_network
from torch import Tensor

from bpnp.models.bpnpnet import BPnPNet
from bpnp.training.losses import correspondence_loss, pose_loss
from bpnp.types import Batch

LEARNING_RATE = 1e-5


def training_step(net: BPnPNet, batch: Batch, *, poses: bool, paper: bool = False) -> Callable[[], None]:
    """Forward, L_c (and L_p), backward and Adam; a sample without a converged pose has no L_p."""
    optimiser = torch.optim.Adam(net.parameters(), lr=LEARNING_RATE)
    losses = paper_losses if paper else training_losses

    def step() -> None:
        optimiser.zero_grad()
        losses(net, batch, poses).mean().backward()
        optimiser.step()

    return step


def training_losses(net: BPnPNet, batch: Batch, poses: bool) -> Tensor:
    """L_c + L_p of each sample (b,)."""
    prediction = net(batch) if poses else net.match(batch)
    assert prediction.assignment is not None
    losses = _matching(prediction.assignment, batch)
    if not poses:
        return losses
    pose = prediction.poses["pnp"]
    rotation, translation = _truth(batch)
    # The truth in place of a pose that is missing has neither loss nor gradient, and nothing waits for the device.
    found = pose.stats.converged
    rotation = torch.where(found[:, None, None], pose.rotation, rotation)
    translation = torch.where(found[:, None], pose.translation, translation)
    return losses + pose_loss(rotation, translation, *_truth(batch))


def paper_losses(net: BPnPNet, batch: Batch, poses: bool) -> Tensor:
    prediction = paper_network(net, batch, poses=poses)
    losses = _matching(prediction.assignment, batch)
    if prediction.rotation is None or prediction.translation is None:
        return losses
    return losses + pose_loss(prediction.rotation, prediction.translation, *_truth(batch))


def _matching(assignment: Tensor, batch: Batch) -> Tensor:
    assert batch.match3d is not None
    return correspondence_loss(assignment, batch.match3d)


def _truth(batch: Batch) -> tuple[Tensor, Tensor]:
    assert batch.rotation is not None
    assert batch.translation is not None
    return batch.rotation, batch.translation
