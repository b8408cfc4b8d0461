"""`solve` on few points: LEDs with normals, labels, gravity, a predicted pose; and what it says of bad input."""

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from planted import degrees_between
from scipy.spatial.transform import Rotation

from bpnp import GravityPrior, PosePrior, solve, solve_many

Array = NDArray[np.float64]
CAMERA = np.array([[600.0, 0, 320], [0, 600, 240], [0, 0, 1]])
UP = np.array([0.0, 0, 1])


def device(rng: np.random.Generator, count: int) -> tuple[Array, Array]:
    """LEDs on a ball of 10 cm, and their normals."""
    normals = rng.standard_normal((count, 3))
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    return 0.1 * normals * rng.uniform(0.7, 1.0, (count, 1)), normals


def pixels(points: Array, rotation: Array, translation: Array) -> Array:
    camera = points @ rotation.T + translation
    return 600 * camera[:, :2] / camera[:, 2:] + [320, 240]


def frame(
    rng: np.random.Generator, points: Array, normals: Array, *, background: int = 0, noise: float = 0.2
) -> tuple[Array, Array, Array, NDArray[np.int64]]:
    """Pixels, pose and the LED of each pixel (-1) of a picture in which LEDs that face away are hidden."""
    facing, translation = np.zeros(len(points), np.bool_), np.array([0.02, -0.03, 0.5])
    while facing.sum() < 8:
        rotation = Rotation.random(random_state=rng.integers(2**31)).as_matrix()
        camera = points @ rotation.T + translation
        facing = (camera * (normals @ rotation.T)).sum(-1) < -0.3 * np.linalg.norm(camera, axis=-1)
    led = np.concatenate([np.flatnonzero(facing), np.full(background, -1)])
    seen = pixels(points[facing], rotation, translation) + noise * rng.standard_normal((facing.sum(), 2))
    lights = rng.uniform([150, 80], [500, 400], (background, 2))
    order = rng.permutation(len(led))
    return np.concatenate([seen, lights])[order], rotation, translation, led[order]


@pytest.mark.parametrize("with_normals", [True, False])
def test_a_device_among_background_lights(with_normals: bool) -> None:
    right = 0
    for seed in range(10):
        rng = np.random.default_rng(seed)
        points, normals = device(rng, 20)
        image, rotation, translation, led = frame(rng, points, normals, background=3)
        solution = solve(image, points, CAMERA, normals3d=normals if with_normals else None)
        good = degrees_between(solution.rotation, rotation) < 3
        assert good or solution.verdict != "confident"
        right += good
        if good:
            assert np.linalg.norm(solution.centre + rotation.T @ translation) < 0.03
            i, j = solution.matches.T
            assert (led[i] == j).mean() > 0.8
    assert right == 10


def test_a_device_that_looks_the_same_from_two_sides_is_ambiguous() -> None:
    """A half turn about z maps the points onto themselves: both poses are candidates."""
    rng = np.random.default_rng(1)
    half = rng.uniform(-0.1, 0.1, (5, 3))
    points = np.concatenate([half, half * [-1, -1, 1]])
    rotation, translation = Rotation.from_rotvec([0.5, 0.3, 0.8]).as_matrix(), np.array([0.0, 0.05, 0.6])
    solution = solve(pixels(points, rotation, translation), points, CAMERA)
    assert solution.verdict == "ambiguous"
    twin = rotation @ np.diag([-1.0, -1, 1])
    for pose in (rotation, twin):
        assert min(degrees_between(candidate.rotation, pose) for candidate in solution.candidates) < 1


def test_matches_have_one_label_and_face_the_camera() -> None:
    rng = np.random.default_rng(2)
    points, normals = device(rng, 24)
    image, rotation, _, led = frame(rng, points, normals, background=6)
    colours = rng.integers(0, 3, len(points))
    seen = np.where(led >= 0, colours[led], rng.integers(0, 3, len(led)))
    solution = solve(image, points, CAMERA, normals3d=normals, labels2d=seen, labels3d=torch.as_tensor(colours))
    assert degrees_between(solution.rotation, rotation) < 1
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
    with pytest.raises(ValueError, match="expected 4 or more points in `points2d`, got 3"):
        solve(pixels(points, rotation, translation), points, CAMERA)


def test_a_predicted_pose_is_taken_without_a_search_if_it_fits_and_left_if_not() -> None:
    rng = np.random.default_rng(4)
    points, normals = device(rng, 24)
    image, rotation, translation, _ = frame(rng, points, normals)
    near = Rotation.from_rotvec([0.02, -0.02, 0.02]).as_matrix() @ rotation
    solution = solve(image, points, CAMERA, normals3d=normals, prior=PosePrior(near, translation, 2.0, 0.02))
    assert solution.verdict == "confident"
    assert degrees_between(solution.rotation, rotation) < 0.5
    far = Rotation.from_rotvec([0.0, 1.5, 0.0]).as_matrix() @ rotation
    lost = solve(image, points, CAMERA, normals3d=normals, prior=PosePrior(far, translation, 2.0, 0.02))
    assert degrees_between(lost.rotation, rotation) < 0.5
    rough = solve(image, points, CAMERA, normals3d=normals, prior=PosePrior(far, translation, 10.0, 0.1))
    assert degrees_between(rough.rotation, rotation) < 0.5


def test_two_devices_in_one_picture_share_no_light() -> None:
    """Two controllers of one make: each pose is found once, and no light belongs to both."""
    rng = np.random.default_rng(8)
    points, normals = device(rng, 20)
    pictures = [frame(rng, points, normals) for _ in range(2)]
    image = np.concatenate([picture[0] + [100 * sign, 0] for picture, sign in zip(pictures, (-1, 1), strict=True)])
    solutions = solve_many([image] * 2, points, CAMERA, normals3d=normals)
    lights = [set(solution.matches[:, 0].tolist()) for solution in solutions]
    assert min(len(own) for own in lights) >= 6
    assert not lights[0] & lights[1]
    assert sorted(solution.stats.taken2d > 0 for solution in solutions) == [False, True]
    alone = solve(image, points, CAMERA, normals3d=normals)
    assert alone.stats.taken2d == 0
