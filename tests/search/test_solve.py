"""`solve` and `solve_many` on planted problems."""

import math
from typing import Any

import cv2
import numpy as np
import pycolmap
import pytest
from planted import Answering, Planted, degrees_between, plant, seen
from scipy.spatial.transform import Rotation

from bpnp import PosePrior, Solution, solve, solve_many
from bpnp.examples import load
from bpnp.models import Search
from bpnp.runtime import Deadline
from bpnp.search import solvers
from bpnp.search.find import find_case
from bpnp.search.inputs import problem_from
from bpnp.search.verdict.decide import Case
from bpnp.search.verdict.reasons import objection

FISHEYE = ("OPENCV_FISHEYE", [300.0, 310.0, 400.0, 300.0, 0.05, -0.02, 0.01, 0.001])
K = np.array([[520.0, 1.5, 405.0], [0.0, 500.0, 290.0], [0.0, 0.0, 1.0]])


def true_matches(planted: Planted) -> set[tuple[int, int]]:
    return {(i, j) for j, i in enumerate(planted.match3d[0].tolist()) if i >= 0}


def found(solution: Solution) -> set[tuple[int, int]]:
    return set(map(tuple, solution.matches.tolist()))


def degrees(solution: Solution, planted: Planted) -> float:
    return degrees_between(solution.rotation, planted.rotation[0].numpy())


def test_an_exact_problem_is_solved_to_the_last_digits() -> None:
    planted = plant(1, 80)
    solution = solve(planted.points2d[0].numpy(), planted.points3d[0].numpy())
    np.testing.assert_allclose(solution.rotation, planted.rotation[0], atol=1e-9)
    np.testing.assert_allclose(solution.translation, planted.translation[0], atol=1e-9)
    np.testing.assert_allclose(solution.centre, -planted.rotation[0].mT @ planted.translation[0], atol=1e-9)
    assert found(solution) == true_matches(planted)
    assert (solution.verdict, solution.inlier_count, solution.inlier_ratio) == ("confident", 80, 1.0)
    assert solution.unit == "normalised"
    assert max(solution.reprojection_error, solution.reprojection_error_deg) < 1e-8
    first = solution.candidates[0]
    assert first.rotation.tolist() == solution.rotation.tolist()
    assert first.inlier_count == 80
    assert all(other.score <= first.score for other in solution.candidates)


def test_a_camera_matrix_of_normalised_coordinates_says_nothing_about_the_noise() -> None:
    """A tenth of its unit would be six degrees."""
    planted = plant(1, 60)
    solution = solve(planted.points2d[0].numpy(), planted.points3d[0].numpy(), np.eye(3))
    assert solution.verdict == "confident"
    np.testing.assert_allclose(solution.rotation, planted.rotation[0], atol=1e-9)


def test_a_problem_with_noise_and_outliers_is_solved_and_reported() -> None:
    """200 true pairs with normal noise of 0.001, and a quarter of clutter on each side."""
    planted = plant(1, 200, noise=0.001, outliers2d=50, outliers3d=50, seed=3)
    solution = solve(planted.points2d[0], planted.points3d[0])
    assert solution.verdict == "confident"
    assert degrees(solution, planted) < 0.1
    right = found(solution) & true_matches(planted)
    assert len(right) > 0.9 * 200
    assert solution.inlier_count == len(solution.matches) >= len(right)
    assert solution.inlier_ratio == solution.inlier_count / 250
    assert 0.0005 < solution.inlier_threshold / 3 < 0.0015
    i, j = solution.matches.T
    projected = seen(planted.points3d[0].numpy()[j], solution.rotation, solution.translation)
    errors = np.linalg.norm(projected - planted.points2d[0].numpy()[i], axis=-1)
    assert solution.reprojection_error == pytest.approx(errors.mean())
    assert errors.max() <= solution.inlier_threshold


