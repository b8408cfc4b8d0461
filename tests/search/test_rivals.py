"""A wrong camera is met by a search for the focal length and named by the verdict."""

import re

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from bpnp import solve

FOCAL = 800.0


def seen(rng: np.random.Generator) -> tuple[NDArray[np.float64], NDArray[np.float64], Rotation, NDArray[np.float64]]:
    """Pixels (240, 2) of half of the points (240, 3), with a noise of a pixel, and as many others; the pose."""
    points = rng.uniform(-1, 1, (240, 3)) * (1, 1, 0.5)
    turn, shift = Rotation.from_rotvec(0.5 * rng.standard_normal(3)), np.array([0, 0, 3.0])
    camera = turn.apply(points[:120]) + shift
    pixels = FOCAL * camera[:, :2] / camera[:, 2:] + rng.standard_normal((120, 2))
    return np.r_[pixels, rng.uniform(pixels.min(0), pixels.max(0), (120, 2))], points, turn, shift


def test_the_verdict_names_a_wrong_focal_length() -> None:
    pixels, points, turn, shift = seen(np.random.default_rng(1))
    right, wrong = (solve(pixels, points, np.diag([focal, focal, 1])) for focal in (FOCAL, 1.25 * FOCAL))
    assert right.verdict == "confident"
    assert np.linalg.norm(right.translation - shift) < 0.05
    assert wrong.verdict == "ambiguous"
    named = re.search(r"with ([\d.]+) times the focal length", wrong.reason)
    assert named is not None
    assert float(named[1]) == pytest.approx(0.8, rel=0.03)
