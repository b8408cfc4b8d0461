import numpy as np
import poselib
import pytest
import torch
from torch import Tensor

from bpnp.geometry import angle_between, random_rotations, rotation_angle, transform
from bpnp.robust.minimal_solvers import p3p


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


def test_one_of_the_poses_is_the_planted_one_in_100000_round_trips() -> None:
    rays, points3d, rotation, translation = planted(100_000)
    solution = p3p(rays, points3d)
    angle = angles(solution.rotation, rotation)
    shift = torch.linalg.vector_norm(solution.translation - translation.unsqueeze(1), dim=-1)
    slot = angle.argmin(-1, keepdim=True)
    assert angle.gather(-1, slot).max() < 1e-6
    assert shift.gather(-1, slot).max() < 1e-6


def test_every_pose_maps_the_points_onto_their_rays() -> None:
    rays, points3d, _, _ = planted(5000, seed=1)
    solution = p3p(rays, points3d)
    every = (-1, 4, -1, -1)
    camera = transform(solution.rotation, solution.translation, points3d.unsqueeze(1).expand(every))[solution.valid]
    assert angle_between(camera, rays.unsqueeze(1).expand(every)[solution.valid]).max() < 1e-8
    determinants = torch.linalg.det(solution.rotation[solution.valid])
    torch.testing.assert_close(determinants, torch.ones_like(determinants))


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


def test_float32_input_is_solved_as_precisely_as_it_is_given() -> None:
    rays, points3d, rotation, _ = planted(2000, seed=3)
    solution = p3p(rays.float(), points3d.float())
    assert solution.rotation.dtype == solution.translation.dtype == torch.float32
    error = angles(solution.rotation.double(), rotation).amin(-1)
    assert error.median() < 1e-6
    assert (error < 1e-3).double().mean() > 0.995


def test_pose_does_not_depend_on_the_unit_of_length_nor_on_the_length_of_the_rays() -> None:
    rays, points3d, rotation, translation = planted(500, seed=4)
    for scale in (1e-6, 1e6):
        solution = p3p(rays * 7, points3d * scale)
        slot = angles(solution.rotation, rotation).argmin(-1)
        found = solution.translation[torch.arange(500), slot] / scale
        torch.testing.assert_close(found, translation, atol=1e-6, rtol=1e-6)


def test_a_small_triangle_seen_from_afar_is_solved() -> None:
    rays, points3d, rotation, _ = planted(2000, seed=5, field=0.02)
    assert angles(p3p(rays, points3d).rotation, rotation).amin(-1).quantile(0.999) < 1e-6


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


def test_any_leading_axes_and_none() -> None:
    rays, points3d, _, _ = planted(12, seed=7)
    flat = p3p(rays, points3d)
    grid = p3p(rays.view(3, 4, 3, 3), points3d.view(3, 4, 3, 3))
    torch.testing.assert_close(grid.rotation.flatten(0, 1), flat.rotation, equal_nan=True)
    assert torch.equal(p3p(rays[0], points3d[0]).valid, flat.valid[0])
    assert p3p(rays[:0], points3d[:0]).rotation.shape == (0, 4, 3, 3)
