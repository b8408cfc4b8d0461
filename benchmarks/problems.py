"""Planted scenes with features of a chosen sharpness: what the benchmarks run on.

A camera of the paper's protocol (focal length 800, noise 2 pixels, Euler angles up to 45 degrees, distance 4.5) sees
points in the unit ball. Two kinds of features lead to two kinds of assignments:

- smooth: random waves of a point's place in the image (noisy on the 2D side, exact on the 3D side). Points that lie
  close together look alike, as they do to a trained network, and share their probability. `level` is the wave number.
- independent: a random unit vector for each point and the same with noise of relative size `level` on the other side.
  A wrong match is as unlikely as any other; the easy case for every iterative solver.
"""

from dataclasses import dataclass
from typing import Literal

import roma
import torch
from torch import Tensor, nn

from bpnp.models.bpnpnet import pairwise_distance
from bpnp.types import Batch

Kind = Literal["smooth", "independent"]

FOCAL, NOISE_PX, DISTANCE, CHANNELS = 800.0, 2.0, 4.5, 128


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
