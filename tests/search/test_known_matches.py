"""Known matches, options of few points, and mirrored scenes, against OpenCV's poses and planted ones."""

from typing import Any

import cv2
import numpy as np
import pytest
from planted import degrees_between
from scipy.spatial.transform import Rotation

import bpnp

CAMERA = np.array([[1000.0, 0, 640], [0, 1000, 480], [0, 0, 1]])


def pixels(points: np.ndarray, rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
    seen = (points @ rotation.T + translation) @ CAMERA.T
    return seen[:, :2] / seen[:, 2:]


def known(seed: int, count: int, noise: float, *, flat: bool = False) -> Any:
    """Return points, their pixels with noise (pixels), and the planted pose."""
    rng = np.random.default_rng([seed, count])
    points = rng.uniform(-1, 1, (count, 3)) * (1, 1, not flat)
    rotation, translation = Rotation.random(random_state=seed).as_matrix(), np.array([0, 0, 6.0])
    image = pixels(points, rotation, translation) + noise * rng.standard_normal((count, 2))
    return points, image, rotation, translation


def opencv_error(points: np.ndarray, image: np.ndarray, flat: bool) -> float:
    """The least sum of squared residuals, pixels, of OpenCV's solvers, each refined."""
    least = np.inf
    for method in [cv2.SOLVEPNP_SQPNP] + [cv2.SOLVEPNP_IPPE] * flat:
        _, turns, shifts, _ = cv2.solvePnPGeneric(points, image, CAMERA, None, flags=method)
        for turn, shift in zip(turns, shifts, strict=True):
            turn, shift = cv2.solvePnPRefineLM(points, image, CAMERA, None, turn.copy(), shift.copy())
            seen = pixels(points, cv2.Rodrigues(turn)[0], shift.ravel())
            least = min(least, float(((seen - image) ** 2).sum()))
    return least


@pytest.mark.slow
@pytest.mark.parametrize("flat", [False, True])
@pytest.mark.parametrize("count", [4, 5, 6, 20])
@pytest.mark.parametrize("noise", [1.0, 10.0])
def test_known_matches_have_a_pose_with_the_residual_that_opencv_finds(count: int, noise: float, flat: bool) -> None:
    for seed in range(4):
        points, image, *_ = known(seed, count, noise, flat=flat)
        order = np.random.default_rng(seed).permutation(count)
        solution = bpnp.solve(image[order], points, CAMERA, labels2d=order + 7, labels3d=np.arange(count) + 7)
        assert solution.found
        left = ((pixels(points, solution.rotation, solution.translation) - image) ** 2).sum()
        assert left < 1.05 * opencv_error(points, image, flat) + 1e-9


def test_a_rotation_of_known_matches_is_within_its_bound_and_confident() -> None:
    confident = 0
    for seed in range(20):
        points, image, rotation, _ = known(seed, 8, 3.0)
        solution = bpnp.solve(image, points, CAMERA, labels2d=np.arange(8), labels3d=np.arange(8))
        if solution.verdict == "confident":
            confident += 1
            assert degrees_between(solution.rotation, rotation) < 6 * solution.rotation_std_deg
    assert confident >= 15


def test_some_known_matches_may_be_wrong() -> None:
    for seed in range(6):
        points, image, rotation, _ = known(seed, 12, 1.0)
        labels = np.arange(12)
        labels[:6] = np.roll(labels[:6], 1)
        solution = bpnp.solve(image, points, CAMERA, labels2d=labels, labels3d=np.arange(12))
        assert degrees_between(solution.rotation, rotation) < 2
        assert set(solution.matches[:, 0]) == set(range(6, 12))


def test_known_matches_with_a_prior_have_a_pose() -> None:
    points, image, rotation, _ = known(1, 6, 10.0)
    gravity = bpnp.GravityPrior(rotation @ [0, 0, 1.0], [0, 0, 1.0], 2.0)
    solution = bpnp.solve(image, points, CAMERA, labels2d=np.arange(6), labels3d=np.arange(6), prior=gravity)
    assert degrees_between(solution.rotation, rotation) < 10


@pytest.mark.slow
def test_the_inlier_threshold_is_the_radius_of_an_enumeration() -> None:
    """Noise of 5 pixels is beyond the 3 pixels within which few points are matched by default."""
    right = {None: 0, 30.0: 0}
    for seed in range(8):
        points, image, rotation, _ = known(seed, 9, 5.0)
        for threshold in right:
            solution = bpnp.solve(image[::-1], points, CAMERA, inlier_threshold=threshold, solver="search")
            right[threshold] += solution.verdict != "failed" and degrees_between(solution.rotation, rotation) < 6
    assert right[30.0] >= 7
    assert right[None] <= 4


def test_clutter_and_scores_count_for_few_points() -> None:
    """A right expectation makes a pose less likely by chance, and a wrong one more likely."""
    rng = np.random.default_rng(5)
    points, image, rotation, _ = known(5, 14, 0.3)
    image = np.concatenate([image[:8], rng.uniform(image.min(0), image.max(0), (6, 2))])

    def alarms(**options: Any) -> float:
        solution = bpnp.solve(image, points, CAMERA, solver="search", **options)
        assert degrees_between(solution.rotation, rotation) < 1
        return solution.log10_false_alarms

    assert alarms(clutter=6 / 14) < alarms() < alarms(clutter=0.95)
    likely = np.where(np.arange(14) < 8, 1.0, 0.1)
    assert alarms(scores2d=likely) < alarms() < alarms(scores2d=1.1 - likely)
    assert alarms(scores3d=likely) < alarms() < alarms(scores3d=1.1 - likely)


@pytest.mark.nightly
def test_a_scene_whose_mirror_image_fits_is_named() -> None:
    """Axes of the wrong handedness: no pose fits, and the reason names it; not for points that are unrelated."""
    named = []
    for seed in range(6):
        points, image, *_ = known(seed, 12, 0.3)
        for scene in (points * [1, 1, -1], np.random.default_rng(seed).permutation(points.ravel()).reshape(-1, 3)):
            solution = bpnp.solve(image[::-1], scene, CAMERA, solver="search", time_limit=30)
            assert solution.verdict != "confident"
            named.append("mirror image of the scene has a significant pose" in solution.reason)
    assert named == [True, False] * 6
