import numpy as np
import poselib
import pytest
import torch
from torch import Tensor

from bpnp.geometry import random_rotations, rotation_angle
from bpnp.layers.ransac.minimal_solvers import p3p


def planted(size: int, *, seed: int = 0, field: float = 0.8) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Rays, points and the pose: three points in front of the camera, depths 1 to 8, any rotation."""
    generator = torch.Generator().manual_seed(seed)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    depth = 1 + 7 * uniform(size, 3, 1)
    camera = torch.cat([(2 * uniform(size, 3, 2) - 1) * field * depth, depth], -1)
    rotation, translation = random_rotations(size, generator), 4 * uniform(size, 3) - 2
    points3d = (camera - translation.unsqueeze(1)) @ rotation
    return torch.nn.functional.normalize(camera, dim=-1), points3d, rotation, translation


def angles(rotations: Tensor, rotation: Tensor) -> Tensor:
    """Angle of each of the four slots to one rotation, infinite in empty slots."""
    return rotation_angle(rotations, rotation.unsqueeze(-3).expand(rotations.shape)).nan_to_num(nan=torch.inf)


def test_p3p_finds_the_planted_pose_in_100000_round_trips() -> None:
    rays, points3d, rotation, translation = planted(100_000)
    solution = p3p(rays, points3d)
    angle = angles(solution.rotation, rotation)
    shift = torch.linalg.vector_norm(solution.translation - translation.unsqueeze(1), dim=-1)
    slot = angle.argmin(-1, keepdim=True)
    assert angle.gather(-1, slot).max() < 1e-6
    assert shift.gather(-1, slot).max() < 1e-6


def test_same_number_of_poses_and_same_poses_as_poselib() -> None:
    rays, points3d, _, _ = planted(10_000, seed=2)
    solution = p3p(rays, points3d)
    theirs = [poselib.p3p(f, p) for f, p in zip(rays.numpy(), points3d.numpy(), strict=True)]
    counts = torch.tensor([len(poses) for poses in theirs])
    assert (solution.valid.sum(-1) != counts).double().mean() < 1e-3
    distances = [
        angles(solution.rotation[i].expand(len(poses), 4, 3, 3), torch.as_tensor(np.stack([q.R for q in poses])))
        for i, poses in enumerate(theirs[:2000])
    ]
    assert (torch.cat(distances).amin(-1) < 1e-6).double().mean() > 0.999


DEGENERATE = {
    "collinear": lambda rays, points3d: (rays, torch.arange(3.0).unsqueeze(-1).double() * points3d[0]),
    "two points repeated": lambda rays, points3d: (rays, points3d[[0, 0, 2]]),
    "all points repeated": lambda rays, points3d: (rays, points3d[[1, 1, 1]]),
    "points at the origin": lambda rays, points3d: (rays, torch.zeros_like(points3d)),
    "zero rays": lambda rays, points3d: (torch.zeros_like(rays), points3d),
    "one ray for all": lambda rays, points3d: (rays[[0, 0, 0]], points3d),
    "NaN point": lambda rays, points3d: (rays, points3d * torch.tensor([torch.nan, 1, 1], dtype=torch.float64)),
    "infinite ray": lambda rays, points3d: (rays + torch.inf, points3d),
}


@pytest.mark.parametrize("kind", DEGENERATE)
def test_degenerate_input_has_no_pose_and_leaves_its_neighbours_alone(kind: str) -> None:
    rays, points3d, _, _ = planted(3, seed=6)
    expected = p3p(rays, points3d)
    spoilt_rays, spoilt_points = rays.clone(), points3d.clone()
    spoilt_rays[1], spoilt_points[1] = DEGENERATE[kind](rays[1], points3d[1])
    solution = p3p(spoilt_rays, spoilt_points)
    assert not solution.valid[1].any()
    assert solution.rotation[1].isnan().all()
    assert solution.translation[1].isnan().all()
    for value, planted_value in zip(solution, expected, strict=True):
        torch.testing.assert_close(value[[0, 2]], planted_value[[0, 2]], equal_nan=True)
