"""The record of the points: one similarity at the entrance, after which nothing depends on the unit of the scene."""

from dataclasses import FrozenInstanceError

import numpy as np
import pytest
from planted import directions
from scipy.spatial.transform import Rotation

from bpnp.search.find import search_poses
from bpnp.search.problem import Problem
from bpnp.search.starts import GravityPrior, PosePrior

UNITS = 2.0**-30, 1.0, 2.0**30  # powers of two scale without rounding


def scene(count: int = 40) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Bearings, points far from their origin, and the pose."""
    rng = np.random.default_rng(3)
    points = rng.uniform(-1, 1, (count, 3)) + [40, -20, 10]
    rotation = Rotation.random(random_state=rng).as_matrix()
    translation = np.array([0.1, -0.2, 5]) - rotation @ [40, -20, 10]
    rays = directions(points @ rotation.T + translation)
    return directions(rays + 3e-4 * rng.standard_normal(rays.shape)), points, rotation, translation


@pytest.mark.parametrize("unit", UNITS)
def test_the_scene_has_unit_size_in_any_unit(unit: float) -> None:
    rays, points, rotation, translation = scene()
    problem = Problem.of(rays, unit * points)
    np.testing.assert_allclose(problem.points3d.mean(0), 0, atol=1e-12)
    assert float((problem.points3d**2).sum(1).mean()) == pytest.approx(1)
    np.testing.assert_array_equal(problem.points3d, Problem.of(rays, points).points3d)
    # The same directions, before and after.
    turn, shift = problem.from_user(rotation, unit * translation)
    np.testing.assert_allclose(
        directions(problem.points3d @ turn.T + shift), directions(points @ rotation.T + translation), atol=1e-12
    )
    back = problem.to_user(turn, shift)
    np.testing.assert_allclose(back[1], unit * translation, rtol=1e-12)


def test_several_poses_are_converted_like_each_alone() -> None:
    rays, points, _, translation = scene()
    problem = Problem.of(rays, points)
    rotations, translations = (
        Rotation.random(4, random_state=0).as_matrix(),
        translation + np.arange(12.0).reshape(4, 3),
    )
    _, together = problem.to_user(*problem.from_user(rotations, translations))
    np.testing.assert_allclose(together, translations)
    for k in range(4):
        alone = problem.from_user(rotations[k], translations[k])[1]
        np.testing.assert_allclose(alone, problem.from_user(rotations, translations)[1][k])


def test_a_prior_is_divided_by_the_size_of_the_scene() -> None:
    rays, points, rotation, translation = scene()
    problem = Problem.of(rays, points, prior=PosePrior(rotation, translation, 3.0, 0.5))
    assert isinstance(problem.prior, PosePrior)
    assert problem.prior.translation_sigma == 0.5 / problem.size
    np.testing.assert_allclose(problem.prior.translation, problem.from_user(rotation, translation)[1])
    gravity = GravityPrior(np.array([0, -1.0, 0]), np.array([0, 0, 1.0]))
    assert Problem.of(rays, points, prior=gravity).prior == gravity


def test_a_prior_does_not_depend_on_the_origin_of_the_scene() -> None:
    rays, points, rotation, translation = scene()
    shift, priors = np.array([300.0, -1000.0, 50.0]), []
    for moved in (np.zeros(3), shift):
        prior = PosePrior(rotation, translation - rotation @ moved, 5.0, 0.3)
        known = Problem.of(rays, points + moved, prior=prior).prior
        assert isinstance(known, PosePrior)
        priors.append(np.r_[known.translation, known.translation_sigma, known.rotation_sigma_deg])
    np.testing.assert_allclose(priors[0], priors[1], rtol=1e-9)


@pytest.mark.parametrize("count", [12, 120], ids=["few", "many"])
def test_a_search_gives_the_same_digits_in_any_unit(count: int) -> None:
    rays, points, rotation, translation = scene(count)
    results = [search_poses(Problem.of(rays, unit * points)) for unit in UNITS]
    for result in results:
        assert result.verdict == "confident"
        np.testing.assert_array_equal(result.candidates.rotation, results[0].candidates.rotation)
        np.testing.assert_array_equal(result.candidates.translation, results[0].candidates.translation)
        assert result.log10_false_alarms == results[0].log10_false_alarms
    problem = Problem.of(rays, points)
    turn, shift = problem.to_user(*results[1].best)
    assert np.degrees(Rotation.from_matrix(turn.T @ rotation).magnitude()) < 0.5
    centroid = points.mean(0)
    assert np.linalg.norm(turn @ centroid + shift - rotation @ centroid - translation) < 0.05


def test_far_points_decide_neither_the_origin_nor_the_size() -> None:
    rays, points, *_ = scene()
    far = np.concatenate([points, [[1e7, 0, 0], [0, -1e6, 1e6]]])
    alone, local = Problem.of(rays, points), Problem.of(rays, far)
    assert (local.size, local.origin.tolist()) == (alone.size, alone.origin.tolist())


def test_points_in_one_place_have_a_size() -> None:
    rays, points, *_ = scene()
    problem = Problem.of(rays[:4], np.repeat(points[:1], 4, 0))
    assert problem.size == 1
    assert problem.degenerate == "only 1 different 3D point: 4 or more fix a pose"


def test_some_points_keep_their_annotations_and_indices() -> None:
    rays, points, *_ = scene()
    labels = np.arange(40)
    problem = Problem.of(rays, points, labels2d=labels, labels3d=labels, scores3d=np.linspace(0.1, 1, 40))
    some = problem.choose(np.array([3, 5, 8]), np.array([5, 6])).choose(np.array([0, 2]))
    assert some.labels2d is not None
    assert some.labels3d is not None
    assert (some.labels2d.tolist(), some.labels3d.tolist(), some.measured.indices.tolist()) == ([3, 8], [5, 6], [3, 8])
    np.testing.assert_array_equal(some.all3d, points[[5, 6]])
    left = problem.without(np.array([0, 1, 2]))
    assert (len(left.bearings), left.measured.taken, left.measured.dropped) == (37, 3, 0)
    np.testing.assert_array_equal(left.measured.indices, np.arange(3, 40))
    fewer = left.without(np.array([5, 7]))
    assert (len(fewer.bearings), fewer.measured.taken, fewer.measured.dropped) == (35, 5, 0)


def test_the_record_is_frozen() -> None:
    rays, points, *_ = scene()
    with pytest.raises(FrozenInstanceError):
        Problem.of(rays, points).size = 2.0  # type: ignore[misc]
