"""Every option of `solve` changes the answer in a way that is known beforehand."""

import math
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pycolmap
import pytest
import torch
import trimesh
from planted import degrees_between, plant, seen
from scipy.spatial.transform import Rotation

import bpnp
from bpnp import GravityPrior, PosePrior, Solution, solve
from bpnp.arrays import Array
from bpnp.cli import main
from bpnp.search.arguments import checked_prior, scene_points
from bpnp.search.settings import DEFAULT
from bpnp.search.solvers import Options

RNG = np.random.default_rng(5)
OBJECT = RNG.uniform(-1, 1, (80, 3))
POSES = [(Rotation.random(random_state=k).as_matrix(), np.array([side, 0.1, 7.0])) for k, side in ((1, -0.8), (2, 0.9))]
NOISE2D, NOISE3D = RNG.uniform(-0.4, 0.4, (150, 2)), RNG.normal(size=(150, 3))


# An image of two objects of one make, and a scene in which one object stands twice.
TWO_IN_THE_IMAGE = np.concatenate([seen(OBJECT, *pose) for pose in POSES])
SHIFT = np.array([3.0, 0, 0])
TWO_IN_THE_SCENE = np.concatenate([OBJECT, OBJECT + SHIFT])


def which(solution: Solution) -> int:
    """The object of the image whose pose it is."""
    return int(np.argmin([degrees_between(solution.rotation, rotation) for rotation, _ in POSES]))


@pytest.mark.slow
@pytest.mark.parametrize("likely", [0, 1])
def test_scores_and_labels_decide_between_two_equal_objects(likely: int) -> None:
    first = np.repeat([True, False], 80)
    mine = first if likely == 0 else ~first
    by_score = solve(TWO_IN_THE_IMAGE, OBJECT, scores2d=np.where(mine, 1.0, 0.05), time_limit=600)
    assert which(by_score) == likely
    labels = {"labels2d": np.where(mine, 3, 5), "labels3d": np.full(80, 3)}
    by_label = solve(TWO_IN_THE_IMAGE, OBJECT, **labels, time_limit=600)
    assert which(by_label) == likely
    assert mine[by_label.matches[:, 0]].all()
    image, labels3d = seen(OBJECT, *POSES[0]), np.where(mine, 2, 4)
    solution = solve(image, TWO_IN_THE_SCENE, labels2d=np.full(80, 2), labels3d=labels3d, time_limit=600)
    assert mine[solution.matches[:, 1]].all()


def test_scores_of_scene_points_weigh_the_likelihood() -> None:
    """Half of the scene is likely to be seen: each of its points is then 160 / 84 times as likely."""
    planted = plant(1, 80, outliers3d=80, seed=4)
    points = planted.points2d[0], planted.points3d[0]
    scores = np.where(planted.match3d[0] >= 0, 1.0, 0.05)
    weighted, plain = (solve(*points, scores3d=known, clutter=0.3).candidates[0].score for known in (scores, None))
    assert weighted - plain == pytest.approx(math.log(160 / 84), abs=0.1)


@pytest.mark.parametrize("largest", [1e-20, 1e-300, 5e-324])
def test_only_ratios_of_scores_matter(largest: float) -> None:
    """Scores below the smallest float32 number left no points to search."""
    scores = np.full(80, largest)
    solution = solve(seen(OBJECT, *POSES[0]), OBJECT, scores2d=scores, scores3d=scores, time_limit=600)
    assert solution.verdict == "confident"
    assert degrees_between(solution.rotation, POSES[0][0]) < 0.1
    np.testing.assert_array_equal(solution.matches[:, 0], solution.matches[:, 1])


def test_equal_objects_are_ambiguous_and_a_prior_decides() -> None:
    """Points that a half turn about z maps onto themselves: both poses are candidates."""
    half = RNG.uniform(-1, 1, (6, 3))
    points = np.concatenate([half, half * [-1, -1, 1]])
    rotation, translation = Rotation.from_rotvec([0.5, 0.3, 0.8]).as_matrix(), np.array([0.0, 0.05, 6.0])
    image = seen(points, rotation, translation)
    free = solve(image, points)
    assert free.verdict == "ambiguous"
    for turned in (rotation, rotation @ np.diag([-1.0, -1, 1])):
        assert min(degrees_between(candidate.rotation, turned) for candidate in free.candidates) < 1
        near = Rotation.from_rotvec([0.03, -0.02, 0.03]).as_matrix() @ turned
        solution = solve(image, points, prior=PosePrior(near, translation, 3.0, 0.2))  # type: ignore[arg-type]
        assert degrees_between(solution.rotation, turned) < 1
    up = np.array([1.0, 0, 0])  # of the scene: upside down in the competing pose
    solution = solve(image, points, prior=GravityPrior(rotation @ up, up, 1.0))  # type: ignore[arg-type]
    assert degrees_between(solution.rotation, rotation) < 1


def prior_forms(rotation: Array, translation: Array) -> dict[str, object]:
    matrix = np.eye(4)
    matrix[:3] = np.c_[rotation, translation]
    pose = pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), translation)
    solution = solve(seen(OBJECT, rotation, translation), OBJECT)
    forms = {"(R, t)": (rotation, translation), "4x4": matrix, "3x4": matrix[:3], "list": matrix.tolist()}
    return forms | {"Rigid3d": pose, "Solution": solution, "Candidate": solution.candidates[0]}


