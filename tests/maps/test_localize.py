"""A photo's pose in a map comes from its keypoints alone."""

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import jaxtyping
import numpy as np
import pytest
import torch
from planted import degrees_between, seen
from planted_model import HEIGHT, PINHOLE, WIDTH, Planted, plant_model
from scipy.spatial.transform import Rotation

import bpnp
from bpnp import PosePrior, SceneMap, Solution
from bpnp.cameras import camera_from
from bpnp.maps import localize
from bpnp.maps.all_points import judge_on_all_points, refine_on_all_points
from bpnp.maps.localize import BRIEF
from bpnp.maps.photo_problem import Photo
from bpnp.maps.views import View
from bpnp.search.assemble import Solved, with_verdict
from bpnp.search.solvers import Options
from bpnp.search.verdict.decide import Case, decide
from bpnp.search.verdict.false_alarms import alarms_of
from bpnp.search.verdict.reasons import objection


@pytest.fixture(scope="module")
def planted(tmp_path_factory: pytest.TempPathFactory) -> tuple[SceneMap, Planted]:
    folder = tmp_path_factory.mktemp("map")
    truth = plant_model(folder, camera=PINHOLE, images=3, points=140, seen=90, clutter=15)
    return SceneMap.from_colmap(folder), truth


def photo_of(truth: Planted, number: int) -> tuple[np.ndarray, np.ndarray]:
    """Pixels of a new photo near view `number`, clutter last, and the ids of what it sees (0: clutter)."""
    turn = Rotation.from_euler("xyz", [4, -6, 3], degrees=True).as_matrix()
    points = truth.points3d[truth.seen[number]]
    pixels = 520 * seen(points, turn @ truth.rotations[number], truth.translations[number]) + [400, 300]
    ids = np.concatenate([truth.seen[number] + 1, np.zeros(len(truth.clutter_px[number]), int)])
    return np.concatenate([pixels, truth.clutter_px[number]]), ids


def assert_right(solution: Solution, truth: Planted, number: int, ids: np.ndarray) -> None:
    turn = Rotation.from_euler("xyz", [4, -6, 3], degrees=True).as_matrix()
    np.testing.assert_allclose(solution.rotation, turn @ truth.rotations[number], atol=2e-3)
    np.testing.assert_allclose(solution.translation, truth.translations[number], atol=2e-2)
    right = ids[solution.matches[:, 0]] == solution.matched_point_ids
    tried = truth.seen[int(str(solution.view).removeprefix("photo ").removesuffix(".jpg"))] + 1
    assert right.sum() > 0.8 * np.isin(ids, tried).sum()
    assert right.mean() > 0.9


@pytest.mark.parametrize("views", [["photo 1.jpg"], None])
def test_a_photo_is_found_near_a_given_view_or_in_the_whole_map(
    planted: tuple[SceneMap, Planted], views: list[str] | None
) -> None:
    scene, truth = planted
    keypoints, ids = photo_of(truth, 1)
    solution = scene.localize(keypoints, PINHOLE, views=views)
    assert_right(solution, truth, 1, ids)
    assert solution.verdict == "confident"
    assert solution.view == "photo 1.jpg" or views is None


def test_matches_are_indices_and_their_ids_are_those_of_the_map(planted: tuple[SceneMap, Planted]) -> None:
    scene, truth = planted
    pixels, ids = photo_of(truth, 0)
    solution = scene.localize(pixels, PINHOLE, views=["photo 0.jpg", "photo 2.jpg"])
    assert solution.point_ids is not None
    i, j = solution.matches.T
    known = ids[i] > 0
    np.testing.assert_allclose(solution.points2d[i], (pixels[i] - [400, 300]) / 520)
    right = (solution.points3d[j[known]] == truth.points3d[ids[i[known]] - 1]).all(1)
    assert right.mean() > 0.9
    np.testing.assert_array_equal(solution.matched_point_ids[known][right], ids[i[known]][right])
    again = Solution.from_json(solution.to_json())
    assert again.view == "photo 0.jpg"
    np.testing.assert_array_equal(again.matches, solution.matches)
    np.testing.assert_array_equal(again.matched_point_ids, solution.matched_point_ids)


