"""Rigs: planted poses of two and three cameras that see too little on their own."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
from planted import degrees_between
from scipy.sparse import csr_array
from scipy.sparse.csgraph import maximum_bipartite_matching
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation

import bpnp
from bpnp.cameras import camera_from
from bpnp.search.problem import Problem
from bpnp.search.propose.symmetries import Motions
from bpnp.search.rig.cameras import Rig
from bpnp.search.rig.points import RigPoints

CAMERA = ("SIMPLE_PINHOLE", [500.0, 320.0, 240.0])


def planted_rig(seed: int, seen: tuple[int, ...], points: int = 20) -> Any:
    """Pixels of each camera, the scene, the mounts, the pose of the rig, and which points each camera sees."""
    rng = np.random.default_rng([9, seed])
    scene = rng.uniform(-0.5, 0.5, (points, 3))
    pose = Rotation.random(rng=rng).as_matrix(), np.array([0.1, -0.1, 3.0])
    mounts, images, chosen = [], [], []
    for count in seen:
        turn = Rotation.from_rotvec(0.15 * rng.standard_normal(3)).as_matrix()
        mounts.append((turn, rng.uniform(-0.4, 0.4, 3)))
        camera = (scene @ pose[0].T + pose[1]) @ turn.T + mounts[-1][1]
        chosen.append(rng.choice(points, count, replace=False))
        pixels = 500 * camera[:, :2] / camera[:, 2:] + [320, 240]
        images.append(pixels[chosen[-1]] + 0.2 * rng.standard_normal((count, 2)))
    return images, scene, mounts, pose, chosen


@pytest.mark.slow
def test_a_rig_is_confident_where_no_single_camera_is() -> None:
    alone = together = 0
    for seed in range(4):
        images, scene, mounts, pose, chosen = planted_rig(seed, (4, 5, 4))
        solution = bpnp.solve(images, scene, [CAMERA] * 3, rig=mounts, time_limit=60)
        assert degrees_between(solution.rotation, pose[0]) < 2
        assert np.linalg.norm(solution.translation - pose[1]) < 0.15
        together += solution.verdict == "confident"
        alone += bpnp.solve(images[0], scene, CAMERA, solver="search").verdict == "confident"
        right = np.concatenate(chosen)[solution.matches[:, 0]] == solution.matches[:, 1]
        assert right.mean() > 0.9
        assert len(solution.points2d) == 13
        step = np.r_[Rotation.from_matrix(pose[0] @ solution.rotation.T).as_rotvec(), pose[1] - solution.translation]
        assert step @ np.linalg.solve(solution.covariance, step) < 40
    assert together > alone


@pytest.mark.nightly
@pytest.mark.parametrize(("cameras", "baseline", "count"), [(3, 0.02, 20), (2, 0.02, 8), (2, 0.5, 20)])
def test_cameras_that_see_the_same_unrelated_objects_are_no_evidence_for_each_other(
    cameras: int, baseline: float, count: int
) -> None:
    """All cameras see ten objects that are not in the scene; by chance, one NFA in a hundred is below 0.01."""
    for seed in range(4):
        rng = np.random.default_rng([41, seed])
        objects, scene = rng.uniform(-1, 1, (10, 3)) + [0, 0, 6], rng.uniform(-1, 1, (count, 3))
        shifts = np.outer(np.arange(cameras), [-baseline, 0, 0])
        seen = [objects + shift for shift in shifts]
        images = [800 * each[:, :2] / each[:, 2:] + 0.3 * rng.standard_normal((10, 2)) for each in seen]
        camera = ("SIMPLE_PINHOLE", [800.0, 0.0, 0.0])
        solution = bpnp.solve(images, scene, camera, rig=[(np.eye(3), shift) for shift in shifts], time_limit=60)
        assert solution.verdict == "failed"
        assert solution.log10_false_alarms > -2


@pytest.mark.slow
def test_a_camera_that_is_given_twice_counts_once() -> None:
    """The second one adds its tests, and another mean over scales and outlier fractions: one decade in all."""
    images, scene, mounts, _, _ = planted_rig(0, (10,))
    once, twice = (bpnp.solve(images * k, scene, CAMERA, rig=mounts * k, time_limit=60) for k in (1, 2))
    assert once.verdict == twice.verdict == "confident"
    assert 0 < twice.log10_false_alarms - once.log10_false_alarms < 1.5


@pytest.mark.slow
def test_a_rig_of_one_camera_is_that_camera() -> None:
    images, scene, mounts, pose, _ = planted_rig(0, (10,))
    matrix = np.vstack([np.column_stack(mounts[0]), [0, 0, 0, 1]])
    rigid = pycolmap.Rigid3d(pycolmap.Rotation3d(mounts[0][0]), mounts[0][1])
    for mount in (mounts[0], matrix[:3], matrix, matrix.tolist(), rigid):
        rig = bpnp.solve(images, scene, CAMERA, rig=[mount], time_limit=60)
        one = bpnp.solve(images[0], scene, CAMERA, solver="search")
        turn, shift = mounts[0]
        assert rig.verdict == one.verdict == "confident"
        assert degrees_between(rig.rotation, pose[0]) < 0.5
        np.testing.assert_allclose(turn @ rig.rotation, one.rotation, atol=2e-3)
        np.testing.assert_allclose(turn @ rig.translation + shift, one.translation, atol=2e-2)
        assert rig.log10_false_alarms == pytest.approx(one.log10_false_alarms, abs=1.5)


@pytest.mark.nightly
@pytest.mark.slow
def test_many_points_are_searched_and_joined() -> None:
    images, scene, mounts, pose, _ = planted_rig(1, (80, 80), points=120)
    clutter = np.random.default_rng(9).uniform((150, 100), (490, 380), (2, 40, 2))
    images = [np.concatenate(pair) for pair in zip(images, clutter, strict=True)]
    solution = bpnp.solve(images, scene, [CAMERA] * 2, rig=mounts, time_limit=60)
    assert solution.verdict == "confident"
    assert degrees_between(solution.rotation, pose[0]) < 0.3
    one = bpnp.solve(images[0], scene, CAMERA, solver="search")
    assert solution.log10_false_alarms < one.log10_false_alarms - 20


@pytest.mark.slow
@pytest.mark.parametrize("degrees", [5.0, 90.0])
def test_wrong_extrinsics_keep_a_rig_from_being_confident(degrees: float) -> None:
    """The first camera sees more points than the second, whose own pose contradicts the extrinsics."""
    images, scene, mounts, pose, _ = planted_rig(1, (14, 9))
    axis = np.array([0.6, 0.8, 0.0])
    for k in range(2):
        turn, shift = mounts[k]
        wrong = Rotation.from_rotvec(math.radians(degrees) * axis).as_matrix() @ turn
        given = [(wrong, shift) if other == k else mount for other, mount in enumerate(mounts)]
        solution = bpnp.solve(images, scene, [CAMERA] * 2, rig=given, time_limit=600)
        assert (solution.verdict, solution.reason_code) == ("ambiguous", "other_extrinsics")
        assert f"fit another pose, {degrees:.0f} deg away" in solution.reason
    solution = bpnp.solve(images, scene, [CAMERA] * 2, rig=mounts, time_limit=600)
    assert solution.verdict == "confident"
    assert degrees_between(solution.rotation, pose[0]) < 0.5


@pytest.mark.nightly
@pytest.mark.slow
def test_a_rig_is_judged_at_the_scale_of_its_residuals() -> None:
    """The noise of 0.8 pixels is far above the smallest scale; unmatched points contest it in no single camera."""
    for seed in (0, 3):
        images, scene, mounts, pose, _ = planted_rig(seed, (60, 60, 60), points=150)
        rng = np.random.default_rng(seed)
        noisy = [image + 0.8 * rng.standard_normal(image.shape) for image in images]
        images = [np.concatenate([image, rng.uniform(image.min(0), image.max(0), (60, 2))]) for image in noisy]
        solution = bpnp.solve(images, scene, [CAMERA] * 3, rig=mounts, time_limit=60)
        assert solution.verdict == "confident"
        assert solution.log10_false_alarms < -80
        assert degrees_between(solution.rotation, pose[0]) < 0.5


@pytest.mark.slow
@pytest.mark.parametrize("scale", [0.2, 5.0])
def test_a_rig_with_a_baseline_finds_the_scale_of_the_scene(scale: float) -> None:
    errors = []
    for seed in range(4):
        images, scene, mounts, pose, _ = planted_rig(seed, (5, 6, 5))
        origin = np.array([300.0, 0, 0]) / scale  # far away, so that it matters about what the pose is known
        solution = bpnp.solve(images, scene / scale + origin, [CAMERA] * 3, rig=mounts, scale=True, time_limit=60)
        translation = pose[1] - scale * pose[0] @ origin
        assert solution.verdict == "confident"
        turn = Rotation.from_matrix(pose[0] @ solution.rotation.T).as_rotvec()
        step = np.r_[turn, translation - solution.translation, scale - solution.scale]
        unit = np.diag(solution.covariance) ** -0.5
        errors.append(step * unit @ np.linalg.pinv(solution.covariance * np.outer(unit, unit)) @ (step * unit))
        assert abs(solution.scale - scale) < 4 * solution.scale_std < 0.1 * scale
        assert solution.scale_std == pytest.approx(np.sqrt(solution.covariance[6, 6]))
        assert (solution.focal_length_std, solution.candidates[0].scale) == (0, solution.scale)
        centre = -pose[0].T @ translation / scale
        assert np.linalg.norm(solution.centre - centre) < 4 * solution.centre_std < 0.4 / scale
        again = bpnp.Solution.from_json(solution.to_json())
        assert (again.scale, again.scale_std) == (solution.scale, solution.scale_std)
        assert again.parameters == solution.parameters
        assert solution.parameters[5:] == ("translation_z", "scale")
    assert 1 < np.mean(errors) < 20  # seven


def test_a_short_baseline_gives_no_confident_scale() -> None:
    images, scene, mounts, _, _ = planted_rig(1, (60, 60), points=120)
    turns = [turn for turn, _ in mounts]
    near = [(turns[0], np.zeros(3)), (turns[1], turns[1] @ [1e-4, 0, 0])]
    points = scene @ Rotation.random(rng=np.random.default_rng(1)).as_matrix().T + [0, 0, 3]
    rays = [points @ turn.T for turn in turns]
    images = [500 * ray[:60, :2] / ray[:60, 2:] + [320, 240] for ray in rays]
    solution = bpnp.solve(images, scene, [CAMERA] * 2, rig=near, scale=True, time_limit=60)
    assert solution.verdict == "ambiguous"
    assert "scale" in solution.reason


def test_a_rig_with_a_prior_returns_what_it_has_when_the_time_is_over() -> None:
    """The deadline is over from the start: the pose of the prior is refined on all cameras, and nothing else is."""
    images, scene, mounts, pose, _ = planted_rig(1, (80, 80), points=120)
    near = Rotation.from_rotvec([0.01, -0.02, 0.01]).as_matrix() @ pose[0]
    rough = bpnp.PosePrior(near, pose[1] + 0.03, rotation_sigma_deg=2.0, translation_sigma=0.05)
    late = bpnp.solve(images, scene, [CAMERA] * 2, rig=mounts, prior=rough, time_limit=1e-9)
    assert late.log10_false_alarms < -100
    assert degrees_between(late.rotation, pose[0]) < 0.3
    without = bpnp.solve(images, scene, [CAMERA] * 2, rig=mounts, time_limit=1e-9)
    assert without.verdict == "failed"


def test_candidates_of_a_rig_count_the_inliers_of_all_cameras() -> None:
    """A half turn about z maps the scene onto itself: two poses have the inliers of a maximum matching of scipy's."""
    half = np.random.default_rng(7).uniform(-0.5, 0.5, (6, 3))
    scene, mounts = np.concatenate([half, half * [-1, -1, 1]]), [(np.eye(3), np.array([x, 0.0, 0.0])) for x in (0, 0.3)]
    rotation, translation = Rotation.from_rotvec([0.5, 0.3, 0.8]).as_matrix(), np.array([0.05, 0.1, 3.0])

    def image_of(turn: Any, shift: Any, mount: Any) -> Any:
        camera = scene @ turn.T + shift + mount[1]
        return 500 * camera[:, :2] / camera[:, 2:] + [320, 240]

    images = [image_of(rotation, translation, mount) for mount in mounts]
    solution = bpnp.solve(images, scene, CAMERA, rig=mounts, inlier_threshold=3.0, time_limit=60)
    assert solution.verdict == "ambiguous"
    assert len(solution.candidates) >= 2
    for one in solution.candidates:
        count = 0
        for image, mount in zip(images, mounts, strict=True):
            apart = cdist(image, image_of(one.rotation, one.translation, mount))
            count += int((maximum_bipartite_matching(csr_array(apart <= 3.0), perm_type="column") >= 0).sum())
        assert one.inlier_count == count
    assert [one.inlier_count for one in solution.candidates[:2]] == [24, 24]


