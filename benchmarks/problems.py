"""Planted scenes with features of a chosen sharpness: what the benchmarks run on.

A camera of the paper's protocol (focal length 800, noise 2 pixels, Euler angles up to 45 degrees, distance 4.5) sees
points in the unit ball. Two kinds of features lead to two kinds of assignments:

- smooth: random waves of a point's place in the image (noisy on the 2D side, exact on the 3D side). Points that lie
  close together look alike, as they do to a trained network, and share their probability. `level` is the wave number.
- independent: a random unit vector for each point and the same with noise of relative size `level` on the other side.
  A wrong match is as unlikely as any other; the easy case for every iterative solver.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import roma
import torch
from torch import Tensor, nn

from bpnp.models.bpnpnet import BPnPNet, pairwise_distance
from bpnp.models.nets.features import ImageFeatures, SceneFeatures
from bpnp.training.losses import correspondence_losses, pose_losses
from bpnp.types import Batch, Prediction

Kind = Literal["smooth", "independent"]

FOCAL, NOISE_PX, DISTANCE, CHANNELS = 800.0, 2.0, 4.5, 128
LEARNING_RATE = 1e-5
NET_SHARE = 0.02  # of the real network's features beside the planted ones


@dataclass(frozen=True)
class Problem:
    """A batch in which 3D point j was seen as 2D point j, and unit features of both sides."""

    batch: Batch
    features2d: Tensor
    features3d: Tensor

    @property
    def cost(self) -> Tensor:
        return pairwise_distance(self.features2d, self.features3d)


def planted(batch: int, points: int, *, kind: Kind, level: float, seed: int = 0) -> Problem:
    """Scenes of `points` points on each side, all of them matches."""
    generator = torch.Generator().manual_seed(seed)
    scene = nn.functional.normalize(torch.randn(batch, points, 3, generator=generator), dim=-1)
    scene = scene * torch.rand(batch, points, 1, generator=generator) ** (1 / 3)
    x, y, z = (torch.rand(3, batch, generator=generator) * torch.pi / 4).unbind()
    rotation = roma.euler_to_rotmat("ZYX", [z, y, x])
    translation = torch.rand(batch, 3, generator=generator) - 0.5 + torch.tensor([0, 0, DISTANCE])
    camera = scene @ rotation.mT + translation.unsqueeze(1)
    exact = camera[..., :2] / camera[..., 2:]
    noisy = exact + NOISE_PX / FOCAL * torch.randn(batch, points, 2, generator=generator)
    problems = Batch.from_arrays(
        list(noisy), list(scene), list(rotation), list(translation), [torch.arange(points)] * batch, focal=FOCAL
    )
    if kind == "smooth":
        directions = level * DISTANCE * torch.randn(2, CHANNELS // 2, generator=generator)
        features2d, features3d = ((x @ directions) for x in (noisy, exact))
        features2d, features3d = (torch.cat([x.cos(), x.sin()], -1) for x in (features2d, features3d))
    else:
        features3d = torch.randn(batch, points, CHANNELS, generator=generator)
        features2d = features3d + level * torch.randn(batch, points, CHANNELS, generator=generator)
    return Problem(problems, nn.functional.normalize(features2d, dim=-1), nn.functional.normalize(features3d, dim=-1))


def diagonal_mass(assignment: Tensor) -> float:
    """Share of the assignment on the true matches, the mean over the batch."""
    return float(assignment.detach().diagonal(dim1=-2, dim2=-1).sum(-1).mean())


def planted_network(problem: Problem) -> BPnPNet:
    """BPnPNet whose nets do all their work, forward and backward, but leave the assignment as sharp as planted."""
    return BPnPNet(
        _PlantedFeatures(ImageFeatures(centre=True, scale=4.0), problem.features2d),
        _PlantedFeatures(SceneFeatures(centre=True), problem.features3d),
    )


class _PlantedFeatures(nn.Module):
    """Unit vector of a planted feature and a small part of that of the network."""

    def __init__(self, inner: nn.Module, planted: Tensor) -> None:
        super().__init__()
        self.inner = inner
        self.register_buffer("planted", planted)

    def forward(self, points: Tensor, mask: Tensor) -> Tensor:
        planted = self.get_buffer("planted")
        return nn.functional.normalize(planted + NET_SHARE * self.inner(points, mask), dim=-1)


def training_step(net: BPnPNet, losses: Callable[[BPnPNet], Tensor]) -> Callable[[], None]:
    """Forward, loss, backward and Adam. losses: of each sample."""
    optimiser = torch.optim.Adam(net.parameters(), lr=LEARNING_RATE)

    def step() -> None:
        optimiser.zero_grad()
        losses(net).mean().backward()
        optimiser.step()

    return step


def training_losses(net: BPnPNet, batch: Batch, poses: bool) -> Tensor:
    """L_c, or L_c + L_p, of each sample (b,)."""
    return losses_of(net(batch) if poses else net.match(batch), batch)


def losses_of(prediction: Prediction, batch: Batch) -> Tensor:
    losses = correspondence_losses(prediction, batch, angle=None)
    assert losses is not None
    return losses + pose_losses(prediction.poses["pnp"], batch) if "pnp" in prediction.poses else losses
