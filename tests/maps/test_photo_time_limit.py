"""A photo's time limit: after it no view, focal length, pose on all points or place elsewhere is begun."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from moved_clock import LATER, MovedClock
from planted import degrees_between, seen
from planted_model import HEIGHT, PINHOLE, WIDTH, Planted, plant_model
from scipy.spatial.transform import Rotation

from bpnp import SceneMap
from bpnp.cameras import camera_from

TURN = Rotation.from_euler("xyz", [4, -6, 3], degrees=True).as_matrix()


@pytest.fixture(scope="module")
def planted(tmp_path_factory: pytest.TempPathFactory) -> tuple[SceneMap, Planted]:
    folder: Path = tmp_path_factory.mktemp("map")
    truth = plant_model(folder, camera=PINHOLE, images=3, points=140, seen=90, clutter=15)
    return SceneMap.from_colmap(folder), truth


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> MovedClock:
    return MovedClock(monkeypatch)


def pixels_of(truth: Planted) -> np.ndarray:
    pixels = 520 * seen(truth.points3d[truth.seen[1]], TURN @ truth.rotations[1], truth.translations[1]) + [400, 300]
    return np.concatenate([pixels, truth.clutter_px[1]])


@pytest.mark.parametrize("stage", ["solve_problems", "refine_on_all_points", "judge_on_all_points", "find_competitor"])
def test_a_pose_that_was_not_compared_in_the_map_is_ambiguous(
    planted: tuple[SceneMap, Planted], clock: MovedClock, stage: str
) -> None:
    scene, truth = planted
    clock.stop_at(f"maps.localize.{stage}", after=stage == "solve_problems")
    kernels = ("maps.all_points.search_around", "maps.aliasing.search_near", "maps.aliasing.search_around")
    late = [clock.count_late(kernel) for kernel in (*kernels, "search.verdict.rivals.symmetries.repeated_poses")]
    solution = scene.localize(pixels_of(truth), camera_from(PINHOLE), time_limit=30)
    assert not any(late)
    assert degrees_between(solution.rotation, TURN @ truth.rotations[1]) < 1
    assert solution.verdict == "ambiguous"
    assert {"competing poses", "focal lengths"} & set(solution.stats.unfinished)
    assert "Not decided in 30 s, with 1 of 3 views tried" in solution.reason


def test_a_fit_of_the_focal_length_on_all_points_ends_at_the_limit(
    planted: tuple[SceneMap, Planted], clock: MovedClock
) -> None:
    scene, truth = planted
    clock.stop_at("maps.all_points.fit_camera")
    steps, searches = (clock.count_late(name) for name in ("search.focal_length.fit_lens", "maps.all_points.finish"))
    solution = scene.localize(pixels_of(truth), image_size=(WIDTH, HEIGHT), time_limit=5)
    assert not steps
    assert not searches
    assert solution.verdict != "confident"
    assert solution.reason.startswith("Not decided in 5 s")
    assert solution.reason.lower().count("not decided in") == 1


def test_no_view_is_tried_after_the_limit_with_an_unknown_focal_length(
    planted: tuple[SceneMap, Planted], clock: MovedClock
) -> None:
    """The searches with several focal lengths share the limit of the photo with all views."""
    scene, truth = planted
    rng = np.random.default_rng(0)
    clock.stop_at("search.schedule.search_near", after=True)
    late = [clock.count_late(f"search.schedule.{name}") for name in ("search_near", "multistart", "search_around")]
    pixels = rng.uniform(0, [WIDTH, HEIGHT], (60, 2))
    views = [view.name for view in scene.views]
    solution = scene.localize(pixels, image_size=(WIDTH, HEIGHT), views=views, time_limit=60)
    assert not any(late)
    assert solution.verdict == "failed"
    assert "views" in solution.stats.unfinished
    assert "with 1 of 3 views tried" in solution.reason


def test_the_pose_of_a_view_is_compared_within_its_limit(tmp_path: Path, clock: MovedClock) -> None:
    truth = plant_model(tmp_path, camera=PINHOLE, images=4, points=140, seen=120, clutter=5)
    scene = SceneMap.from_colmap(tmp_path)
    pixels = 520 * seen(truth.points3d[truth.seen[0]], truth.rotations[0], truth.translations[0]) + [400, 300]
    clock.stop_at("maps.verify_view.verify_problem", after=True)
    late = [clock.count_late(f"maps.aliasing.{name}") for name in ("search_near", "repeated_poses", "anneal_to_end")]
    solution = scene.verify_view(scene.views[0].name, pixels)
    assert not any(late)
    assert (solution.verdict, solution.reason_code) == ("ambiguous", "untested")
    assert solution.reason.endswith("not decided in 10 s, a longer time limit may decide it")


def test_searches_leave_time_to_judge_a_pose(planted: tuple[SceneMap, Planted], clock: MovedClock) -> None:
    """The time for searches has passed, that for the verdict has not: the pose is refined and compared."""
    scene, truth = planted

    def after(original: Callable[..., Any], *arguments: Any, **options: Any) -> Any:
        result = original(*arguments, **options)
        clock.time = 29.5
        return result

    assert LATER > 30
    clock.wrap("maps.localize.solve_problems", after)
    solution = scene.localize(pixels_of(truth), camera_from(PINHOLE), time_limit=30)
    assert solution.verdict == "confident"
    assert solution.stats.unfinished == ()