def test_the_reason_has_the_number_of_views_tried_within_the_time_limit(planted: tuple[SceneMap, Planted]) -> None:
    """After a limit that has passed when the first view was tried no other one is; noise has no confident pose."""
    scene, truth = planted
    noise = np.random.default_rng(0).uniform((0, 0), (800, 600), (90, 2))
    solution = scene.localize(noise, PINHOLE, solver="search", time_limit=1e-9)
    assert solution.verdict != "confident"
    assert solution.reason.startswith("Not decided in 1e-09 s, with 1 of 3 views tried.")
    turned = scene.localize(noise, PINHOLE, solver="search", time_limit=1e-9, up_camera=[1, 0, 0])
    assert " 1 of 3 views tried" in turned.reason
    whole = scene.localize(photo_of(truth, 0)[0], PINHOLE, solver="search", time_limit=math.inf)
    assert whole.verdict == "confident"
    assert "views tried" not in whole.reason


def test_a_function_ranks_the_views(planted: tuple[SceneMap, Planted]) -> None:
    """It gets normalised keypoints and all views; with time for one view, that is the one with the largest score."""
    scene, truth = planted
    pixels, _ = photo_of(truth, 1)
    for first in ("photo 0.jpg", "photo 2.jpg"):

        def rank_views(points2d: np.ndarray, views: Sequence[View], first: str = first) -> list[float]:
            np.testing.assert_allclose(520 * points2d + [400, 300], pixels)
            return [float(view.name == first) for view in views]

        found = scene.localize(pixels, PINHOLE, rank_views=rank_views, solver="search", time_limit=1e-9)
        assert found.view == first
    with pytest.raises(ValueError, match=r"returned an array of shape \(2,\); one score for each of the 3 views"):
        scene.localize(pixels, PINHOLE, rank_views=lambda points2d, views: [1.0, 2.0], solver="search")


def test_a_function_ranks_the_places_of_competing_poses(planted: tuple[SceneMap, Planted]) -> None:
    scene, truth = planted
    pixels, ids = photo_of(truth, 1)
    calls = list[int]()

    def rank_views(points2d: np.ndarray, views: Sequence[View]) -> np.ndarray:
        calls.append(len(points2d))
        return np.array([view.name == "photo 1.jpg" for view in views], float)

    solution = scene.localize(pixels, PINHOLE, rank_views=rank_views, solver="search", time_limit=math.inf)
    assert_right(solution, truth, 1, ids)
    assert calls[0] == len(pixels)
    assert len(calls) > 1
    assert calls[1] < len(pixels)


def test_the_pose_is_fitted_to_all_points_that_its_camera_sees(planted: tuple[SceneMap, Planted]) -> None:
    scene, truth = planted
    pixels = 520 * seen(truth.points3d, truth.rotations[1], truth.translations[1]) + [400, 300]
    pixels += np.random.default_rng(0).normal(0, 0.5, pixels.shape)
    solution = scene.localize(pixels, PINHOLE, views=["photo 1.jpg"])
    others = ~np.isin(solution.matched_point_ids, truth.seen[1] + 1)
    assert others.sum() > 4
    assert (solution.matches[:, 0] + 1 == solution.matched_point_ids).mean() > 0.9
    of_view = bpnp.solve(pixels, truth.points3d[truth.seen[1]], PINHOLE)
    assert solution.inlier_count > of_view.inlier_count
    assert solution.log10_false_alarms < of_view.log10_false_alarms


def another(case: Case, *_: object) -> Case:
    return case.against(objection("competing_pose", 2.0, away="another"))


def elsewhere(case: Case, *_: object) -> Case:
    """With the best pose turned by 10 degrees and far from chance."""
    turn, poses = Rotation.from_euler("z", 10, degrees=True).as_matrix(), case.candidates
    alarms = np.full(len(poses), -500.0)
    return replace(case, candidates=replace(poses, rotation=turn @ poses.rotation, log10_false_alarms=alarms))


def of_another_lens(case: Case, **_: object) -> Case:
    return case.against(objection("other_camera", camera="1.30 times the focal length", degrees=2.0, percent=30.0))


