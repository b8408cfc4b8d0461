"""`solve(..., at_infinity=True)`: planted rotations, laws, rejected poses, and the errors for bad input."""

import math
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bench_stars import SIZE, Frame, frame, lens
from planted import degrees_between
from scipy.spatial.transform import Rotation

from bpnp import Solution, solve
from bpnp.cameras import camera_from

look = partial(solve, at_infinity=True, time_limit=math.inf)


def sky(seed: int, *, field: float = 40.0, count: int = 600, false: float = 0.3) -> Frame:
    return frame(count, field, 9, seed, false)


@pytest.mark.slow
@pytest.mark.parametrize(("field", "count"), [(12.0, 4000), (40.0, 600), (75.0, 300), (180.0, 200), (220.0, 900)])
def test_a_planted_rotation_of_stars_is_found(field: float, count: int) -> None:
    for seed in range(3):
        image, directions, rotation, star = sky(seed, field=field, count=count)
        solution = look(image, directions, lens(field).model, seed=seed)
        assert solution.verdict == "confident", solution.reason
        assert degrees_between(solution.rotation, rotation) < 0.05
        assert solution.translation.tolist() == [0, 0, 0]
        i, j = solution.matches.T
        assert (star[i] == j).mean() > 0.97
        assert len(i) > 0.95 * (star >= 0).sum()
        assert solution.reprojection_error < 1
        assert 0 < solution.rotation_std_deg < 0.03
        assert solution.covariance.shape == (3, 3)


def test_bearings_and_normalised_points_are_as_good_as_pixels() -> None:
    image, directions, rotation, _ = sky(0)
    bearings = camera_from(lens(40.0).model).bearings(image)
    for points in (bearings, bearings[:, :2] / bearings[:, 2:]):
        solution = look(points, directions)
        assert solution.verdict == "confident"
        assert degrees_between(solution.rotation, rotation) < 0.02


@pytest.mark.nightly
def test_noise_and_a_mirrored_image_of_stars_are_not_confident() -> None:
    """Points that are not stars, and the image in a mirror, which has the same angles."""
    image, directions, _, _ = sky(0, count=300)
    noise = np.random.default_rng(0).uniform(0, SIZE, image.shape)
    for points in (noise, [SIZE, 0] + image * [-1, 1]):
        solution = look(points, directions, lens(40.0).model)
        assert solution.verdict != "confident"
        assert solution.log10_false_alarms > -2
    assert look(noise, directions, lens(40.0).model, focal_error=0.03).verdict != "confident"


def test_a_star_pattern_that_occurs_twice_in_the_catalogue_is_ambiguous() -> None:
    for seed in range(3):
        image, directions, rotation, star = sky(seed, count=300)
        part, turn = directions[star[star >= 0]], Rotation.random(random_state=seed).as_matrix()
        solution = look(image, np.concatenate([part, part @ turn.T]), lens(40.0).model)
        assert solution.verdict == "ambiguous"
        assert "Another rotation" in solution.reason
        either = [
            min(degrees_between(one.rotation, r) for r in (rotation, rotation @ turn.T))
            for one in solution.candidates[:2]
        ]
        assert max(either) < 0.1
        assert degrees_between(solution.candidates[0].rotation, solution.candidates[1].rotation) > 1


@pytest.mark.slow
@pytest.mark.parametrize("field", [40.0, 180.0])
@pytest.mark.parametrize("factor", [0.8, 0.95, 1.02, 1.1])
def test_a_wrong_focal_length_is_no_confident_wrong_rotation(factor: float, field: float) -> None:
    image, directions, rotation, _ = sky(round(100 * factor), field=field, count=500)
    solution = look(image, directions, lens(field, factor).model)
    assert solution.verdict != "confident" or degrees_between(solution.rotation, rotation) < 0.1


@pytest.mark.nightly
@pytest.mark.parametrize(("factor", "shift"), [(1.01, (0, 0)), (1.0, (40, -25))], ids=["focal length", "centre"])
def test_rotations_that_fit_parts_of_a_fisheye_image_are_a_wrong_camera(factor: float, shift: tuple[int, int]) -> None:
    """The focal length is 1 % too long, or the principal point 47 pixels off: no rotation fits the whole image."""
    image, directions, rotation, _ = sky(0, field=180.0, count=3000)
    solution = look(image + shift, directions, lens(180.0, factor).model)
    assert degrees_between(solution.rotation, rotation) > 0.3
    assert (solution.verdict, solution.reason_code) == ("ambiguous", "other_camera_by_pixels")


@pytest.mark.nightly
@pytest.mark.parametrize(("field", "count", "factor"), [(40.0, 600, 0.85), (180.0, 300, 1.1), (220.0, 200, 1.02)])
def test_an_unknown_focal_length_is_found_with_the_rotation(field: float, count: int, factor: float) -> None:
    image, directions, rotation, _ = sky(4, field=field, count=count)
    focal = lens(field).focal
    solution = look(image, directions, lens(field, factor).model, focal_error=0.1)
    assert solution.verdict == "confident", solution.reason
    assert degrees_between(solution.rotation, rotation) < 0.05
    assert solution.covariance.shape == (4, 4)
    assert solution.parameters == ("rotation_x", "rotation_y", "rotation_z", "focal_length")
    assert abs(solution.focal_length - focal) < 4 * solution.focal_length_std < 0.002 * focal
    assert math.isnan(solution.centre_std)


