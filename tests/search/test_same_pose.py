"""Equality of poses, on planted rotations and shifts."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bpnp.poses import SAME, same_pose
from bpnp.search.problem import Problem


@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e6])
@pytest.mark.parametrize(
    ("degrees", "shift", "expected"),
    [
        (1.9, (0.0, 0, 0), True),
        (2.1, (0.0, 0, 0), False),
        (0.0, (0.24, 0, 0), True),
        (0.0, (0.26, 0, 0), False),
        (0.0, (0.0, 0, 0.24), True),
        (0.0, (0.0, 0, -0.27), False),
    ],
)
def test_a_pose_is_the_same_up_to_two_degrees_and_a_twentieth_of_the_distance(
    unit: float, degrees: float, shift: tuple[float, ...], expected: bool
) -> None:
    """Five units away, whatever these are; turned about the middle of the scene, which lies off its origin."""
    points = unit * (np.random.default_rng(0).uniform(-1, 1, (30, 3)) + [30, 0, 0])
    centroid = np.median(points, 0)
    turn = Rotation.from_euler("y", degrees, degrees=True).as_matrix()
    seen = unit * np.array([0.0, 0, 5])
    rotations = np.stack([np.eye(3), turn])
    translations = np.stack([seen - centroid, seen + unit * np.array(shift) - turn @ centroid])
    poses = rotations, translations
    assert same_pose((rotations[0], translations[0]), *poses, centroid).tolist() == [True, expected]
    bearings = (points - centroid + seen) / np.linalg.norm(points - centroid + seen, axis=1, keepdims=True)
    problem = Problem.of(bearings, points)
    rotations, translations = problem.from_user(*poses)
    first = rotations[0], translations[0]
    assert problem.same_as(first, rotations, translations).tolist() == [True, expected]
    assert problem.same_as(first, rotations, translations, SAME.times(2)).all()
