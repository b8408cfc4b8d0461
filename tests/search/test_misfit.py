"""What a wrong camera or a deformed scene leaves in the residuals, against the poses that planted ones lead to."""

import numpy as np
import pytest
from numpy.typing import NDArray
from planted import directions
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from bpnp import solve
from bpnp.search.evidence.misfit import systematic_misfit
from bpnp.search.point_sets import PointSets

Array = NDArray[np.float64]
CAMERA = np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]])
RNG = np.random.default_rng(11)
POINTS = RNG.uniform(-1, 1, (40, 3))
TURN, SHIFT = Rotation.from_rotvec([0.2, -0.3, 0.1]), np.array([0.1, 0.05, 5.0])
NOISE = 3e-4 * RNG.standard_normal((40, 3))


def fitted(image: Array) -> tuple[Rotation, Array, float]:
    """The pose of known pairs by a general solver, and the scale of its residuals."""

    def residuals(pose: Array) -> Array:
        moved = (TURN * Rotation.from_rotvec(pose[:3])).apply(POINTS) + SHIFT + pose[3:]
        return (image - directions(moved)).ravel()

    end = least_squares(residuals, np.zeros(6), xtol=1e-12)
    return TURN * Rotation.from_rotvec(end.x[:3]), SHIFT + end.x[3:], float(np.sqrt(2 * end.cost / (2 * 40 - 6)))


@pytest.mark.parametrize("wrong", ["focal length", "proportions", "nothing"])
def test_the_misfit_says_how_far_off_the_pose_is(wrong: str) -> None:
    scene = POINTS * (1.06**-0.5, 1.06**-0.5, 1.06) if wrong == "proportions" else POINTS
    camera = TURN.apply(scene) + SHIFT
    if wrong == "focal length":
        camera = camera * (1.04, 1.04, 1)
    image = directions(camera + NOISE)
    turn, shift, scale = fitted(image)
    misfit = systematic_misfit(PointSets(image, POINTS), turn.as_matrix(), shift, scale, 40.0)
    if wrong == "nothing":
        assert misfit == (0.0, 0.0)
        return
    moved = np.linalg.norm(turn.apply(np.median(POINTS, 0)) + shift - TURN.apply(np.median(POINTS, 0)) - SHIFT)
    off = (TURN.inv() * turn).magnitude(), moved / np.linalg.norm(SHIFT)
    if wrong == "focal length":
        assert misfit == pytest.approx(off, rel=0.3, abs=2e-3)
    else:  # another focal length is a worse explanation, by which the pose were farther off
        assert misfit.turn > 0.7 * off[0]
        assert misfit.shift > 0.7 * off[1]


@pytest.mark.parametrize("focal", [0.6, 1.5])
def test_points_seen_by_another_camera_are_not_confident(focal: float) -> None:
    camera = TURN.apply(POINTS) + SHIFT
    pixels = camera[:, :2] / camera[:, 2:] * 500 * focal + (320, 240) + 0.3 * RNG.standard_normal((40, 2))
    assert solve(pixels, POINTS, CAMERA).verdict != "confident"