@pytest.mark.slow
def test_the_prior_of_a_rig_counts_once() -> None:
    """A rig of two equal cameras: the rotation is as accurate as one prior, which is better than the image."""
    images, scene, mounts, pose, _ = planted_rig(3, (10,))
    sigma = 1e-3
    prior = bpnp.PosePrior(pose[0], None, sigma)
    twice = bpnp.solve([images[0]] * 2, scene, CAMERA, rig=[mounts[0]] * 2, prior=prior, time_limit=60)
    assert twice.rotation_std_deg == pytest.approx(sigma, rel=0.05)
    rough = bpnp.solve([images[0]] * 2, scene, CAMERA, rig=[mounts[0]] * 2, time_limit=60)
    assert rough.rotation_std_deg > 10 * sigma


@pytest.mark.slow
def test_a_solution_of_a_rig_is_neither_drawn_nor_exported_as_one_image(tmp_path: Path) -> None:
    """Each camera alone can be: its pose is cam_from_rig times that of the rig."""
    images, scene, mounts, _, _ = planted_rig(1, (9, 8))
    solution = bpnp.solve(images, scene, [CAMERA] * 2, rig=mounts, time_limit=60)
    assert solution.points_per_camera == (9, 8)
    assert bpnp.Solution.from_json(solution.to_json()).points_per_camera == (9, 8)
    with pytest.raises(ValueError, match="a rig of 2 cameras cannot become a model of one image"):
        solution.to_colmap(tmp_path / "model")
    assert not (tmp_path / "model").exists()
    with pytest.raises(ValueError, match="a rig of 2 cameras cannot become a picture of one image"):
        solution.plot()
    assert "<img" not in solution._repr_html_()
    for image, (rotation, translation) in zip(images, mounts, strict=True):
        pose = rotation @ solution.rotation, rotation @ solution.translation + translation
        alone = bpnp.verify(image, scene, *pose, CAMERA)
        assert degrees_between(alone.rotation, pose[0]) < 2
        alone.to_colmap(tmp_path / f"{len(image)}")
    assert {folder.name for folder in tmp_path.iterdir()} == {"9", "8"}