class NotSure:
    """A case that is ambiguous by itself."""

    @staticmethod
    def of(*known: Any, **options: Any) -> Case:
        return Case.of(*known, **options).against(objection("incomplete", what="pose", probability="0.1"))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("stages", "reason"),
    [
        ({"contest": another}, "another"),
        ({"contest": elsewhere}, "A competing pose 10 deg away fits about as well"),
        ({"Case": NotSure, "lens": of_another_lens}, "With 1.30 times the focal length"),
    ],
    ids=["competing pose", "other pose", "other camera of an ambiguous pose"],
)
def test_an_ambiguous_verdict_on_all_points_is_kept_though_the_nfa_does_not_improve(
    planted: tuple[SceneMap, Planted], monkeypatch: pytest.MonkeyPatch, stages: dict[str, Any], reason: str
) -> None:
    scene, truth = planted
    keypoints, _ = photo_of(truth, 1)
    known = scene.localize(keypoints, PINHOLE, views=["photo 1.jpg"])
    for name, stage in stages.items():
        monkeypatch.setattr(f"bpnp.maps.all_points.{name}", stage)
    solution = scene.localize(keypoints, PINHOLE, views=["photo 1.jpg"])
    assert (known.verdict, solution.verdict) == ("confident", "ambiguous")
    assert reason in solution.reason
    assert solution.log10_false_alarms == known.log10_false_alarms  # of the view's points alone


def test_only_strong_keypoints_are_tried_and_matches_are_among_all_of_them(
    planted: tuple[SceneMap, Planted], monkeypatch: pytest.MonkeyPatch
) -> None:
    scene, truth = planted
    keypoints, ids = photo_of(truth, 1)
    scores = (ids > 0).astype(float)
    monkeypatch.setattr("bpnp.maps.localize.MOST_KEYPOINTS", 90)
    shuffled = np.random.default_rng(0).permutation(len(ids))
    solution = scene.localize(keypoints[shuffled], PINHOLE, views=["photo 1.jpg"], scores=scores[shuffled])
    assert_right(solution, truth, 1, ids[shuffled])
    np.testing.assert_allclose(solution.points2d, (keypoints[shuffled] - [400, 300]) / 520)


@pytest.mark.nightly
def test_a_prior_decides_on_which_side_the_photo_was_taken(planted: tuple[SceneMap, Planted]) -> None:
    """Points and their copies turned by 180 degrees about the axis: two poses explain a photo, the prior names one."""
    scene, truth = planted
    half = truth.points3d[:70] * [1, 1, 0.5]
    turn = np.diag([-1.0, -1.0, 1.0])
    points = np.concatenate([half, half @ turn])
    everything = np.arange(140, dtype=np.int32)
    poses = [(np.eye(3), np.array([0.0, 0, 3])), (turn, np.array([0.0, 0, 3]))]
    views = tuple(
        replace(scene.views[0], name=name, rotation=rotation, translation=translation, points=everything)
        for name, (rotation, translation) in zip("ab", poses, strict=True)
    )
    turned = SceneMap(points, everything.astype(np.int64), np.full(140, 2, np.int32), views)
    pixels = 520 * seen(points, *poses[0]) + [400, 300]
    for rotation, translation in poses:
        prior = PosePrior(rotation, translation, 5.0, 0.3)
        found = turned.localize(pixels, PINHOLE, prior=prior, solver="search", time_limit=20)
        assert degrees_between(found.rotation, rotation) < 1


def test_localize_uses_the_given_solver(planted: tuple[SceneMap, Planted]) -> None:
    class Refuses(torch.nn.Module):
        def forward(self, batch: object) -> None:
            raise RuntimeError("was asked")

    scene, truth = planted
    with pytest.raises(RuntimeError, match="was asked"):
        scene.localize(photo_of(truth, 0)[0], PINHOLE, solver=Refuses())


@pytest.mark.nightly
def test_the_seed_decides_where_nothing_else_does(
    planted: tuple[SceneMap, Planted], monkeypatch: pytest.MonkeyPatch
) -> None:
    scene, _ = planted
    monkeypatch.setattr("bpnp.maps.localize.LONGER", BRIEF)
    noise = np.random.default_rng(0).uniform((0, 0), (800, 600), (90, 2))
    guesses = [
        scene.localize(noise, PINHOLE, views=["photo 0.jpg"], solver="search", seed=seed, time_limit=1e5)
        for seed in (0, 0, 1)
    ]
    np.testing.assert_array_equal(guesses[0].rotation, guesses[1].rotation)
    assert not np.array_equal(guesses[0].rotation, guesses[2].rotation)


