"""A place of the map that looks like another one: a box with two faces printed alike, seen from all around."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from planted import degrees_between, seen
from scipy.spatial.transform import Rotation

from bpnp import GravityPrior, PosePrior, SceneMap
from bpnp.cameras import camera_from
from bpnp.maps.aliasing import best_competitor
from bpnp.maps.localize import ONCE, ViewSolution, judge_in_map, search_near
from bpnp.maps.photo_problem import Photo
from bpnp.maps.viewed_points import Place
from bpnp.maps.views import View
from bpnp.search.assemble import Solved
from bpnp.search.solvers import Options
from bpnp.search.verdict.decide import Case

pytestmark = pytest.mark.slow

FOCAL, ALIKE, DIFFERENT = 800.0, 150, 40  # pixels; points of a face
CAMERA = np.diag([FOCAL, FOCAL, 1.0])
Array = np.ndarray


def about_y(degrees: float) -> Array:
    return np.asarray(Rotation.from_euler("y", degrees, degrees=True).as_matrix())


def box(rng: np.random.Generator, turns: tuple[float, ...], alike: int = ALIKE) -> tuple[Array, Array]:
    """Points (n, 3) and normals (n, 3) of the four sides of a box with a relief; the sides turned by `turns` degrees
    from the front have `alike` points in common with it."""

    def print_of(count: int) -> Array:
        return np.column_stack([rng.uniform(-1, 1, (count, 2)), rng.uniform(-1.1, -1, count)])

    printed, points, normals = print_of(alike), [], []
    for degrees in (0.0, 90.0, 180.0, 270.0):
        own = print_of(ALIKE + DIFFERENT)
        if degrees in turns:
            own[:alike] = printed
        points.append(own @ about_y(degrees).T)
        normals.append(np.tile(about_y(degrees)[:, 2] * -1, (len(own), 1)))
    return np.concatenate(points), np.concatenate(normals)


def pose_at(degrees: float, distance: float, tilt: float = 5.0) -> tuple[Array, Array]:
    """Return the pose of a camera that looks at the centre of the box, at 0 degrees from the front."""
    rotation = Rotation.from_euler("x", tilt, degrees=True).as_matrix() @ about_y(degrees).T
    return rotation, np.array([0.0, 0.0, distance])


def facing(points: Array, normals: Array, rotation: Array, translation: Array) -> Array:
    """Return the indices of the points that face the camera."""
    towards = -rotation.T @ translation - points
    return np.flatnonzero((towards * normals).sum(-1) > 0.2 * np.linalg.norm(towards, axis=-1))


def map_of(points: Array, normals: Array) -> SceneMap:
    poses = [pose_at(degrees, 5.0) for degrees in range(10, 370, 40)]
    views = tuple(
        View(f"{i}.jpg", camera_from(CAMERA), *pose, facing(points, normals, *pose).astype(np.int32))
        for i, pose in enumerate(poses)
    )
    return SceneMap(points, np.arange(len(points)), np.zeros(len(points), np.int32), views).seen_by(2)


def photo_of(rng: np.random.Generator, points: Array, normals: Array, rotation: Array, translation: Array) -> Array:
    """Pixels of 7 of 10 points that face the camera, half a pixel off, and of as many more that are anywhere."""
    pixels = FOCAL * seen(points[facing(points, normals, rotation, translation)], rotation, translation)
    pixels = pixels[rng.random(len(pixels)) < 0.7]
    clutter = rng.uniform(pixels.min(0), pixels.max(0), pixels.shape)
    return np.concatenate([pixels + rng.normal(0, 0.5, pixels.shape), clutter])


OPPOSITE, ADJACENT = (0.0, 180.0), (0.0, 90.0)


@pytest.mark.nightly
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("turns", [OPPOSITE, ADJACENT])
def test_a_face_that_is_printed_like_another_one_is_never_taken_for_it(turns: tuple[float, float], seed: int) -> None:
    rng = np.random.default_rng(seed)
    points, normals = box(rng, turns)
    front = {OPPOSITE: (4, 184, -16), ADJACENT: (4, 94, -10)}[turns][seed]
    pose = pose_at(front, 4.2, -3.0)
    keypoints = photo_of(rng, points, normals, *pose)
    solution = map_of(points, normals).localize(keypoints, CAMERA, seed=seed)
    assert solution.verdict == "confident"  # the 40 points that differ are enough to tell
    assert degrees_between(solution.rotation, pose[0]) < 1


@pytest.mark.parametrize("turns", [OPPOSITE, ADJACENT])
def test_faces_that_are_alike_in_all_points_are_ambiguous_and_both_poses_are_candidates(
    turns: tuple[float, float],
) -> None:
    rng = np.random.default_rng(0)
    points, normals = box(rng, turns, alike=ALIKE + DIFFERENT)
    pose = pose_at(-4.0, 4.2, -3.0)
    pixels = FOCAL * seen(points[: ALIKE + DIFFERENT], *pose)  # the front alone
    clutter = rng.uniform(pixels.min(0), pixels.max(0), (100, 2))
    keypoints = np.concatenate([pixels + rng.normal(0, 0.5, pixels.shape), clutter])
    solution = map_of(points, normals).localize(keypoints, CAMERA)
    assert solution.verdict == "ambiguous"
    assert "elsewhere in the map, explains the image points about as well" in solution.reason
    other = pose[0] @ about_y(turns[1]).T
    off = [min(degrees_between(one.rotation, truth) for one in solution.candidates[:2]) for truth in (pose[0], other)]
    assert max(off) < 1
    np.testing.assert_array_equal(solution.candidates[0].rotation, solution.rotation)


def map_twice(one: SceneMap, size: float, turn: Array, shift: Array) -> SceneMap:
    """Return a map with a second place of these points, `size * turn @ p + shift`, seen by as many views."""
    again = []
    for view in one.views:
        turned, places = view.rotation @ turn.T, view.points + np.int32(len(one.points3d))
        moved = size * view.translation - turned @ shift
        again.append(View(f"again {view.name}", view.camera, turned, moved, places))
    both = np.concatenate([one.points3d, size * one.points3d @ turn.T + shift])
    return SceneMap(both, np.arange(len(both)), np.zeros(len(both), np.int32), (*one.views, *again)).seen_by(2)


@pytest.mark.parametrize("seed", range(2))
def test_a_place_that_occurs_twice_is_ambiguous_at_any_size(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points, normals = box(rng, ())
    turn = Rotation.random(rng=rng).as_matrix()
    twice = map_twice(map_of(points, normals), 1.4, turn, np.array([40.0, -10.0, 25.0]))
    rotation, translation = pose_at(14.0, 4.2, -3.0)
    pixels = photo_of(rng, points, normals, rotation, translation)
    solution = twice.localize(pixels, CAMERA, solver="search", seed=seed, time_limit=60)
    assert solution.verdict == "ambiguous"
    found = [degrees_between(one.rotation, rotation) for one in solution.candidates[:2]]
    other = [degrees_between(one.rotation, rotation @ turn.T) for one in solution.candidates[:2]]
    assert min(found) < 1
    assert min(other) < 1


@pytest.mark.nightly
def test_only_a_prior_of_the_position_excludes_an_equal_place() -> None:
    """Neither views of one place, nor the vertical, nor a vague position decide between two equal places."""
    rng = np.random.default_rng(0)
    points, normals = box(rng, ())
    turn, shift = about_y(40.0), np.array([9.0, 0.0, 1.0])
    twice = map_twice(map_of(points, normals), 1.0, turn, shift)
    rotation, translation = pose_at(4.0, 4.2, -3.0)
    pixels, down = photo_of(rng, points, normals, rotation, translation), np.array([0.0, 1.0, 0.0])
    other = rotation @ turn.T
    undecided: list[dict[str, Any]] = [
        {"views": [f"again {view}.jpg" for view in (8, 0, 1)]},
        {"prior": GravityPrior(rotation @ down, down)},
        {"prior": PosePrior(other, translation - other @ shift, 40.0, 8.0)},
    ]
    for known in undecided:
        solution = twice.localize(pixels, CAMERA, solver="search", time_limit=math.inf, **known)
        assert (solution.verdict, solution.reason_code) == ("ambiguous", "competing_place")
        found = [degrees_between(one.rotation, rotation) for one in solution.candidates[:2]]
        assert min(found) < 1
    prior = PosePrior(rotation, translation, 5.0, 0.3)
    solution = twice.localize(pixels, CAMERA, solver="search", time_limit=math.inf, prior=prior)
    assert solution.verdict == "confident"
    assert degrees_between(solution.rotation, rotation) < 1


@pytest.mark.parametrize("seed", [1, 2, 5])
def test_two_equal_places_that_lack_different_points_are_ambiguous(seed: int) -> None:
    """The map has 6 of 10 points of each place, and a point in both, or in one of them, by chance."""
    rng = np.random.default_rng(seed)
    points, normals = box(rng, ())
    twice = map_twice(map_of(points, normals), 1.0, about_y(40.0), np.array([9.0, 0.0, 1.0]))
    kept = np.flatnonzero(rng.random(len(twice.points3d)) < 0.6)
    number = np.full(len(twice.points3d), -1, np.int32)
    number[kept] = np.arange(len(kept))
    views = tuple(replace(view, points=number[view.points][number[view.points] >= 0]) for view in twice.views)
    scene = SceneMap(twice.points3d[kept], kept, np.zeros(len(kept), np.int32), views).seen_by(2)
    rotation, translation = pose_at(4.0, 4.2, -3.0)
    pixels = photo_of(rng, points, normals, rotation, translation)
    clutter = rng.uniform(pixels.min(0), pixels.max(0), pixels.shape)
    solution = scene.localize(np.concatenate([pixels, clutter]), CAMERA, solver="search", time_limit=math.inf)
    assert (solution.verdict, solution.reason_code) == ("ambiguous", "competing_place")


def test_a_better_pose_elsewhere_takes_the_place_of_a_confident_one() -> None:
    """A solution at the face that is printed alike but for 40 points, as a search near its views alone gives."""
    rng = np.random.default_rng(0)
    points, normals = box(rng, OPPOSITE)
    scene, pose = map_of(points, normals), pose_at(4.0, 4.2, -3.0)
    keypoints = photo_of(rng, points, normals, *pose)
    opposite = PosePrior(pose[0] @ about_y(180.0).T, pose[1], 2.0, 0.1)
    view, photo = scene.views[4], Photo(keypoints, camera_from(CAMERA))
    wrong = search_near(scene.region(view, view.points), replace(photo, prior=opposite), photo.camera, Options(), ONCE)
    assert degrees_between(wrong.solution.rotation, opposite.rotation) < 1
    alone = Case.of(wrong.case.candidates[:1], wrong.case.problem, exhaustive=True)
    assert alone.objection is None
    unopposed = Solved(alone, replace(wrong.solution, verdict="confident"))
    attempt = ViewSolution(Place(view, view.points, photo.camera), unopposed, is_judged=False)
    solution = judge_in_map(scene, photo, attempt, []).solution
    assert solution.verdict == "confident"
    assert degrees_between(solution.rotation, pose[0]) < 1
    assert solution.view in ("0.jpg", "1.jpg", "8.jpg")  # which see the front


def test_a_pose_that_is_refined_to_the_best_one_is_no_competitor() -> None:
    rng = np.random.default_rng(0)
    points, normals = box(rng, ())
    scene, pose = map_of(points, normals), pose_at(14.0, 4.2, -3.0)
    keypoints = photo_of(rng, points, normals, *pose)
    solution = scene.localize(keypoints, CAMERA)
    turned = Rotation.from_rotvec([0, 0, np.radians(2.3)]).as_matrix()
    local = replace(solution.candidates[0], rotation=turned @ pose[0], translation=turned @ pose[1])
    photo, place = Photo(keypoints, camera_from(CAMERA)), scene.region(scene.views[0])
    assert best_competitor(photo, place, solution, [local], []) is None