@pytest.mark.parametrize("as_object", [False, True])
def test_pixels_are_undistorted_and_dropped_ones_counted(as_object: bool) -> None:
    """Two pixels that no ray in front of the fisheye reaches; the places in `matches` are those of the given array."""
    planted = plant(1, 60, seed=1)
    lens = pycolmap.Camera(model=FISHEYE[0], params=FISHEYE[1])
    rays = np.column_stack([planted.points2d[0].numpy(), np.ones(60)])
    pixels = np.insert(lens.img_from_cam(rays), [0, 10], [[1000.0, 300.0]], axis=0)
    solution = solve(pixels, planted.points3d[0], lens if as_object else FISHEYE)
    expected = {(i + 1 + (i >= 10), j) for i, j in true_matches(planted)}
    assert found(solution) == expected
    assert (solution.stats.dropped2d, solution.unit) == (2, "px")
    assert np.isnan(solution.points2d).any(-1).nonzero()[0].tolist() == [0, 11]
    np.testing.assert_allclose(solution.rotation, planted.rotation[0], atol=1e-8)
    assert solution.reprojection_error < 1e-5


def test_bearings_in_all_directions_are_solved() -> None:
    """A camera in the middle of its points, which it sees all around."""
    rng = np.random.default_rng(0)
    rays = rng.normal(size=(80, 3))
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    rotation, translation = Rotation.random(rng=rng).as_matrix(), np.array([0.3, -0.2, 0.5])
    points3d = (rays * rng.uniform(3, 4, (80, 1)) - translation) @ rotation
    solution = solve(rays, points3d, prior=PosePrior(rotation, translation + 0.1, 5.0, 0.2))  # type: ignore[arg-type]
    np.testing.assert_allclose(solution.rotation, rotation, atol=1e-8)
    assert found(solution) == {(i, i) for i in range(80)}
    assert solution.unit == "rad"


def test_arrays_tensors_lists_and_precisions_are_the_same_points() -> None:
    planted = plant(1, 40)
    x, p = planted.points2d[0].float(), planted.points3d[0].float()
    expected = solve(x, p)
    for points2d, points3d in ((x.numpy(), p.numpy()), (x.tolist(), p.tolist()), (x.double(), p.double().numpy())):
        again = solve(points2d, points3d)
        np.testing.assert_array_equal(again.rotation, expected.rotation)
        np.testing.assert_array_equal(again.matches, expected.matches)


def test_solve_many_gives_the_solutions_of_solve() -> None:
    planted = [plant(1, size, seed=size, noise=0.001) for size in (30, 70, 50)]
    sets2d = [x.points2d[0].numpy() @ K[:2, :2].T + K[:2, 2] for x in planted]
    sets3d = [x.points3d[0].numpy() for x in planted]
    together = solve_many(sets2d, sets3d, K)
    assert [len(s.points2d) for s in together] == [30, 70, 50]
    for solution, x, p in zip(together, sets2d, sets3d, strict=True):
        alone = solve(x, p, K)
        np.testing.assert_array_equal(solution.rotation, alone.rotation)
        np.testing.assert_array_equal(solution.matches, alone.matches)
    again = solve_many(sets2d, sets3d, [K, ("PINHOLE", [520.0, 500.0, 405.0, 290.0]), K])
    np.testing.assert_array_equal(again[0].rotation, together[0].rotation)
    assert degrees(again[1], planted[1]) < 1