@pytest.mark.slow
def test_keypoints_of_another_place_are_never_confident(planted: tuple[SceneMap, Planted]) -> None:
    scene, _ = planted
    for seed in range(3):
        noise = np.random.default_rng(seed).uniform((0, 0), (800, 600), (90, 2))
        assert scene.localize(noise, PINHOLE, time_limit=3).verdict != "confident"


def test_a_view_with_too_few_points_is_skipped(planted: tuple[SceneMap, Planted]) -> None:
    scene, _ = planted
    poor = replace(scene.views[2], points=scene.views[2].points[:3])
    noise = np.random.default_rng(0).uniform((0, 0), (800, 600), (40, 2))
    solution = replace(scene, views=(scene.views[0], poor)).localize(noise, PINHOLE, solver="search", time_limit=2)
    assert solution.verdict == "failed"
    with pytest.raises(ValueError, match="no view of the map sees 4 or more points"):
        replace(scene, views=(poor,)).localize(noise, PINHOLE)


def test_bad_input_is_one_clear_error(planted: tuple[SceneMap, Planted]) -> None:
    scene, truth = planted
    keypoints, _ = photo_of(truth, 0)
    with pytest.raises(ValueError, match=r"the map has no views nowhere; its views are photo 0\.jpg"):
        scene.localize(keypoints, PINHOLE, views=["nowhere"])
    with pytest.raises(ValueError, match="`views` is empty; give names of views, or None"):
        scene.localize(keypoints, PINHOLE, views=[])
    with pytest.raises(ValueError, match=r"`scores` has the shape \(3,\), not \(105,\)"):
        scene.localize(keypoints, PINHOLE, scores=[1, 2, 3])
    with pytest.raises(ValueError, match="`time_limit` is 0; it must be a positive number"):
        scene.localize(keypoints, PINHOLE, time_limit=0)


def test_coefficients_of_opencv_belong_to_the_camera(
    planted: tuple[SceneMap, Planted], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)
    scene, truth = planted
    with pytest.raises(
        ValueError, match="`distortion` is not True or False; give a camera of OpenCV as camera=.K, dist"
    ):
        scene.localize(photo_of(truth, 0)[0], PINHOLE, distortion=np.zeros(5))  # type: ignore[arg-type]


def found_with_few_points(found: Solved) -> Solved:
    """Return the solution as not significant, although its pose is right."""
    poses = replace(found.case.candidates, log10_false_alarms=np.full(len(found.case.candidates), 3.0))
    case = replace(found.case, candidates=poses)
    return Solved(case, replace(with_verdict(found.solution, decide(case)), log10_false_alarms=3.0))


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.parametrize("known", [{"camera": PINHOLE}, {"image_size": (800, 600)}], ids=["camera", "focal length"])
def test_a_pose_that_one_view_does_not_decide_is_judged_on_all_points(
    planted: tuple[SceneMap, Planted], monkeypatch: pytest.MonkeyPatch, known: dict[str, Any]
) -> None:
    scene, truth = planted
    pixels = 520 * seen(truth.points3d, truth.rotations[1], truth.translations[1]) + [400, 300]
    pixels = pixels[((pixels > 0) & (pixels < [800, 600])).all(1)]
    pixels += np.random.default_rng(0).normal(0, 0.3, pixels.shape)
    near = localize.search_near
    monkeypatch.setattr(localize, "search_near", lambda *a: found_with_few_points(near(*a)))
    solution = scene.localize(pixels, **known, views=["photo 1.jpg"], solver="search", time_limit=1e5)
    assert solution.verdict == "confident"
    assert degrees_between(solution.rotation, truth.rotations[1]) < 0.2
    assert (~np.isin(solution.matched_point_ids, truth.seen[1] + 1)).sum() > 4


