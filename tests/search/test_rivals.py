"""What may contradict a pose that passes every test: a second body, a reflection, a mirrored image, repeated boards."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from planted import degrees_between
from scipy.spatial.transform import Rotation

from bpnp import GravityPrior, PosePrior, solve, verify

Array = NDArray[np.float64]
K = np.array([[800.0, 0, 320], [0, 800, 240], [0, 0, 1]])
AWAY = np.array([0.0, 0, 12])


def pixels(points: Array, rotation: Array, translation: Array, rng: np.random.Generator, noise: float = 0.3) -> Array:
    camera = points @ rotation.T + translation
    return camera[:, :2] / camera[:, 2:] * 800 + [320, 240] + rng.normal(0, noise, (len(points), 2))


def shuffled(rng: np.random.Generator, *parts: Array) -> Array:
    return rng.permutation(np.concatenate(parts))


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("moved", [True, False])
def test_furniture_that_was_moved_in_a_room_is_no_confident_pose(seed: int, moved: bool) -> None:
    """A room of 24 points, 10 seen, with 13 points of a chair that all are: the chair has the most matches."""
    rng = np.random.default_rng(seed)
    room, chair = rng.uniform(-3, 3, (24, 3)), rng.normal(0, 0.5, (13, 3))
    turn, rotation = (
        Rotation.from_euler("z", 70, degrees=True).as_matrix(),
        Rotation.random(random_state=seed).as_matrix(),
    )
    seen = chair @ turn.T + [0.8, 0.5, 0] if moved else chair
    image = shuffled(rng, *(pixels(each, rotation, AWAY, rng) for each in (room[:10], seen)))
    solution = solve(image, np.concatenate([room, chair]), K)
    if moved:
        assert solution.verdict != "confident"
        assert min(degrees_between(one.rotation, rotation) for one in solution.candidates) < 3
        assert solution.reason_code == "second_body"
        assert solution.reason.startswith("Two bodies: ")
    else:
        assert solution.verdict == "confident"
        assert degrees_between(solution.rotation, rotation) < 2


@pytest.mark.parametrize("seed", range(3))
def test_the_body_of_more_than_half_of_the_scene_is_confident_beside_another_one(seed: int) -> None:
    rng = np.random.default_rng(seed)
    large, small = rng.normal(size=(24, 3)), rng.normal(0, 0.5, (10, 3)) + [2, 0, 0]
    rotation, turn = (Rotation.random(random_state=seed + k).as_matrix() for k in (0, 50))
    image = shuffled(rng, pixels(large[:22], rotation, AWAY, rng), pixels(small @ turn.T, rotation, AWAY, rng))
    solution = solve(image, np.concatenate([large, small]), K)
    assert solution.verdict == "confident"
    assert degrees_between(solution.rotation, rotation) < 2


@pytest.mark.parametrize("seed", range(4))
def test_an_object_and_its_reflection_in_the_floor_are_ambiguous(seed: int) -> None:
    """A mirror-symmetric object of 16 points, 10 of them seen, and its reflection, which shows more."""
    rng = np.random.default_rng(seed)
    half = rng.uniform([0.1, -0.5, 0.1], [0.6, 0.5, 1.2], (8, 3))
    points = np.concatenate([half, half * [-1, 1, 1]])
    rotation = Rotation.from_euler("xyz", [-110, rng.uniform(-20, 20), 5], degrees=True).as_matrix()
    image = shuffled(
        rng, pixels(points[3:13], rotation, AWAY / 2, rng), pixels((points * [1, 1, -1])[1:], rotation, AWAY / 2, rng)
    )
    assert solve(image, points, K).verdict != "confident"
    without = solve(shuffled(rng, pixels(points[3:13], rotation, AWAY / 2, rng)), points, K)
    assert without.reason_code != "second_body"


@pytest.mark.parametrize("seed", range(4))
def test_a_mirrored_photo_of_a_nearly_symmetric_object_says_so(seed: int) -> None:
    rng = np.random.default_rng(seed)
    half = rng.uniform([0.1, -1, -0.4], [0.7, 1, 0.4], (11, 3))
    points = np.concatenate([half, half * [-1, 1, 1], rng.normal(size=(4, 3)) * [0.4, 0.8, 0.4]])
    rotation = Rotation.from_euler("xyz", rng.uniform(-25, 25, 3), degrees=True).as_matrix()
    image = pixels(points, rotation, AWAY / 2, rng)
    flipped = solve(image * [-1, 1] + [640, 0], points, K)
    assert (flipped.verdict, flipped.reason_code) == ("ambiguous", "mirrored_image")
    straight = solve(image, points, K)
    assert straight.verdict == "confident"
    assert degrees_between(straight.rotation, rotation) < 2


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("degrees", [None, 3.0])
def test_two_boards_are_not_shifted_by_a_column(seed: int, degrees: float | None) -> None:
    """Two boards of 4 x 4 corners and ten other points, 30 degrees wide."""
    rng = np.random.default_rng(seed)
    grid = np.stack(np.meshgrid(np.arange(4) * 0.1, np.arange(4) * 0.1, [0.0]), -1).reshape(-1, 3)
    boards = [
        grid @ Rotation.from_euler("xy", rng.uniform(-20, 20, 2), degrees=True).as_matrix().T + [x, 0.2, 5]
        for x in (-1.4, 0.6)
    ]
    depth = rng.uniform(5, 30, (10, 1))
    points = np.concatenate([*boards, np.column_stack([rng.uniform(-0.3, 0.3, (10, 2)) * depth, depth])])
    rotation, translation = Rotation.from_rotvec(rng.normal(0, 0.02, 3)).as_matrix(), rng.normal(0, 0.05, 3)
    image = shuffled(rng, pixels(points, rotation, translation, rng, noise=1.0))
    prior = None if degrees is None else PosePrior(np.eye(3), np.zeros(3), degrees, 0.1)
    solution = solve(image, points, K, prior=prior)
    assert solution.verdict != "confident" or solution.inlier_count > 35
    if solution.verdict == "confident":
        assert degrees_between(solution.rotation, rotation) < 0.5


@pytest.mark.parametrize("count", [9, 20])
@pytest.mark.parametrize("known", [False, True])
def test_a_pose_that_was_searched_on_unrelated_points_is_not_confirmed(count: int, known: bool) -> None:
    for seed in range(6):
        rng = np.random.default_rng(seed)
        image, points = rng.uniform([0, 0], [640, 480], (count, 2)), rng.normal(size=(count, 3))
        found = solve(image, points, K)
        options: dict[str, Any] = {"matches": found.matches} if known else {}
        assert verify(image, points, found.rotation, found.translation, K, **options).verdict == "failed"


def test_few_points_are_enough_for_a_pose_from_elsewhere() -> None:
    """Six of six points: a search needs more, one test does not."""
    rng = np.random.default_rng(1)
    points = rng.normal(size=(6, 3))
    image = pixels(points, np.eye(3), AWAY, rng)
    searched, surveyed = (verify(image, points, np.eye(3), AWAY, K, independent=each) for each in (False, True))
    assert surveyed.verdict == "confident"
    assert surveyed.log10_false_alarms < searched.log10_false_alarms - 2


def test_a_true_pose_among_clutter_has_no_competitor_of_a_few_matches() -> None:
    for seed in range(6):
        rng = np.random.default_rng(seed)
        points, rotation = rng.normal(size=(20, 3)), Rotation.random(random_state=seed).as_matrix()
        image = shuffled(rng, pixels(points, rotation, AWAY, rng), rng.uniform([100, 100], [540, 380], (10, 2)))
        for independent in (False, True):
            assert verify(image, points, rotation, AWAY, K, independent=independent).verdict == "confident"


def test_a_pose_far_from_its_prior_says_so_and_is_not_confident() -> None:
    rng = np.random.default_rng(3)
    points, rotation = rng.normal(size=(20, 3)), Rotation.random(random_state=3).as_matrix()
    image = pixels(points, rotation, AWAY, rng)
    near, far = (solve(image, points, K, prior=PosePrior(rotation, AWAY + [x, 0, 0], 5.0, 0.1)) for x in (0.2, 2.0))
    assert near.verdict == "confident"
    assert (far.verdict, far.reason_code) == ("ambiguous", "contradicts_prior")
    assert "It is 20 standard deviations from the given prior" in far.reason
    assert degrees_between(far.rotation, rotation) < 1


def test_gravity_weighs_the_mirror_pose_of_a_flat_scene_too() -> None:
    """Six corners of a court whose matches are known, seen from 30 metres: upside down, they fit nearly as well."""
    rng = np.random.default_rng(0)
    court = np.array([[x, y, 0.0] for x in (-3, 3) for y in (-6.7, 0, 6.7)])
    rotation = Rotation.from_euler("x", 100, degrees=True).as_matrix()
    image = pixels(court, rotation, np.array([0, 1.5, 30.0]), rng, noise=2.0)
    up = rotation @ [0, 0, 1]
    ids = np.arange(6)
    plain, upright = (
        solve(image, court, K, labels2d=ids, labels3d=ids, prior=prior)
        for prior in (None, GravityPrior(up, [0, 0, 1], 3))
    )
    margins = [one.candidates[1].log10_false_alarms - one.log10_false_alarms for one in (plain, upright)]
    assert upright.inlier_count == plain.inlier_count == 6
    assert upright.log10_false_alarms < plain.log10_false_alarms
    assert margins[1] > margins[0] + 1


def test_residuals_above_the_match_radius_are_tried_with_a_larger_one() -> None:
    """40 corners, clicked to 4 pixels; with a given radius the reason names a larger one."""
    rng = np.random.default_rng(5)
    points, rotation = rng.normal(size=(40, 3)), Rotation.random(random_state=5).as_matrix()
    image = rng.permutation(pixels(points, rotation, AWAY, rng, noise=3.5))
    solution = solve(image, points, K)
    assert solution.verdict == "confident"
    assert solution.inlier_count > 34
    assert degrees_between(solution.rotation, rotation) < 2


@pytest.mark.parametrize("far", [1e3, 1e9])
def test_one_point_far_away_changes_nothing(far: float) -> None:
    rng = np.random.default_rng(4)
    points, rotation = rng.normal(size=(30, 3)), Rotation.random(random_state=4).as_matrix()
    image = pixels(points[1:], rotation, AWAY, rng)
    points[0] = far
    for solution in (solve(image, points, K), verify(image, points, rotation, AWAY, K)):
        assert solution.verdict == "confident"
        assert degrees_between(solution.rotation, rotation) < 1


def cells(rng: np.random.Generator) -> Array:
    """Corners of the black cells of a marker of 7 x 7 cells with a random content, and those of its frame."""
    black = np.pad(rng.random((7, 7)) < 0.5, 1)
    touched = black[1:, 1:] + black[1:, :-1] + 0 + black[:-1, 1:] + black[:-1, :-1]
    whole = touched & ~(black[1:, 1:] & black[1:, :-1] & black[:-1, 1:] & black[:-1, :-1])
    corners = np.argwhere(whole)
    frame = np.array([(-1, -1), (-1, 8), (8, -1), (8, 8)])
    return np.pad(np.concatenate([corners, frame]).astype(np.float64), ((0, 0), (0, 1)))


@pytest.mark.parametrize("seed", range(4))
def test_a_marker_with_another_content_is_no_confident_pose(seed: int) -> None:
    """The marker of the scene is confident, also where a tenth of its corners are not in the scene."""
    rng = np.random.default_rng(seed)
    marker, other = cells(rng), cells(rng)
    rotation = Rotation.from_euler("xyz", [170, rng.uniform(-25, 25), rng.uniform(0, 360)], degrees=True).as_matrix()
    away = np.array([0, 0, 20.0]) - rotation @ [3.5, 3.5, 0]
    shown, another = (rng.permutation(pixels(each, rotation, away, rng)) for each in (marker, other))
    assert solve(another, marker, K).verdict != "confident"
    for scene in (marker, marker[rng.permutation(len(marker))[: -len(marker) // 10]]):
        solution = solve(shown, scene, K)
        assert solution.verdict == "confident"
        assert degrees_between(solution.rotation, rotation) < 2


def test_a_lattice_with_another_content_is_the_reason() -> None:
    codes = set()
    for seed in range(6):
        rng = np.random.default_rng(seed)
        marker, other = cells(rng), cells(rng)
        codes.add(solve(pixels(other, np.diag([1.0, -1, -1]), AWAY * 2, rng), marker, K).reason_code)
    assert "other_content" in codes


@pytest.mark.parametrize("seed", range(8))
def test_points_of_an_ellipse_do_not_slide_along_it(seed: int) -> None:
    rng = np.random.default_rng(seed)
    angle = rng.uniform(0, 2 * np.pi, 16)
    points = np.stack([np.cos(angle), 0.6 * np.sin(angle), np.zeros(16)], -1)
    rotation = Rotation.from_euler("xyz", [160, rng.uniform(-40, 40), rng.uniform(0, 360)], degrees=True).as_matrix()
    clutter = rng.uniform([250, 180], [390, 300], (2, 2))
    solution = solve(shuffled(rng, pixels(points[:14], rotation, AWAY / 2, rng), clutter), points, K)
    if solution.verdict == "confident":
        assert degrees_between(solution.rotation, rotation) < 5


@pytest.mark.parametrize("seed", range(3))
def test_a_pose_of_one_part_of_the_scene_is_not_that_of_the_scene(seed: int) -> None:
    """Of a room three points are seen, too few for a pose, and all of a chair that was moved."""
    rng = np.random.default_rng(seed)
    room, chair = rng.uniform(-3, 3, (30, 3)), rng.normal(0, 0.5, (14, 3))
    room *= 3 / abs(room).max(1, keepdims=True)  # on its walls
    turn = Rotation.from_euler("z", 70, degrees=True).as_matrix()
    rotation, points = Rotation.random(random_state=seed).as_matrix(), np.concatenate([room, chair])
    image = shuffled(
        rng,
        pixels(room[:3], rotation, AWAY, rng),
        rng.uniform([100, 100], [540, 380], (3, 2)),
        pixels(chair @ turn.T + [0.8, 0.5, 0], rotation, AWAY, rng),
    )
    solution = solve(image, points, K)
    assert (solution.verdict, solution.reason_code) == ("ambiguous", "one_part")


def test_a_given_pose_of_the_smaller_body_is_no_confident_one() -> None:
    """The other body is more likely by far more decades than other candidates are kept for."""
    rng = np.random.default_rng(2)
    room, chair = rng.uniform(-3, 3, (24, 3)), rng.normal(0, 0.5, (16, 3))
    turn = Rotation.from_euler("z", 70, degrees=True).as_matrix()
    image = shuffled(
        rng, pixels(room[:9], np.eye(3), AWAY, rng), pixels(chair @ turn.T + [0.8, 0.5, 0], np.eye(3), AWAY, rng)
    )
    solution = verify(image, np.concatenate([room, chair]), np.eye(3), AWAY, K)
    assert solution.verdict != "confident"
    assert degrees_between(solution.rotation, np.eye(3)) < 1


def test_the_claim_on_a_flat_scene_names_the_camera() -> None:
    rng = np.random.default_rng(6)
    points = rng.uniform(-1, 1, (20, 3))
    rotation = Rotation.from_euler("xy", [150, 20], degrees=True).as_matrix()
    for scene, is_flat in ((points * [1, 1, 0], True), (points, False)):
        solution = solve(pixels(scene, rotation, AWAY / 2, rng), scene, K)
        assert solution.verdict == "confident"
        assert ("the scene is flat, so a wrong focal length would not show" in solution.reason) == is_flat


def test_a_camera_of_other_images_is_named() -> None:
    points = np.random.default_rng(6).uniform(-1, 1, (20, 3))
    image = pixels(points, np.eye(3), AWAY, np.random.default_rng(0))
    with pytest.raises(
        ValueError, match=r"principal point at \(320, 240\), far from the centre of an image of 1280 x 960"
    ):
        solve(image, points, K, image_size=(1280, 960))
    with pytest.raises(ValueError, match="exclude each other"):
        solve(image, points, K, image_size=(640, 480))
