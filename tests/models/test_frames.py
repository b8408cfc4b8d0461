"""Frames of point sets: planted axes, equivariance, clutter and padding."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from bpnp.models.nets.normalisation import principal_axes, robust_frame

SIZES = torch.tensor([0.3, 1.0, 3.0], dtype=torch.float64)


def skewed(count: int, seed: int) -> Tensor:
    """(1, count, 3) with a longer tail towards positive values on each axis, of standard deviations `SIZES`."""
    rng = np.random.default_rng(seed)
    return torch.from_numpy(rng.gamma(2.0, 1.0, (1, count, 3)) - 2) / 2**0.5 * SIZES


def everywhere(points: Tensor) -> Tensor:
    return torch.ones(points.shape[:2], dtype=torch.bool)


def test_half_of_the_points_may_lie_anywhere_without_moving_the_frame() -> None:
    points = skewed(60, 0)
    far = points.clone()
    far[:, ::3] = 1e6
    before, radius = robust_frame(points, everywhere(points))
    after, far_radius = robust_frame(far, everywhere(points))
    assert (after - before).abs().max() < 2 * points.std()
    assert float(far_radius / radius) < 4
    assert (principal_axes(far, everywhere(far)) * principal_axes(points, everywhere(far))).sum(1).abs()[0, 2] > 0.8


@pytest.mark.parametrize("seed", range(4))
def test_the_axes_are_those_that_were_planted_and_turn_with_the_points(seed: int) -> None:
    points = skewed(3000, seed)
    turn = torch.from_numpy(Rotation.random(random_state=seed).as_matrix())
    axes = principal_axes(points @ turn.T + torch.tensor([5.0, -70.0, 9.0]), everywhere(points))[0]
    torch.testing.assert_close(axes.mT @ axes, torch.eye(3, dtype=torch.float64), rtol=0, atol=1e-12)
    assert float(torch.linalg.det(axes)) == pytest.approx(1)
    assert ((axes * turn).sum(0) > 0.99).all()  # along the planted ones, towards their longer tails
    own = principal_axes(points, everywhere(points))[0]
    torch.testing.assert_close(axes, turn @ own, rtol=0, atol=1e-6)


def test_neither_unit_nor_padding_nor_the_batch_matters() -> None:
    points = skewed(50, 1)
    alone = principal_axes(points, everywhere(points))
    padded = torch.cat([points, torch.full((1, 7, 3), 1e5, dtype=torch.float64)], 1)
    mask = torch.arange(57)[None] < 50
    both, masks = torch.cat([padded, 900 * padded.flip(1)]), torch.cat([mask, mask.flip(1)])
    torch.testing.assert_close(principal_axes(both, masks), alone.expand(2, 3, 3), rtol=0, atol=1e-9)


@pytest.mark.parametrize("points", [torch.zeros(1, 5, 3), torch.ones(1, 1, 3), torch.rand(1, 20, 1) * torch.ones(3)])
def test_degenerate_sets_have_a_frame(points: Tensor) -> None:
    """One place, one point, a line."""
    axes = principal_axes(points, everywhere(points))[0].double()
    torch.testing.assert_close(axes.mT @ axes, torch.eye(3, dtype=torch.float64), rtol=0, atol=1e-5)
    assert float(torch.linalg.det(axes)) == pytest.approx(1, abs=1e-5)