@pytest.mark.slow
def test_an_unknown_lens_is_fitted_to_all_points(planted: tuple[SceneMap, Planted]) -> None:
    scene, truth = planted
    in_camera = truth.points3d @ truth.rotations[1].T + truth.translations[1]
    lens = camera_from(("SIMPLE_RADIAL", (520.0, 400.0, 300.0, -0.15)))
    pixels = lens.project(in_camera)
    pixels = pixels[((pixels > 0) & (pixels < [800, 600])).all(1)]
    pixels += np.random.default_rng(0).normal(0, 0.5, pixels.shape)
    half = replace(scene.views[1], points=scene.views[1].points[::2])
    part = replace(scene, views=(scene.views[0], half, scene.views[2]))
    solution = part.localize(pixels, image_size=(800, 600), views=["photo 1.jpg"], solver="search", time_limit=1e5)
    assert abs(solution.focal_length - 520) < 3 * solution.focal_length_std < 50
    assert (~np.isin(solution.matched_point_ids, scene.point_ids[half.points])).sum() > 10


def test_each_view_that_is_tried_counts_once(planted: tuple[SceneMap, Planted]) -> None:
    scene, truth = planted
    keypoints, _ = photo_of(truth, 1)
    region = scene.region(scene.views[1])
    one, hundred = (Photo(keypoints, camera_from(PINHOLE), view_count=views) for views in (1, 100))
    of_view = localize.search_near(region, one, one.camera, Options(asks=False), localize.ONCE)
    solved = judge_on_all_points(of_view, refine_on_all_points(of_view.solution, one, region))
    alone = solved.solution
    # With 100 views the NFA of the refined pose is not smaller than that of the given one, which counts one.
    counted = judge_on_all_points(solved, refine_on_all_points(alone, hundred, region)).solution
    assert counted.log10_false_alarms == alone.log10_false_alarms
    first, other = (photo.problem(region, PINHOLE) for photo in (one, hundred))
    pose = alone.rotation[None], alone.translation[None]
    assert alarms_of(other, *pose).own[0] - alarms_of(first, *pose).own[0] == pytest.approx(2)


def test_a_competing_pose_of_one_view_competes_on_all_points(planted: tuple[SceneMap, Planted]) -> None:
    """An ambiguous solution whose second candidate is the true pose, and whose first one is far from it."""
    scene, truth = planted
    keypoints, _ = photo_of(truth, 1)
    right = scene.localize(keypoints, PINHOLE, views=["photo 1.jpg"], solver="search", time_limit=1e5)
    turn = Rotation.from_euler("y", 10, degrees=True).as_matrix()
    wrong = replace(right.candidates[0], rotation=turn @ right.rotation, translation=turn @ right.translation)
    few_matches = replace(
        right, rotation=wrong.rotation, translation=wrong.translation, verdict="ambiguous",
        log10_false_alarms=-5.0, candidates=(wrong, right.candidates[0]),
    )  # fmt: skip
    few_matches = replace(few_matches, matches=few_matches.matches[:4])
    photo = Photo(keypoints, camera_from(PINHOLE))
    refined = refine_on_all_points(few_matches, photo, scene.region(scene.views[1]))
    assert refined is not None
    solution = judge_on_all_points(Solved(Case.without_pose(refined.problem), few_matches), refined).solution
    assert degrees_between(solution.rotation, right.rotation) < 0.5
    assert solution.verdict == "confident"


@pytest.mark.slow
def test_a_photo_is_localised_without_its_focal_length(tmp_path: Path) -> None:
    pinhole = ("PINHOLE", [520.0, 520.0, WIDTH / 2, HEIGHT / 2])
    truth = plant_model(tmp_path, camera=pinhole, images=2, points=140, seen=90, clutter=0)
    scene, pixels = SceneMap.from_colmap(tmp_path), 520 * truth.points2d[0] + [WIDTH / 2, HEIGHT / 2]
    bent = camera_from(("SIMPLE_RADIAL", (520.0, WIDTH / 2, HEIGHT / 2, -0.3))).project(
        np.c_[truth.points2d[0], np.ones(90)]
    )
    size, rough = {"image_size": (WIDTH, HEIGHT)}, ("SIMPLE_PINHOLE", (560.0, WIDTH / 2, HEIGHT / 2))
    for keypoints, known in (
        (pixels, size),
        (pixels, {"camera": rough, "focal_error": 0.1}),
        (bent, size | {"distortion": True}),
    ):
        solution = scene.localize(keypoints, **known, views=["photo 0.jpg"], solver="search")
        assert solution.focal_length == pytest.approx(520, rel=0.01)
        assert degrees_between(solution.rotation, truth.rotations[0]) < 0.1
    with pytest.raises(ValueError, match="`camera` is missing; give it, or `image_size`"):
        scene.localize(pixels)