@pytest.mark.parametrize(
    ("change2d", "change3d", "reason"),
    [
        (None, lambda p: np.outer(p[:, 0], [1.0, 2.0, 3.0]) + 5, "on one line"),
        (None, lambda p: (np.outer(p[:, 0], [1.0, 2.0, 3.0]) + 5).astype(np.float32), "on one line"),
        (None, np.ones_like, "only 1 different 3D point:"),
        (None, lambda p: p[np.arange(40) % 3], "only 3 different 3D points:"),
        (np.ones_like, None, "only 1 different 2D point:"),
        (lambda x: x[np.arange(40) % 2], None, "only 2 different 2D points:"),
    ],
)
def test_points_that_fix_no_pose_fail_with_the_reason(change2d, change3d, reason: str) -> None:
    planted = plant(1, 40)
    points2d, points3d = planted.points2d[0].numpy(), planted.points3d[0].numpy()
    solution = solve(
        points2d if change2d is None else change2d(points2d), points3d if change3d is None else change3d(points3d)
    )
    assert solution.verdict == "failed"
    assert reason in solution.reason
    assert not solution.found
    assert not solution
    assert np.isnan(solution.rotation).all()
    assert (solution.matches.shape, solution.inlier_count, solution.candidates) == ((0, 2), 0, ())


def test_a_failed_guess_is_false_although_it_has_a_pose() -> None:
    """`if solution:` is no use of a guess; `found` is about the pose."""
    rng = np.random.default_rng(0)
    guess = solve(rng.uniform(-1, 1, (60, 2)), rng.normal(size=(60, 3)), solver="search", time_limit=math.inf)
    assert (guess.verdict, guess.found, bool(guess)) == ("failed", True, False)


def test_a_module_solves_and_is_judged_by_the_points() -> None:
    planted = plant(1, 100, noise=0.001)
    x, p = planted.points2d[0], planted.points3d[0]
    near = Answering(*(value[0] for value in planted.near(0.003)))
    solution = solve(x, p, solver=near)
    assert solution.verdict == "confident"
    assert degrees(solution, planted) < 0.1
    wrong = Answering(np.eye(3), np.array([0.0, 0.0, 5.0]))
    assert solve(x, p, solver=wrong).verdict != "confident"
    missing = solve(x, p, solver=Answering(np.full((3, 3), np.nan), np.full(3, np.nan)))
    assert (missing.verdict, missing.found) == ("failed", False)
    searched = solve(x, p, solver=Search())
    assert degrees(searched, planted) < 0.1


