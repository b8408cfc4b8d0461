"""The training-free search and the refinement find planted poses, and say when they do not."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from planted import directions, plant
from scipy.spatial.transform import Rotation

from bpnp.metrics import rotation_error
from bpnp.models import Search
from bpnp.models.batch_search import best_poses
from bpnp.search.find import search_poses
from bpnp.search.problem import Problem
from bpnp.search.schedule import GUESSED_BATCHES
from bpnp.search.settings import DEFAULT, SearchSettings
from bpnp.search.starts import PosePrior

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def problem():
    return plant(3, 200, seed=4, noise=1e-4)


def search(f, p, prior=None, **options):
    """`search_poses` of each sample: rotation, translation and stats of the best pose."""
    problems = [Problem.of(x.double().numpy(), y.double().numpy(), prior=prior) for x, y in zip(f, p, strict=True)]
    pose = best_poses(((each, search_poses(each, **options)) for each in problems), p)
    return pose.rotation, pose.translation, pose.stats


@pytest.mark.parametrize("off", [0.05, 1.0])
def test_a_guess_from_the_same_points_is_tried_first_and_is_no_prior(problem, off):
    """One near the true pose and one 57 degrees off: the search goes everywhere unless the matches are unique."""
    rotation, translation = (values[0].numpy() for values in problem.near(off, seed=1))
    points = Problem.of(problem.bearings[0].numpy(), problem.points3d[0].numpy())
    result = search_poses(points, around=points.prior_from_user(PosePrior(rotation, translation, 4.0, 0.1)))
    assert result.verdict == "confident"
    assert rotation_error(torch.as_tensor(result.best[0])[None], problem.rotation[:1]) < 0.5
    assert (result.iterations <= GUESSED_BATCHES) == (off < 0.1)


@pytest.mark.parametrize(
    ("call", "named"),
    [
        (lambda: Search(time_limit=0.0), "`time_limit` is 0.0; it must be above 0"),
        (lambda: DEFAULT.expecting(1.0), "`clutter` is 1.0; it is a fraction of the points"),
        (lambda: SearchSettings(iterations=0), "`iterations` is 0"),
        (lambda: SearchSettings(outliers=1.0), "`outliers` is 1.0"),
    ],
)
def test_settings_without_a_meaning_are_refused(call, named):
    with pytest.raises(ValueError, match=named):
        call()


def test_far_points_change_neither_the_initial_poses_nor_the_scale(problem):
    """A reconstruction's few points far away decide neither where the search starts nor its scale."""
    torch.manual_seed(5)
    points3d, rays = problem.points3d[:1].clone(), problem.bearings[:1].clone()
    far = torch.randperm(points3d.shape[1])[:4]
    points3d[0, far] *= 1e5
    camera = points3d[0, far] @ problem.rotation[0].T + problem.translation[0]
    rays[0, far] = torch.nn.functional.normalize(camera, dim=-1)
    rotation, _, stats = search(rays, points3d, settings=DEFAULT.limited(8))
    assert bool(stats.converged[0])
    assert rotation_error(rotation, problem.rotation[:1]).item() < 1


@pytest.mark.parametrize("spread", [0.1, 0.01, 0.003, 0.0008])
def test_narrow_views_are_solved_like_wide_ones(spread: float) -> None:
    """80 points of unit extent seen under `spread` radians from far away, noise of 0.002 of it, 10 outliers a side."""
    rng = np.random.default_rng(1)
    points, noise = rng.normal(size=(90, 3)), 0.002 * spread * rng.normal(size=(80, 3))
    rotation, translation = Rotation.random(rng=rng).as_matrix(), np.array([0.1, -0.2, np.sqrt(2) / spread])
    camera = points[:80] @ rotation.T + translation
    outliers = np.column_stack([spread * rng.normal(size=(10, 2)), np.ones(10)])
    rays = np.concatenate([directions(camera) + noise, outliers])
    aside = Rotation.random(rng=rng).as_matrix()  # the view is not along the camera's axis
    rays = directions(rays) @ aside.T
    problem = Problem.of(rays, points)
    found = search_poses(problem)
    turned, moved = problem.to_user(*found.best)
    assert found.verdict == "confident"
    assert np.degrees(Rotation.from_matrix(turned.T @ aside @ rotation).magnitude()) < 0.2
    assert np.linalg.norm(moved - aside @ translation) < 0.002 * translation[2]
    assert found.residual == pytest.approx(0.002 * spread, rel=0.3)


def test_points_on_a_line_or_without_a_common_label_have_no_pose():
    rng = np.random.default_rng(4)
    problem = Problem.of(directions(rng.normal(size=(300, 3)) + [0, 0, 4]), rng.normal(size=(280, 3)))
    labelled = replace(problem, labels2d=np.ones(300, np.int64), labels3d=np.full(280, 2))
    for lacking in (labelled, Problem.of(problem.bearings, problem.points3d[:, :1] * [1.0, 2, 3])):
        result = search_poses(lacking)
        assert (result.verdict, result.iterations, len(result.candidates)) == ("failed", 0, 0)


def planted_points(count: int) -> tuple[Problem, np.ndarray, np.ndarray]:  # type: ignore[type-arg]
    """Return the problem of a planted pose, and this pose in its frame."""
    rng = np.random.default_rng(count)
    scene, rotation = rng.normal(size=(count, 3)), Rotation.from_euler("xyz", [0.4, -0.2, 0.9]).as_matrix()
    camera = scene @ rotation.T + [0, 0, 7]
    problem = Problem.of(rng.permutation(camera / np.linalg.norm(camera, axis=1, keepdims=True)), scene)
    return problem, *problem.from_user(rotation, np.array([0, 0, 7.0]))


@pytest.mark.parametrize("count", [40, 200])  # few enough to be enumerated, and too many
def test_a_search_from_proposals_only_starts_nowhere_else(count: int) -> None:
    problem, rotation, translation = planted_points(count)
    near = Rotation.from_euler("x", 4, degrees=True).as_matrix() @ rotation
    half_turn = Rotation.from_euler("y", 180, degrees=True).as_matrix()
    proposed = {"right": near, "wrong": half_turn @ rotation}
    found, calls = {}, []

    def proposals(name: str) -> tuple[np.ndarray, np.ndarray]:  # type: ignore[type-arg]
        calls.append(name)
        lost = np.full((1, 3, 3), np.nan)
        return np.concatenate([lost, proposed[name][None]]), np.stack([translation, translation])

    for name in proposed:
        found[name] = search_poses(problem, proposals=partial(proposals, name), only_proposals=True)
    assert calls == ["right", "wrong"]
    np.testing.assert_allclose(found["right"].best[0], rotation, atol=1e-3)
    assert found["right"].log10_false_alarms < -20
    assert found["wrong"].verdict == "failed"
    with pytest.raises(ValueError, match=r"have the shapes \(3, 3\) and \(3,\)"):
        search_poses(problem, proposals=lambda: (rotation, translation), only_proposals=True)
