"""The torch alignment against the compiled one, a planted pose, and finite differences."""

import math

import numpy as np
import pytest
import roma
import torch

from bpnp.metrics import rotation_error
from bpnp.search import alignment
from bpnp.search.annealing import RECIPES, RELAXATION, run_batch
from bpnp.search.kernels_dense import descend
from bpnp.search.scene import Scene


@pytest.fixture
def problem() -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Bearings (200, 3) of points (250, 3), 50 of them unseen, and the true rotation."""
    torch.manual_seed(4)
    points3d = torch.randn(250, 3) * torch.tensor([1.0, 0.6, 0.3]) + 0.3 * torch.randn(1, 3)
    rotation = roma.random_rotmat()
    y = points3d[:200] @ rotation.T + torch.tensor([0.1, -0.2, 5.0])
    rays = torch.nn.functional.normalize(y + 0.003 * torch.randn_like(y), dim=-1)
    return rays, points3d, rotation


def test_it_ends_where_the_compiled_loops_end(problem: tuple[torch.Tensor, ...]) -> None:
    rays, points3d, rotation = problem
    a, b = torch.rand(len(rays)) + 0.5, torch.rand(len(points3d)) + 0.5
    tilt = roma.rotvec_to_rotmat(0.2 * torch.randn(12, 3)) @ rotation
    shift = torch.tensor([0.0, 0.0, 5.0]).expand(12, 3) + 0.1 * torch.randn(12, 3)
    scales = np.geomspace(0.1, 0.01, 12).astype(np.float32)
    turns, shifts, score = tilt.numpy().copy(), shift.numpy().copy(), np.empty(12, np.float32)
    f, p = np.ascontiguousarray(rays.numpy().T), np.ascontiguousarray(points3d.numpy().T)
    descend(f, a.numpy(), p, b.numpy(), turns, shifts, scales, np.float32(0.4), RELAXATION, score)
    ours = alignment.descend(rays, a, points3d, b, tilt, shift, scales.tolist(), 0.4, float(RELAXATION))
    assert (score > score.max() - 0.1).sum() >= 6
    for mine, theirs in zip(ours, (turns, shifts, score), strict=True):
        torch.testing.assert_close(mine, torch.as_tensor(theirs), atol=2e-3, rtol=1e-3)


def test_chunks_change_nothing(problem: tuple[torch.Tensor, ...], monkeypatch: pytest.MonkeyPatch) -> None:
    rays, points3d, rotation = problem
    starts = roma.rotvec_to_rotmat(0.3 * torch.randn(7, 3)) @ rotation, torch.tensor([[0.0, 0.0, 5.0]]).repeat(7, 1)
    ones = torch.ones(len(rays)), torch.ones(len(points3d))
    whole = alignment.descend(rays, ones[0], points3d, ones[1], *starts, [0.1, 0.05], 0.4, 1.0)
    monkeypatch.setattr(alignment, "CHUNK", 2 * len(rays) * len(points3d))
    for one, other in zip(
        whole, alignment.descend(rays, ones[0], points3d, ones[1], *starts, [0.1, 0.05], 0.4, 1.0), strict=True
    ):
        torch.testing.assert_close(one, other, atol=1e-5, rtol=1e-5)


def test_a_step_climbs_the_objective_as_its_gradient_says() -> None:
    torch.manual_seed(1)
    q, p = torch.randn(1, 30, 3, dtype=torch.float64), torch.randn(30, 3, dtype=torch.float64)
    rotation, translation = roma.random_rotmat(1).double(), torch.tensor([[0.1, 0.2, 6.0]], dtype=torch.float64)
    q = torch.nn.functional.normalize(p @ rotation.mT + translation.unsqueeze(1), dim=-1) + 0.01 * q

    def objective(turn: torch.Tensor, shift: torch.Tensor) -> float:
        y = p @ turn.mT + shift.unsqueeze(1)
        return float((q * torch.nn.functional.normalize(y, dim=-1)).sum())

    values = [objective(rotation, translation)]
    for _ in range(30):
        rotation, translation, fixed = alignment.move(q, p, rotation, translation, 1.0)
        assert bool(fixed)
        values.append(objective(rotation, translation))
    assert np.diff(values).min() > -1e-12
    for axis in torch.eye(3, dtype=torch.float64):
        turn = roma.rotvec_to_rotmat(1e-4 * axis)
        assert objective(turn @ rotation, translation) < values[-1]
        assert objective(rotation, translation + 1e-3 * axis) < values[-1]


def test_a_pose_that_is_lost_says_so() -> None:
    rays, points3d = torch.tensor([[0.0, 0.0, 1.0]]).repeat(5, 1), torch.randn(6, 3)
    score = alignment.descend(
        rays,
        torch.ones(5),
        points3d,
        torch.ones(6),
        torch.full((1, 3, 3), torch.nan),
        torch.zeros(1, 3),
        [0.1],
        0.3,
        1.0,
    )[2]
    assert score.item() == -math.inf


def test_a_batch_of_starts_finds_the_planted_pose(problem: tuple[torch.Tensor, ...]) -> None:
    rays, points3d, rotation = problem
    scene = Scene(rays.double().numpy(), points3d.double().numpy(), 0, torch.device("cpu"))
    pool = run_batch(scene, RECIPES[0], None, None, 0.3)
    found = torch.as_tensor(scene.leave(pool.rotation[:1], pool.translation[:1])[0]).float()
    assert rotation_error(found, rotation[None]).item() < 1
