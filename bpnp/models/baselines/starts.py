"""Where a local solver starts: a fixed pose, near the true one, or anywhere."""

import math

import roma
import torch
from torch import Tensor

from bpnp.models.baselines.single_pairs import SinglePair, generator_for


def mean_pose(pair: SinglePair, euler_deg: tuple[float, ...], translation: tuple[float, ...]) -> tuple[Tensor, Tensor]:
    """R = Rz Ry Rx of the mean Euler angles (x, y, z), and the mean translation: the paper's start for ModelNet40."""
    angles = torch.tensor(euler_deg, dtype=torch.float64)
    rotation = roma.euler_to_rotmat("xyz", angles, degrees=True)
    shift = torch.tensor(translation, dtype=torch.float64)
    return rotation.unsqueeze(0).to(pair.points3d), shift.unsqueeze(0).to(pair.points3d)


def near_truth(pair: SinglePair, degrees: float, distance: float, seed: int) -> tuple[Tensor, Tensor]:
    """The true pose turned by U[-degrees, degrees] about a random axis and moved by U[-distance, distance] in a random
    direction: the paper's start for MegaDepth. Raises ValueError where the true pose is not known."""
    if pair.rotation is None or pair.translation is None:
        raise ValueError("expected a batch with its true poses to start near them, got none; try start 'random'")
    generator = generator_for(seed, pair.index)
    axis, direction = torch.nn.functional.normalize(_normal(generator, 2, 3), dim=-1)
    amount = 2 * torch.rand(2, generator=generator, dtype=torch.float64) - 1
    turn = roma.rotvec_to_rotmat(math.radians(degrees) * amount[0] * axis).to(pair.points3d)
    rotation = turn @ pair.rotation
    translation = pair.translation + (distance * amount[1] * direction).to(pair.points3d)
    return rotation.unsqueeze(0), translation.unsqueeze(0)


def anywhere(pair: SinglePair, count: int, seed: int) -> tuple[Tensor, Tensor]:
    """Uniform rotations, the scene's centre on the viewing ray of the image's, at the weak-perspective distance."""
    quaternions = torch.nn.functional.normalize(_normal(generator_for(seed, pair.index), count, 4), dim=-1)
    rotation = roma.unitquat_to_rotmat(quaternions).to(pair.points3d)
    ray = torch.nn.functional.pad(pair.points2d.mean(0), (0, 1), value=1.0)
    centred = weak_perspective_distance(pair.points2d, pair.points3d) * ray
    return rotation, centred - rotation @ pair.points3d.mean(0)


def weak_perspective_distance(points2d: Tensor, points3d: Tensor) -> float:
    """Distance at which the scene looks as large as the image: the ratio of their root mean square radii.

    Rotations average over the scene's shape: of its three axes, the image shows two.
    """
    image = (points2d - points2d.mean(0)).square().sum(-1).mean().sqrt()
    scene = (points3d - points3d.mean(0)).square().sum(-1).mean().sqrt()
    return float(math.sqrt(2 / 3) * scene / image.clamp_min(1e-12))


def _normal(generator: torch.Generator, *shape: int) -> Tensor:
    return torch.randn(*shape, generator=generator, dtype=torch.float64)
