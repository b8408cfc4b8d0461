"""Sums over near directions, and counts of points that shifts take onto others, against all pairs."""

import numpy as np
import pytest
from scipy.spatial.distance import cdist

from bpnp.search.kernels.neighbours import HashedPoints, sums_near


@pytest.mark.parametrize(("width", "count"), [(0.2, 300), (20.0, 300), (0.2, 1)])
def test_sums_near_are_those_over_all_pairs(width: float, count: int) -> None:
    """A narrow view and one all around, with directions outside the view."""
    rng = np.random.default_rng(0)
    bearings, directions = (
        [0.1, 0, 1] + width * rng.uniform(-1, 1, (k, 3)) * (1, s, 1) for k, s in ((count, 1), (400, 2))
    )
    bearings, directions = (x / np.linalg.norm(x, axis=1, keepdims=True) for x in (bearings, directions))
    axes = np.linalg.svd(rng.standard_normal((3, 2)), full_matrices=False)[0]
    radii, sharpness = np.array([0.01, 0.03, 0.07]), np.array([5e4, 0.0, 1e3])
    squared = cdist(bearings, directions, "sqeuclidean")[..., None]
    expected = np.where(squared < radii**2, np.exp(-sharpness * squared), 0).sum(1)
    assert expected[:, 2].max() > 0
    np.testing.assert_allclose(sums_near(bearings, directions, axes, radii, sharpness), expected, rtol=1e-9, atol=1e-12)


def test_shifts_that_take_points_onto_others_are_counted() -> None:
    rng = np.random.default_rng(1)
    points = rng.uniform(-1, 1, (200, 3))
    moved, shifts = points[:20] + 0.02 * rng.standard_normal((20, 3)), 0.1 * rng.standard_normal((60, 3))
    shifts[::3] *= 0.1
    expected = (cdist((moved + shifts[:, None]).reshape(-1, 3), points).min(1) < 0.05).reshape(60, 20).sum(1)
    enough = expected >= 10
    assert 0 < enough.sum() < 60
    counts = HashedPoints(points, 0.05).count_on(moved, shifts, least=10)
    assert (counts[enough] == expected[enough]).all()
    assert (counts[~enough] < 10).all()
