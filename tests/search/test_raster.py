"""Starts around a rough pose find a planted one among more outliers than annealing on clusters can stand."""

import math
import time
import weakref

import numpy as np
import pytest
from numpy.typing import NDArray
from planted import degrees_between, directions, view_with_outliers
from scipy.spatial.transform import Rotation

from bpnp.loops.parallel import Deadline
from bpnp.search.candidates import Candidates
from bpnp.search.kernels.raster import add_up
from bpnp.search.point_sets import PointSets
from bpnp.search.scene import Scene
from bpnp.search.search import search_poses
from bpnp.search.settings import DEFAULT
from bpnp.search.sources.multistart import cooled
from bpnp.search.sources.raster import admitted, drawn_around, raster_of, search_near
from bpnp.search.starts import PosePrior

Array = NDArray[np.float64]


def cluttered(seed: int, true: int = 80, outliers: int = 220, **view: float) -> tuple[Array, Array, Array, Array]:
    """Bearings and points in random order and their pose, with outliers that fill the frame of both."""
    rng = np.random.default_rng(seed)
    bearings, points, rotation, translation = view_with_outliers(rng, true, outliers, **view)
    image, scene = rng.permutation(len(bearings)), rng.permutation(len(points))
    return bearings[image], points[scene], rotation, translation


def off(rotation: Array, translation: Array, points: Array, rng: np.random.Generator) -> PosePrior:
    """A prior 4 degrees off, and 4 % of the distance, of that size."""
    axis, shift = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
    turned = Rotation.from_rotvec(np.radians(4) * axis).as_matrix() @ rotation
    middle = points.mean(0)
    moved = rotation @ middle + translation + 0.04 * 5 * shift - turned @ middle
    return PosePrior(turned, moved, 4.0, 0.2)


@pytest.mark.parametrize("seed", range(3))
def test_a_rough_prior_pays_among_three_outliers_a_true_pair(seed: int) -> None:
    bearings, points, rotation, translation = cluttered(seed)
    prior = off(rotation, translation, points, np.random.default_rng(seed))
    found = search_poses(PointSets(bearings, points, prior=prior))
    assert degrees_between(found.best[0], rotation) < 0.3
    np.testing.assert_allclose(found.best[1], translation, atol=0.05)


@pytest.mark.parametrize("seed", range(2))
def test_a_rough_prior_is_certain_among_seven_outliers_a_true_pair(seed: int) -> None:
    """Likelier poses that chance explains come up in every batch annealed around the prior."""
    bearings, points, rotation, translation = cluttered(seed, outliers=600)
    found = search_poses(
        PointSets(bearings, points, prior=off(rotation, translation, points, np.random.default_rng(seed)))
    )
    assert found.verdict == "confident"
    assert degrees_between(found.best[0], rotation) < 0.3


def test_noise_beyond_the_enumeration_leaves_no_doubt_near_a_prior() -> None:
    """A rotation known to 4 degrees lets 200 x 200 points be enumerated, with a radius narrower than this noise."""
    bearings, points, rotation, translation = cluttered(1, true=200, outliers=0, noise=0.01, frame=0.9)
    prior = off(rotation, translation, points, np.random.default_rng(1))
    found = search_poses(PointSets(bearings, points, prior=prior))
    assert found.verdict == "confident"
    assert degrees_between(found.best[0], rotation) < 0.5


@pytest.mark.parametrize(
    ("translation_sigma", "degrees"), [(0.3, 6.0), (30.0, 120.0), (math.inf, 6.0)],
    ids=["wrong", "uninformative", "wrong rotation alone"],
)  # fmt: skip
def test_a_prior_that_does_not_help_hides_no_pose_that_is_found_without(
    translation_sigma: float, degrees: float
) -> None:
    bearings, points, rotation, translation = cluttered(0, outliers=80)
    assert search_poses(PointSets(bearings, points)).verdict == "confident"
    wrong = Rotation.from_rotvec([0, 2, 0]).as_matrix() @ rotation
    where = None if math.isinf(translation_sigma) else translation
    found = search_poses(PointSets(bearings, points, prior=PosePrior(wrong, where, degrees, translation_sigma)))
    assert found.verdict == "confident"
    assert degrees_between(found.best[0], rotation) < 0.3


def test_what_only_looks_around_poses_from_anywhere_find_is_found_with_a_wrong_prior_too() -> None:
    """Poses near the wrong one are likelier than any beside the right one."""
    bearings, points, rotation, translation = cluttered(2, outliers=300)
    wrong = Rotation.from_rotvec([0, 2, 0]).as_matrix() @ rotation
    found = search_poses(PointSets(bearings, points, prior=PosePrior(wrong, translation, 6.0, 0.3)))
    assert degrees_between(found.best[0], rotation) < 0.3


def test_a_raster_is_computed_once_and_ends_with_its_scene() -> None:
    bearings, points, *_ = cluttered(0)
    scene = Scene(PointSets(bearings, points), 0, DEFAULT)
    assert raster_of(scene, DEFAULT.near.raster, 0.04) is raster_of(scene, DEFAULT.near.raster, 0.04)
    kept = weakref.ref(scene)
    del scene
    assert kept() is None