def test_the_threshold_is_the_search_radius_of_each_camera() -> None:
    """Near the axis an error of 20 pixels is an angle of 20 / f."""
    rng = np.random.default_rng(0)
    images = [rng.uniform(300, 340, (6, 2)) - [0, 80] for _ in range(2)]
    lenses = [camera_from(("SIMPLE_PINHOLE", [focal, 320.0, 240.0])) for focal in (500.0, 1000.0)]
    for threshold, radii in ((20.0, [0.04, 0.02]), (None, [3 / 500, 3 / 1000])):
        points = RigPoints(
            images,
            rng.uniform(-1, 1, (9, 3)),
            [(np.eye(3), np.zeros(3))] * 2,
            {"labels2d": [None] * 2, "scores2d": [None] * 2},
            inlier_threshold=threshold,
            clutter=None,
            prior=None,
            is_metric=True,
        )
        assert [problem.match_radius for problem in points.rig(lenses).problems] == pytest.approx(radii, rel=0.02)


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "is_metric"), [(0, True), (2, True), (2, False), (3, False)])
def test_a_rig_of_known_size_decides_between_a_part_and_its_copy_of_half_the_size(seed: int, is_metric: bool) -> None:
    rng = np.random.default_rng([9, seed])
    part = rng.uniform(-0.5, 0.5, (12, 3))
    copy = 0.5 * part @ Rotation.random(rng=rng).as_matrix().T + [1.5, 0.5, 0]
    rotation, mounts, images = Rotation.random(rng=rng).as_matrix(), [], []
    for _ in range(2):
        turn = Rotation.from_rotvec(0.15 * rng.standard_normal(3)).as_matrix()
        mounts.append((turn, rng.uniform(-0.4, 0.4, 3)))
        camera = (part @ rotation.T + [0.1, -0.1, 3]) @ turn.T + mounts[-1][1]
        images.append(500 * camera[:, :2] / camera[:, 2:] + [320, 240] + 0.2 * rng.standard_normal((12, 2)))
    scene = np.concatenate([part, copy])
    solution = bpnp.solve(images, scene, [CAMERA] * 2, rig=mounts, scale=not is_metric, time_limit=60)
    assert solution.verdict == ("confident" if is_metric else "ambiguous")
    assert not is_metric or degrees_between(solution.rotation, rotation) < 1


def test_a_larger_rig_sees_a_copy_of_another_size_as_a_smaller_one_sees_the_part() -> None:
    _, part, mounts, (rotation, translation), _ = planted_rig(0, (10, 10))
    turn, shift = Rotation.from_rotvec([0.4, 0.9, -0.3]).as_matrix(), np.array([2.0, 0.5, -1])
    motions = Motions(turn[None], shift[None], np.array([0.6]), np.ones(1), 0.0)
    cameras = [(part @ rotation.T + translation) @ mount.T + offset for mount, offset in mounts]
    bearings = [camera / np.linalg.norm(camera, axis=1, keepdims=True) for camera in cameras]
    rig = Rig([Problem(each, part) for each in bearings], mounts, is_metric=False)
    first = rig.pose_of(0, rotation, np.append(translation, 1))
    others = rig.rig_of(0, *motions.competitors(*first), motions.scale[:, None])
    for k, camera in enumerate(cameras):
        other, moved = rig.pose_of(k, *others)
        np.testing.assert_allclose(motions.apply(part)[0] @ other[0].T + moved[0], 0.6 * camera)