@pytest.mark.nightly
def test_errors_follow_the_covariance_of_the_solution() -> None:
    """60 planted poses, 20 to 80 points, an outlier for every third of them: errors over their standard deviations."""
    rng, whitened, turns, centres = np.random.default_rng(0), [], [], []
    for seed in range(60):
        count, noise = int(rng.integers(20, 81)), float(rng.uniform(5e-4, 3e-3))
        planted = plant(1, count, noise=noise, outliers2d=count // 3, outliers3d=count // 3, seed=seed)
        solution = solve(planted.points2d[0], planted.points3d[0] + 100)
        rotation = planted.rotation[0].numpy()
        translation = planted.translation[0].numpy() - rotation @ np.full(3, 100)
        if degrees(solution, planted) > 5:
            continue
        turn = Rotation.from_matrix(rotation @ solution.rotation.T).as_rotvec()
        error = np.r_[turn, translation - solution.translation]
        whitened.extend(np.linalg.solve(np.linalg.cholesky(solution.covariance), error))
        turns.append(np.degrees(np.linalg.norm(turn)) / solution.rotation_std_deg)
        centres.append(np.linalg.norm(solution.centre + rotation.T @ translation) / solution.centre_std)
    assert len(turns) >= 55
    within = [np.mean(np.abs(whitened) < sigmas) for sigmas in (1, 2, 3)]
    np.testing.assert_allclose(within, [0.683, 0.954, 0.997], atol=0.05)
    for errors in (turns, centres):  # of a vector, over the largest of its standard deviations
        assert 0.7 < np.median(errors) < 1.7
        assert max(errors) < 4.5


def test_progress_has_the_index_of_the_problem() -> None:
    planted = plant(1, 30)
    calls: list[tuple[int, int]] = []
    sets2d, sets3d = [planted.points2d[0]] * 2, planted.points3d[0]
    solve_many(sets2d, sets3d, progress=lambda pair, batch, _: calls.append((pair, batch)))
    assert {pair for pair, _ in calls} == {0, 1}
    first, second = ([batch for pair, batch in calls if pair == number] for number in (0, 1))
    solve(sets2d[0], sets3d, progress=lambda pair, batch, _: calls.append((pair + 2, batch)))
    assert first == second == [batch for pair, batch in calls if pair == 2]


@pytest.mark.slow
def test_progress_is_called_in_every_mode_with_the_index_of_the_problem() -> None:
    """With a rig and an unknown focal length; twice the same problem."""
    rng = np.random.default_rng(4)
    scene = rng.uniform(-1, 1, (12, 3))
    images = [rng.permutation(seen(scene, np.eye(3), [x, 0, 5])) for x in (0.0, 0.2)]
    rig = [(np.eye(3), np.array([x, 0, 0])) for x in (0.0, 0.2)]
    modes: dict[str, tuple[Any, Any, dict[str, Any]]] = {
        "rig": (images, scene, {"rig": rig}),
        "focal length": (500 * images[0] + [320, 240], scene, {"image_size": (640, 480)}),
    }
    for name, (points2d, points3d, options) in modes.items():
        calls: list[tuple[int, int, float]] = []

        def progress(*call: Any, calls: list[tuple[int, int, float]] = calls) -> None:
            calls.append(call)

        solve_many([points2d] * 2, points3d, **options, progress=progress)
        assert {problem for problem, *_ in calls} == {0, 1}, name
        assert all(batches >= 0 and seconds >= 0 for _, batches, seconds in calls), name
        calls.clear()
        solve(points2d, points3d, **options, progress=progress)
        assert {problem for problem, *_ in calls} == {0}, name


def test_keypoints_of_opencv_count_from_the_centre_of_the_first_pixel() -> None:
    """With a camera of COLMAP's they get half a pixel; with OpenCV's (K, distortion) they have it."""
    planted = plant(1, 40)
    pixels = 500 * planted.points2d[0].numpy() + [400, 300]
    points = [cv2.KeyPoint(float(x - 0.5), float(y - 0.5), 3.0) for x, y in pixels]
    opencv = (np.array([[500, 0, 399.5], [0, 500, 299.5], [0, 0, 1.0]]), np.zeros(5))
    for camera in (("SIMPLE_PINHOLE", (500, 400, 300)), opencv):
        solution = solve(points, planted.points3d[0], camera)
        assert solution.reprojection_error < 1e-3
        np.testing.assert_allclose(solution.rotation, planted.rotation[0], atol=1e-5)


@pytest.mark.parametrize("form", ["opencv", "rows"])
def test_arrays_of_opencv_detectors_are_accepted(form: str) -> None:
    example = load("mesh")
    keypoints = {
        "opencv": example.points2d[:, None].astype(np.float32),
        "rows": np.c_[example.points2d, np.full(200, 2.5), np.zeros(200)],
    }[form]
    solution = solve(keypoints, example.points3d[:, None] if form == "opencv" else example.points3d, example.camera)
    assert example.rotation_error_deg(solution.rotation) < 0.2
    assert solution.points2d.shape == (200, 2)


def test_the_reason_names_the_time_limit_that_left_a_pose_undecided(monkeypatch: pytest.MonkeyPatch) -> None:
    """The search returns an open verdict, with its deadline passed or not."""
    planted = plant(2, 40)
    points = planted.points2d[0].numpy(), planted.points3d[0].numpy()
    case = find_case(problem_from(*points, None)).against(objection("incomplete", what="pose", probability="0.1"))
    monkeypatch.setattr(solvers, "find_case", lambda *_, **__: case)
    monkeypatch.setattr(Case, "is_settled", False)
    assert "not decided" not in solve(*points, time_limit=60).reason
    monkeypatch.setattr(solvers.Options, "deadline", lambda *_: Deadline.after(-1.0))
    assert "not decided in 7 s" in solve(*points, time_limit=7).reason