@pytest.mark.nightly
def test_an_unknown_focal_length_is_found_with_a_threshold_of_the_noise() -> None:
    """The coarse search has a wrong focal length, whose residuals are many times the threshold."""
    image, directions, rotation, star = sky(4)
    model = lens(40.0, 1.03).model
    solution = look(image, directions, model, focal_error=0.05, inlier_threshold=1.0)
    assert solution.verdict == "confident", solution.reason
    assert degrees_between(solution.rotation, rotation) < 0.05
    assert solution.focal_length == pytest.approx(lens(40.0).focal, rel=1e-3)
    assert solution.inlier_threshold == 1.0
    assert solution.inlier_count > 0.9 * (star >= 0).sum()  # 99.6 % of the normal errors of 0.3 pixels
    narrow = look(image, directions, model, focal_error=0.05, inlier_threshold=1e-3)
    assert narrow.verdict != "confident" or degrees_between(narrow.rotation, rotation) < 0.05


@pytest.mark.nightly
@pytest.mark.parametrize("error", [0.003, 0.01, 0.1])
@pytest.mark.parametrize("factor", [1.0, 1.004])
def test_a_rough_focal_length_gives_the_verdict_of_the_exact_one(error: float, factor: float) -> None:
    """Ten stars of 9,000 in 11 degrees: chance fits as well at the rough noise that a wrong focal length leaves."""
    focal, size = 5100.0, np.array([1024, 768])
    for seed in range(3):
        rng = np.random.default_rng([45, seed])
        directions = rng.standard_normal((9000, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        rotation = Rotation.random(random_state=seed).as_matrix()
        camera = directions @ rotation.T
        image = focal * camera[:, :2] / camera[:, 2:] + size / 2
        image = image[(camera[:, 2] > 0) & (image > 0).all(1) & (image < size).all(1)][:10]
        image = np.concatenate([image + 0.1 * rng.standard_normal(image.shape), rng.uniform(0, size, (25, 2))])
        assumed = np.array([[factor * focal, 0, 512], [0, factor * focal, 384], [0, 0, 1]])
        solution = look(image, directions, assumed, focal_error=error)
        assert solution.verdict == "confident", solution.reason
        assert degrees_between(solution.rotation, rotation) < 0.02
        assert solution.focal_length == pytest.approx(focal, rel=2e-3)


def test_an_image_of_stars_is_solved_from_its_size_alone() -> None:
    image, directions, rotation, _ = sky(5, field=52.0)
    solution = look(image, directions, image_size=(SIZE, SIZE))
    assert solution.verdict == "confident", solution.reason
    assert degrees_between(solution.rotation, rotation) < 0.05
    assert solution.focal_length == pytest.approx(lens(52.0).focal, rel=1e-3)


@pytest.mark.slow
def test_the_covariance_is_that_of_the_errors() -> None:
    sigmas = []
    for seed in range(40):
        image, directions, rotation, _ = sky(seed, field=30.0, count=400)
        solution = look(image, directions, lens(30.0).model)
        if solution.verdict != "confident":
            continue
        error = Rotation.from_matrix(rotation @ solution.rotation.T).as_rotvec()
        sigmas.append(error / np.sqrt(np.diag(solution.covariance)))
    assert len(sigmas) > 30
    inside = [float((np.abs(sigmas) < k).mean()) for k in (1, 2, 3)]
    assert 0.58 < inside[0] < 0.82
    assert inside[1] > 0.9
    assert inside[2] > 0.97


def test_points_with_the_largest_scores_are_tried_first() -> None:
    image, directions, _, star = sky(5, false=0.6)
    good = np.where(star >= 0, 1.0, 0.1)
    first, last = (look(image, directions, lens(40.0).model, scores2d=s) for s in (good, 1.1 - good))
    assert first.stats.iterations < last.stats.iterations


@pytest.mark.slow
@pytest.mark.parametrize("scored", [0, 1])
def test_a_camera_of_a_rig_without_scores_has_equal_ones(scored: int) -> None:
    """The camera with scores sees no star; the points of the other one have larger scores and are tried first."""
    rotation, turn = Rotation.random(rng=0).as_matrix(), Rotation.from_rotvec([0, 0.5, 0]).as_matrix()
    directions, false = np.random.default_rng(0).normal(size=(2, 200, 3))
    directions, false = (each / np.linalg.norm(each, axis=1, keepdims=True) for each in (directions, false))
    mounts = [(np.eye(3), np.zeros(3)), (turn, np.zeros(3))]
    images = [directions[:30] @ (mount @ rotation).T for mount, _ in mounts]
    images[scored] = false[:60]
    scores: list[Any] = [None, None]
    scores[scored] = np.r_[0.2, np.full(59, 0.1)]
    equal = [np.ones(30) if each is None else each for each in scores]
    for seed in range(4):
        none, ones = (look(images, directions, rig=mounts, scores2d=each, seed=seed) for each in (scores, equal))
        assert degrees_between(none.rotation, rotation) < 1e-3
        assert none.stats.iterations == ones.stats.iterations
        np.testing.assert_array_equal(none.rotation, ones.rotation)


def test_matches_lie_within_the_threshold() -> None:
    image, directions, _, star = sky(6)
    counts = []
    for threshold in (0.3, 2.0):
        solution = look(image, directions, lens(40.0).model, inlier_threshold=threshold)
        assert solution.inlier_threshold == threshold
        counts.append(solution.inlier_count)
    assert counts[0] < counts[1] == (star >= 0).sum()


def test_a_rotation_survives_its_file_and_is_drawn(tmp_path: Path) -> None:
    image, directions, _, _ = sky(0, field=180.0, count=300)
    solution = look(image, directions, lens(180.0).model)
    read = Solution.from_json(solution.to_json())
    assert np.array_equal(read.covariance, solution.covariance)
    assert read.parameters == ("rotation_x", "rotation_y", "rotation_z")
    assert read.rotation_std_deg == solution.rotation_std_deg
    assert np.isnan(read.centre_std)
    solution.plot().savefig(tmp_path / "sky.png")
