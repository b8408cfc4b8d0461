"""Random numbers of the draws, and a RANSAC that is not misled from behind."""

import numpy as np
import pytest
import torch
from planted import plant

from bpnp.geometry import rotation_angle
from bpnp.layers import ransac_pnp
from bpnp.layers.ransac.matches import distinct_triples, hashed_uniform

THRESHOLD = 0.01


@pytest.mark.parametrize("backend", ["poselib", "torch"])
def test_points_behind_the_camera_are_no_inliers(backend: str) -> None:
    """Every other 3D point is put where it is seen from behind, in the same place of the image."""
    planted = plant(1, 400, noise=0.001, seed=4)
    camera = planted.points3d @ planted.rotation.mT + planted.translation
    camera[:, ::2] *= -1
    points3d = (camera - planted.translation.unsqueeze(1)) @ planted.rotation
    rotation, translation, stats = ransac_pnp(
        planted.permutation(), planted.points2d, points3d, backend=backend, matches_factor=1.0, threshold=THRESHOLD
    )
    assert rotation_angle(rotation, planted.rotation) < np.deg2rad(1)
    camera = points3d @ rotation.mT + translation
    distance = (camera[..., :2] / camera[..., 2:] - planted.points2d[:, planted.match3d[0]]).norm(dim=-1)[0]
    assert (distance[::2] < THRESHOLD).any()
    front = distance[1::2]
    torch.testing.assert_close(stats.residual[0], front[front < THRESHOLD].mean())


def hashed(counter: int, seed: int) -> float:
    """Compute the hash with integers of Python, and divide in double precision."""
    state = counter
    for salt in (0, (seed * 0x9E3779B1 + 1) & 0xFFFFFFFF):
        state = (state + salt) & 0xFFFFFFFF
        state = ((state ^ (state >> 16)) * 0x21F0AAAD) & 0xFFFFFFFF
        state = ((state ^ (state >> 15)) * 0x735A2D97) & 0xFFFFFFFF
        state ^= state >> 15
    return (state + 0.5) / 2**32


@pytest.mark.parametrize("counter", [0, 1, 5676159, 59476945, 188579352])
def test_random_numbers_are_below_one_in_double_precision(counter: int) -> None:
    """The last three are so close to 1 that single precision rounds them to it."""
    (number,) = hashed_uniform(1, 0, torch.device("cpu"), skip=counter).tolist()
    assert number == hashed(counter, 0)
    assert 0 < number < 1


@pytest.mark.parametrize("pool", [3.0, 1000.0, 1e6])
def test_indices_of_a_triple_stay_below_the_pool(pool: float) -> None:
    """The first number of the first draw is as close to 1 as they come."""
    counter = 5676159
    assert counter % 3 == 0
    (triple,) = distinct_triples(torch.full((1, 1), pool), 0, skip=counter // 3).flatten(1)
    assert len(set(triple.tolist())) == 3
    assert triple.max() == pool - 1
