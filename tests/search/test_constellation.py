"""`solve` on few points: LEDs with normals, labels, gravity, a predicted pose; and its errors for bad input."""

from functools import partial
from typing import Any

import numpy as np
import pytest
import torch
from leds import Camera, Frame, Setting, device, frame, picture
from planted import degrees_between
from scipy.spatial.transform import Rotation

from bpnp import GravityPrior, PosePrior, solve, solve_many, verify

CAMERA = Camera().model
UP = np.array([0.0, 0, 1])


def shown(seed: int, background: int = 0) -> tuple[Frame, np.random.Generator]:
    """A headset in a random pose, and a generator that goes on."""
    rng = np.random.default_rng(seed)
    return picture(Setting("headset", "headset", background), seed, rng), rng


def pixels(points: np.ndarray, rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
    return Camera().project(points @ rotation.T + translation)


@pytest.mark.slow
@pytest.mark.parametrize("with_normals", [True, False])
def test_a_device_is_found_among_background_lights(with_normals: bool) -> None:
    right = 0
    for seed in range(10):
        seen, _ = shown(seed, background=3)
        normals = seen.device.normals3d if with_normals else None
        solution = solve(seen.pixels, seen.device.points3d, CAMERA, normals3d=normals)
        good = degrees_between(solution.rotation, seen.rotation) < 3
        assert good or solution.verdict != "confident"
        right += good
        if good:
            assert np.linalg.norm(solution.centre + seen.rotation.T @ seen.translation) < 0.03
            i, j = solution.matches.T
            assert (seen.led[i] == j).mean() > 0.8
    assert right == 10


def test_matches_have_one_label_and_face_the_camera() -> None:
    frame, rng = shown(2, background=6)
    image, led, points, normals = frame.pixels, frame.led, frame.device.points3d, frame.device.normals3d
    colours = rng.integers(0, 3, len(points))
    seen = np.where(led >= 0, colours[led], rng.integers(0, 3, len(led)))
    solution = solve(image, points, CAMERA, normals3d=normals, labels2d=seen, labels3d=torch.as_tensor(colours))
    assert degrees_between(solution.rotation, frame.rotation) < 1
    assert solution.verdict == "confident"
    i, j = solution.matches.T
    np.testing.assert_array_equal(seen[i], colours[j])
    camera = points[j] @ solution.rotation.T + solution.translation
    assert ((camera * (normals[j] @ solution.rotation.T)).sum(-1) < 0).all()
    assert solution.log10_false_alarms < solve(image, points, CAMERA).log10_false_alarms


def test_three_points_are_enough_with_gravity() -> None:
    rng = np.random.default_rng(3)
    points = rng.uniform(-0.1, 0.1, (3, 3))
    rotation, translation = Rotation.from_rotvec([0.2, 0.1, 0.4]).as_matrix(), np.array([0.0, 0, 0.5])
    prior = GravityPrior(rotation @ UP, UP, 0.5)
    solution = solve(pixels(points, rotation, translation), points, CAMERA, prior=prior)
    assert min(degrees_between(candidate.rotation, rotation) for candidate in solution.candidates) < 1
    with pytest.raises(ValueError, match="`points2d` has 3 points; at least 4 are needed"):
        solve(pixels(points, rotation, translation), points, CAMERA)


@pytest.mark.slow
def test_verify_confirms_a_confident_pose_of_a_ring_and_rejects_its_half_turn() -> None:
    """A half turn of a ring maps many of its LEDs near others."""
    rng, checked = np.random.default_rng(45), 0
    for seed in range(12):
        seen = picture(Setting("ring, 3 lights", "ring", 3), seed, rng)
        known: dict[str, Any] = {"camera": CAMERA, "normals3d": seen.device.normals3d, "time_limit": 60}
        solution = solve(seen.pixels, seen.device.points3d, **known)
        if solution.verdict != "confident":
            continue
        checked += 1
        again = verify(seen.pixels, seen.device.points3d, solution.rotation, solution.translation, **known)
        assert again.verdict == "confident", again.reason
        for other in again.candidates[1:]:
            wrong = verify(seen.pixels, seen.device.points3d, other.rotation, other.translation, **known)
            assert wrong.verdict != "confident"
    assert checked >= 10


def pitch_from_the_stand(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Keypoints of a football pitch, metres, a grazing view of some of them, and the camera's rotation."""
    rng = np.random.default_rng([45, seed])
    half = [(52.5, y) for y in (-34, -20.16, -9.16, 9.16, 20.16, 34)] + [(47, -9.16), (47, 9.16), (41.5, 0)]
    half += [(36, y) for y in (-20.16, -7.3, 7.3, 20.16)] + [(9.15, 0)]
    middle = [(0, -34), (0, -9.15), (0, 9.15), (0, 34)]
    points = np.array([(sign * x, y, 0) for sign in (-1, 1) for x, y in half] + [(x, y, 0) for x, y in middle], float)
    centre = np.array([rng.uniform(-10, 10), -80.0, rng.uniform(12, 16)])
    forward = np.array([rng.uniform(-20, 20), 0, 0]) - centre
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, UP) / np.linalg.norm(np.cross(forward, UP))
    rotation = np.array([right, np.cross(forward, right), forward])
    camera = (points - centre) @ rotation.T
    image = 1600 * camera[:, :2] / camera[:, 2:] + (960, 540)
    inside = (image > 0).all(1) & (image < (1920, 1080)).all(1) & (rng.random(len(points)) < 0.8)
    return points, image[inside] + 0.5 * rng.standard_normal((inside.sum(), 2)), rotation


@pytest.mark.nightly
@pytest.mark.parametrize("sigma", [2.0, 10.0, 30.0])
def test_a_right_gravity_prior_finds_what_is_found_without_it(sigma: float) -> None:
    """A tilt of 2.4 degrees moves points of a flat scene that is seen at a low angle by many pixels."""
    for seed in range(10):
        points, image, rotation = pitch_from_the_stand(seed)
        tilted = Rotation.from_rotvec(np.radians(2.4) * rotation[:, [0, 1]] @ [0.8, 0.6]).as_matrix() @ rotation
        prior = GravityPrior(tilted @ UP, UP, sigma)
        solution = solve(image, points, [[1600, 0, 960], [0, 1600, 540], [0, 0, 1]], prior=prior, time_limit=60)
        half_turn = rotation @ np.diag([-1.0, -1, 1])  # of the pitch, which looks the same
        assert solution.verdict != "failed"
        assert min(degrees_between(solution.rotation, right) for right in (rotation, half_turn)) < 1


def test_a_predicted_pose_is_taken_without_a_search_if_it_fits_and_left_if_not() -> None:
    frame, _ = shown(4)
    search = partial(solve, frame.pixels, frame.device.points3d, CAMERA, normals3d=frame.device.normals3d)
    near = Rotation.from_rotvec([0.02, -0.02, 0.02]).as_matrix() @ frame.rotation
    solution = search(prior=PosePrior(near, frame.translation, 2.0, 0.02))
    assert solution.verdict == "confident"
    assert degrees_between(solution.rotation, frame.rotation) < 1
    far = Rotation.from_rotvec([0.0, 1.5, 0.0]).as_matrix() @ frame.rotation
    for prior in (PosePrior(far, frame.translation, 2.0, 0.02), PosePrior(far, frame.translation, 10.0, 0.1)):
        assert degrees_between(search(prior=prior).rotation, frame.rotation) < 1


def test_two_devices_in_one_frame_share_no_led() -> None:
    """Two controllers of one make: each pose is found once, and no light belongs to both."""
    rng = np.random.default_rng(8)
    known = device("ring", 8)
    image = np.concatenate([frame(known, Setting("ring", "ring"), rng).pixels for _ in range(2)])
    search: dict[str, Any] = {"points3d": known.points3d, "camera": CAMERA, "normals3d": known.normals3d}
    solutions = solve_many([image] * 2, **search)
    lights = [set(solution.matches[:, 0].tolist()) for solution in solutions]
    assert min(len(own) for own in lights) >= 6
    assert not lights[0] & lights[1]
    assert sorted(solution.stats.taken2d > 0 for solution in solutions) == [False, True]
    assert solve(image, **search).stats.taken2d == 0


def test_two_devices_share_no_led_with_a_rough_focal_length() -> None:
    rng = np.random.default_rng(8)
    points = rng.uniform(-0.1, 0.1, (14, 3))
    poses = [Rotation.random(random_state=k).as_matrix() for k in range(2)]
    image = np.concatenate([pixels(points, pose, np.array([0.3 * k - 0.15, 0, 0.5])) for k, pose in enumerate(poses)])
    solutions = solve_many([image] * 2, points, CAMERA, focal_error=0.02, time_limit=60)
    assert [solution.verdict for solution in solutions] == ["confident"] * 2
    lights = [set(solution.matches[:, 0].tolist()) for solution in solutions]
    assert sorted(map(sorted, lights)) == [list(range(14)), list(range(14, 28))]
    assert sorted(solution.stats.taken2d for solution in solutions) == [0, 14]
