"""Initial poses of a local solver: a fixed one, one near the true one, or random ones."""

import math

import roma
import torch
from torch import Tensor

from bpnp.geometry import random_rotations, retract
from bpnp.models.baselines.single_pairs import SinglePair, pair_seed


def mean_pose(pair: SinglePair) -> tuple[Tensor, Tensor]:
    """R = Rz Ry Rx of 22.5 degrees each, t = (0, 0, 4.5): the mean of the paper's cameras for ModelNet40."""
    rotation = roma.euler_to_rotmat("xyz", torch.full((3,), 22.5, dtype=torch.float64), degrees=True)
    return rotation.unsqueeze(0).to(pair.points3d), pair.points3d.new_tensor([[0.0, 0.0, 4.5]])


def near_truth(pair: SinglePair, seed: int) -> tuple[Tensor, Tensor]:
    """The true pose turned by up to 10 degrees about a random axis and moved by up to 0.5 in a random direction,
    uniformly: the paper's start for MegaDepth. Raises ValueError where the true pose is not known."""
    if pair.rotation is None or pair.translation is None:
        raise ValueError("expected a batch with its true poses to start near them, got none; try start 'random'")
    generator = torch.Generator().manual_seed(pair_seed(seed, pair.index))
    directions = torch.nn.functional.normalize(torch.randn(2, 3, generator=generator, dtype=torch.float64), dim=-1)
    amounts = 2 * torch.rand(2, generator=generator, dtype=torch.float64) - 1
    step = (amounts * torch.tensor([math.radians(10), 0.5])).unsqueeze(-1) * directions
    rotation, translation = retract(step.flatten().to(pair.points3d), pair.rotation, pair.translation)
    return rotation.unsqueeze(0), translation.unsqueeze(0)


def random_poses(pair: SinglePair, count: int, seed: int) -> tuple[Tensor, Tensor]:
    """Uniform rotations, the scene's centre on the viewing ray of the image's, at the weak-perspective distance."""
    generator = torch.Generator().manual_seed(pair_seed(seed, pair.index))
    rotation = random_rotations(count, generator).to(pair.points3d)
    ray = torch.nn.functional.pad(pair.points2d.mean(0), (0, 1), value=1.0)
    centred = weak_perspective_distance(pair.points2d, pair.points3d) * ray
    return rotation, centred - rotation @ pair.points3d.mean(0)


def weak_perspective_distance(points2d: Tensor, points3d: Tensor) -> float:
    """Distance at which the scene looks as large as the image: the ratio of their root mean square radii.

    Averaged over rotations, the image shows two of the scene's three axes: the factor sqrt(2/3).
    """
    image, scene = ((points - points.mean(0)).square().sum(-1).mean().sqrt() for points in (points2d, points3d))
    return float(math.sqrt(2 / 3) * scene / image.clamp_min(1e-12))