def test_points_that_fall_by_chance_add_nothing_in_the_mean() -> None:
    bearings, points, rotation, translation = cluttered(0, outliers=1500)
    scene = Scene(PointSets(bearings, points), 0, DEFAULT)
    raster = raster_of(scene, DEFAULT.near.raster, 0.04)
    inside = raster.values != 0
    assert abs(raster.values[inside].mean()) < 0.1 * raster.values[inside].std()
    right = scene.enter(rotation, translation)
    camera = scene.points3d @ right[0].T + right[1]
    u = directions(camera)
    at = ((2 * u[:, :2] / (1 + u[:, 2:]) + raster.half) * raster.per_cell).astype(int)
    expected = raster.values[at[:, 1], at[:, 0]].sum()

    poses = drawn_around(scene, PosePrior(*right, 0.0, 0.0), 2)
    score, weight = np.empty(2, np.float32), np.empty(len(points), np.float32)
    cell = np.empty(len(points), np.int32)
    add_up(*raster, tuple(scene.sides()[1]), poses.rotation, poses.translation, score, weight, cell)
    np.testing.assert_allclose(score, expected, rtol=2e-2)


def test_starts_have_the_spread_of_the_prior_and_the_first_is_its_mean() -> None:
    bearings, points, rotation, translation = cluttered(1)
    scene = Scene(PointSets(bearings, points), 0, DEFAULT)
    prior = scene.enter_prior(PosePrior(rotation, translation, 5.0, 0.3))
    assert isinstance(prior, PosePrior)
    starts = drawn_around(scene, prior, 4000)
    np.testing.assert_allclose(starts.rotation[0], prior.rotation, atol=1e-6)
    np.testing.assert_allclose(starts.translation[0], prior.translation, atol=1e-5)
    vectors = Rotation.from_matrix(starts.rotation @ np.asarray(prior.rotation).T).as_rotvec()
    np.testing.assert_allclose(np.degrees(vectors[1:].std(0)), 5.0, rtol=0.05)
    middle = scene.bulk3d.mean(0)
    shift = starts.rotation @ middle + starts.translation
    np.testing.assert_allclose(shift[1:].std(0) * scene.size, 0.3, rtol=0.05)


def test_the_first_scale_follows_the_width_of_the_prior() -> None:
    bearings, points, rotation, translation = cluttered(2)
    scene = Scene(PointSets(bearings, points), 0, DEFAULT)

    def scales(degrees: float, shift: float) -> list[float]:
        prior = scene.enter_prior(PosePrior(rotation, translation, degrees, shift))
        assert isinstance(prior, PosePrior)
        return [
            scale for stage in cooled(DEFAULT.coarse, prior, scene) for scale in (stage.first_scale, stage.last_scale)
        ]

    hot, end = DEFAULT.coarse[0].first_scale, DEFAULT.coarse[-1].last_scale
    assert scales(1.0, 0.05) == pytest.approx([end] * len(scales(1.0, 0.05)))
    assert end < scales(4.0, 0.2)[0] < scales(8.0, 0.3)[0] < hot
    for width in ((4.0, 0.2), (8.0, 0.3), (90.0, 5.0)):
        assert scales(*width) == sorted(scales(*width), reverse=True)
    assert scales(90.0, 5.0)[0] == hot


def test_a_deadline_that_has_passed_still_gives_poses_and_stops_early() -> None:
    bearings, points, rotation, translation = cluttered(0)
    scene = Scene(PointSets(bearings, points), 0, DEFAULT)
    prior = scene.enter_prior(PosePrior(rotation, translation, 4.0, 0.2))
    assert isinstance(prior, PosePrior)
    search_near(scene, prior)  # compiles
    seconds = []
    for scene.deadline in (Deadline.after(0.0), Deadline()):
        start = time.process_time()
        assert len(search_near(scene, prior)) >= 1
        seconds.append(time.process_time() - start)
    assert seconds[0] < 0.7 * seconds[1]


def test_a_lost_search_looks_around_its_best_poses() -> None:
    """Among five outliers a match the right pose is no optimum on clusters, but some degrees beside one."""
    bearings, points, rotation, translation = cluttered(1, outliers=400)
    lost = search_poses(PointSets(bearings, points), settings=DEFAULT.limited(8))  # batches of starts
    assert lost.verdict == "failed"
    found = search_poses(PointSets(bearings, points))
    assert degrees_between(found.best[0], rotation) < 0.3
    np.testing.assert_allclose(found.best[1], translation, atol=0.05)


@pytest.mark.parametrize("placed", [True, False])
def test_a_prior_admits_nearly_all_poses_that_are_drawn_from_it_and_none_far_beyond(placed: bool) -> None:
    """Of 6 normal errors 94 % are within 3.5 standard deviations together, of 3 alone 99 %."""
    bearings, points, rotation, translation = cluttered(0)
    prior = PosePrior(rotation, translation if placed else None, 5.0, 0.3 if placed else math.inf)
    scene = Scene(PointSets(bearings, points), 0, DEFAULT)
    drawn = drawn_around(scene, scene.enter_prior(PosePrior(rotation, translation, 5.0, 0.3)), 4000)
    assert len(admitted(scene, drawn, prior)) / 4000 == pytest.approx(0.944 if placed else 0.994, abs=0.01)
    assert len(admitted(scene, drawn, None)) == 4000
    far = Rotation.from_rotvec([0, np.radians(20), 0]).as_matrix() @ rotation, translation
    near_by = rotation, translation + [0, 0, 1.2]
    poses = Candidates.unscored(*scene.enter(*(np.stack(pair) for pair in zip(far, near_by, strict=True))))
    np.testing.assert_array_equal(admitted(scene, poses, prior).rotation, poses.rotation[[] if placed else [1]])
