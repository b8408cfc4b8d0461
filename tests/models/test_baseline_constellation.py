"""Constellation matching on planted poses of few points: a ring of LEDs, hidden ones, background lights."""

import math

import torch

from bpnp import Batch
from bpnp.geometry import project, random_rotations, transform
from bpnp.metrics import rotation_error, translation_error
from bpnp.models.baselines import Constellation


def ring(seed: int, *, seen: int = 9, lights: int = 2, noise: float = 0.0004) -> Batch:
    """`seen` of 15 LEDs on a bent ring, half a metre to a metre away, and background lights around their image."""
    generator = torch.Generator().manual_seed(seed)
    turn = torch.linspace(0, 2 * math.pi, 16)[:-1].double()
    height = 0.02 * torch.rand(15, generator=generator, dtype=torch.float64)
    points3d = torch.stack([0.06 * turn.cos(), 0.05 * turn.sin(), height], -1)
    rotation = random_rotations(1, generator)
    translation = torch.tensor([[0.05, -0.03, 0.5 + 0.5 * float(torch.rand((), generator=generator))]]).double()
    image = project(transform(rotation, translation, points3d[None]))[0]
    order = torch.randperm(15, generator=generator)[:seen]
    jitter = noise * torch.randn(seen, 2, generator=generator, dtype=torch.float64)
    clutter = image.mean(0) + 0.3 * (torch.rand(lights, 2, generator=generator, dtype=torch.float64) - 0.5)
    return Batch.from_arrays(torch.cat([image[order] + jitter, clutter]), points3d, rotation[0], translation[0])


def test_it_finds_the_planted_pose_of_a_ring_of_leds_among_lights() -> None:
    errors, shifts = [], []
    for seed in range(5):
        batch = ring(seed)
        pose = Constellation()(batch).poses["constellation"]
        assert pose.stats.converged[0]
        assert pose.stats.residual[0] < 0.001
        errors.append(rotation_error(pose.rotation, batch.rotation))
        shifts.append(translation_error(pose.translation, batch.translation))
    assert torch.cat(errors).max() < 2
    assert torch.cat(shifts).max() < 0.02


def test_points_without_a_pose_in_common_are_not_found() -> None:
    generator = torch.Generator().manual_seed(0)
    points2d, points3d = (torch.rand(8, k, generator=generator, dtype=torch.float64) for k in (2, 3))
    pose = Constellation(radius=1e-4, neighbours2d=3, neighbours3d=4)(Batch.from_arrays(points2d, points3d)).poses
    assert not pose["constellation"].stats.converged[0]