@pytest.mark.slow
@pytest.mark.parametrize("likely", [0, 1])
def test_every_object_that_holds_a_pose_is_a_prior(likely: int) -> None:
    rotation, translation = POSES[likely]
    for form, pose in prior_forms(rotation, translation).items():
        prior = checked_prior(pose)
        assert isinstance(prior, PosePrior), form
        assert (prior.rotation_sigma_deg, prior.translation_sigma) == (10, math.inf)
        np.testing.assert_allclose(prior.rotation, rotation, atol=1e-6)
        np.testing.assert_allclose(prior.translation, translation, atol=1e-5)
    rows = np.column_stack([rotation, translation]).tolist()
    for pose in ((rotation, translation), rows):
        assert which(solve(TWO_IN_THE_IMAGE, OBJECT, prior=pose)) == likely


def test_clouds_and_meshes_of_other_libraries_are_points() -> None:
    faces = np.arange(78)[:, None] + np.arange(3)
    open3d = SimpleNamespace(points=[tuple(point) for point in OBJECT.tolist()])  # a list of its own kind
    for cloud in (trimesh.PointCloud(OBJECT), trimesh.Trimesh(OBJECT, faces, process=False), open3d):
        np.testing.assert_allclose(scene_points(cloud), OBJECT)


def test_a_solution_is_true_where_it_has_a_pose() -> None:
    found = solve(seen(OBJECT, *POSES[0]), OBJECT)
    assert found
    assert not replace(found, rotation=np.full((3, 3), np.nan), verdict="failed")


def test_duplicates_are_named_where_the_verdict_is_not_confident() -> None:
    few, pose = OBJECT[:4], POSES[0]
    image, scene = np.repeat(seen(few, *pose), 2, 0), np.repeat(few, 3, 0)
    solution = solve(image, scene)
    assert solution.verdict != "confident"
    assert solution.reason.endswith("4 of the image points are duplicates; 8 of the scene points are duplicates")


def test_normals_decide_from_which_side_a_point_is_visible() -> None:
    normals = np.tile([0.0, 0.0, -1.0], (60, 1))  # towards a camera with R = I
    board = np.column_stack([RNG.uniform(-1, 1, (60, 2)), 0.4 * RNG.uniform(-1, 1, 60)])
    image = seen(board, np.eye(3), [0.0, 0, 6])
    assert degrees_between(solve(image, board, normals3d=normals).rotation, np.eye(3)) < 0.1
    behind = solve(image, board, normals3d=-normals, time_limit=1.0)
    assert not behind.found or degrees_between(behind.rotation, np.eye(3)) > 5


def test_clutter_is_the_outlier_fraction_of_the_likelihood() -> None:
    """If all points match, and none is near another, the score has the term log (1 - w), whatever its other terms."""
    planted = plant(1, 100)
    few, many = (solve(planted.points2d[0], planted.points3d[0], clutter=w).candidates[0].score for w in (0.1, 0.6))
    assert few - many == pytest.approx(math.log(0.9 / 0.4), abs=0.05)


def test_the_seed_decides_where_nothing_else_does(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("bpnp.search.api.Options", partial(Options, settings=DEFAULT.limited(4)))
    guesses = [solve(NOISE2D, NOISE3D, solver="search", seed=seed, time_limit=math.inf) for seed in (0, 0, 1)]
    np.testing.assert_array_equal(guesses[0].rotation, guesses[1].rotation)
    assert not np.array_equal(guesses[0].rotation, guesses[2].rotation)


def test_a_time_limit_ends_the_search() -> None:
    planted = plant(1, 300, noise=0.001, outliers2d=300, outliers3d=300)
    points = planted.points2d[0], planted.points3d[0]
    ended = solve(*points, solver="search", time_limit=1e-3)
    assert (ended.verdict, ended.stats.iterations) == ("failed", 0)
    assert ended.reason == "no pose was found; not decided in 0.001 s, a longer time limit may decide it"
    assert solve(*points, solver="search").stats.iterations > 0


def test_a_threshold_bounds_the_errors_of_matches() -> None:
    planted = plant(1, 80, noise=0.002)
    points = planted.points2d[0].numpy(), planted.points3d[0].numpy()
    solutions = [solve(*points, inlier_threshold=threshold) for threshold in (0.001, 0.01)]
    for solution, threshold in zip(solutions, (0.001, 0.01), strict=True):
        i, j = solution.matches.T
        errors = np.linalg.norm(points[0][i] - seen(points[1], solution.rotation, solution.translation)[j], axis=1)
        assert 0.8 * threshold < errors.max() * (1 if threshold == 0.001 else 2) <= 2 * threshold
    assert solutions[0].inlier_count < solutions[1].inlier_count


def test_a_module_computes_on_the_device() -> None:
    class Where(torch.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.part = torch.nn.Linear(1, 1)

        def forward(self, batch: object) -> None:
            raise RuntimeError(self.part.weight.device.type)

    module = Where()
    for device, expected in (("meta", "meta"), (None, "cpu")):
        with pytest.raises(RuntimeError, match=expected):
            solve(NOISE2D, NOISE3D, solver=module, device=device)
    assert module.part.weight.device.type == "cpu"


def test_warm_up_compiles_once(capsys: pytest.CaptureFixture[str]) -> None:
    bpnp.warm_up()
    main(["warm-up"])
    word, _, seconds, unit = capsys.readouterr().out.split()
    assert (word, unit) == ("compiled", "s")
    assert float(seconds) < 2
