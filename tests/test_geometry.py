import math

import cv2
import numpy as np
import pytest
import torch
from planted import plant
from scipy.spatial.transform import Rotation

from bpnp.geometry import (
    angle_between,
    bearings,
    hat,
    masked_median,
    project,
    quaternion_rotation,
    random_rotations,
    retract,
    rotation_angle,
    transform,
)


def test_bearings_are_unit_rays_through_the_image_points() -> None:
    points2d = torch.randn(3, 7, 2)
    rays = bearings(points2d)
    torch.testing.assert_close(torch.linalg.vector_norm(rays, dim=-1), torch.ones(3, 7))
    torch.testing.assert_close(project(rays), points2d)
    assert (rays[..., 2] > 0).all()
    assert torch.equal(bearings(torch.zeros(2)), torch.tensor([0.0, 0.0, 1.0]))


def test_points_project_as_in_opencv() -> None:
    planted = plant(1, 20)
    seen = project(transform(*planted.pose, planted.points3d))[0]
    vector = Rotation.from_matrix(planted.rotation[0].numpy()).as_rotvec()
    expected, _ = cv2.projectPoints(
        planted.points3d[0].numpy(), vector, planted.translation[0].numpy(), np.eye(3), np.zeros(4)
    )
    np.testing.assert_allclose(seen, expected[:, 0], atol=1e-12)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-4, 1.0, math.pi / 2, 3.0, math.pi - 1e-9, math.pi])
def test_small_angles_keep_their_digits(angle: float) -> None:
    axis = np.array([0.48, 0.6, 0.64])
    first = Rotation.from_rotvec([0.3, -0.2, 1.0])
    second = first * Rotation.from_rotvec(angle * axis)
    a, b = (torch.from_numpy(r.as_matrix()) for r in (first, second))
    # Beyond a right angle the sine is found from a difference of entries of size one.
    assert abs(float(rotation_angle(a, b)) - angle) < max(1e-15, 1e-15 * angle) * 4
    x = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)
    y = torch.tensor([math.cos(angle), math.sin(angle), 0.0], dtype=torch.float64)
    assert abs(float(angle_between(3 * x, 0.1 * y)) - angle) < 1e-15


def test_gradients_are_finite_where_angles_end() -> None:
    rotation = torch.eye(3).unsqueeze(0).repeat(3, 1, 1)
    half_turn = torch.tensor([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]])
    other = torch.stack([torch.eye(3), half_turn, half_turn.roll(1, 0).roll(1, 1)]).requires_grad_()
    rotation_angle(rotation, other).sum().backward()
    assert other.grad is not None
    assert other.grad.isfinite().all()
    x = torch.tensor([[1.0, 0, 0], [1.0, 0, 0], [0.0, 0, 0]], requires_grad=True)
    y = torch.tensor([[2.0, 0, 0], [-1.0, 0, 0], [1.0, 0, 0]])
    angle_between(x, y).sum().backward()
    assert x.grad is not None
    assert x.grad.isfinite().all()


def test_a_step_multiplies_by_the_matrix_exponential_on_the_left() -> None:
    step = torch.randn(2, 5, 6, dtype=torch.float64)
    pose = random_rotations(10).unflatten(0, (2, 5)), torch.randn(2, 5, 3, dtype=torch.float64)
    rotation, translation = retract(step, *pose)
    torch.testing.assert_close(rotation, torch.linalg.matrix_exp(hat(step[..., :3])) @ pose[0])
    torch.testing.assert_close(translation, pose[1] + step[..., 3:])


def test_quaternions_of_any_length_are_scipys_rotations() -> None:
    quaternion = np.random.default_rng(0).normal(size=(20, 4))
    found = quaternion_rotation(torch.from_numpy(3 * quaternion))
    np.testing.assert_allclose(found, Rotation.from_quat(quaternion).as_matrix(), atol=1e-14)


@pytest.mark.parametrize("kind", ["torch", "numpy"])
def test_random_rotations_are_uniform_and_repeatable(kind: str) -> None:
    """Uniform over SO(3): the angle between two has the density (1 - cos a) / pi, each entry the mean square 1/3."""

    def draw() -> torch.Tensor:
        torch_generator = torch.Generator().manual_seed(4)
        return random_rotations(4000, torch_generator if kind == "torch" else np.random.default_rng(4))

    rotation = draw()
    with torch.device("meta"):  # the result is on the CPU whatever the default device
        assert torch.equal(rotation, draw())
    torch.testing.assert_close(torch.linalg.det(rotation), torch.ones(4000, dtype=torch.float64))
    torch.testing.assert_close(rotation.square().mean(0), torch.full((3, 3), 1 / 3).double(), atol=0.02, rtol=0)
    angle = rotation_angle(rotation[::2], rotation[1::2])
    below = (angle < 2.0).double().mean()
    assert abs(float(below) - (2.0 - math.sin(2.0)) / math.pi) < 0.04


@pytest.mark.parametrize("count", [1, 6, 7])
def test_a_median_of_the_masked_values_is_numpys(count: int) -> None:
    rng = np.random.default_rng(count)
    values, mask = rng.normal(size=(4, 3, count)), rng.random((4, 1, count)) < 0.6
    mask[0] = False
    values[1, 0, 0] = values[1, 0, -1]  # a tie
    found = masked_median(torch.tensor(values), torch.tensor(mask))
    hidden = np.where(mask, values, np.nan)
    assert found[0].isnan().all()
    for row, some in zip(hidden.reshape(-1, count), found.ravel().tolist(), strict=True):
        if not np.isnan(row).all():
            assert some == np.nanpercentile(row, 50, method="lower")
