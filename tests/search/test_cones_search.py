"""From where points are seen leads to poses among outliers that hide them from the annealing on clusters."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from planted import directions, view_with_outliers
from scipy.spatial.transform import Rotation

from bpnp.search.candidates import Candidates
from bpnp.search.point_sets import PointSets
from bpnp.search.pool import Pool
from bpnp.search.scene import Scene
from bpnp.search.search import search_poses
from bpnp.search.settings import DEFAULT, Schedule
from bpnp.search.sources.cones import best_shifts, drawn_in_cones, shifted, within_cones
from bpnp.search.sources.raster import raster_of
from bpnp.search.verdict import no_pose

Array = NDArray[np.float64]
CONE = np.cos(np.radians(35))


def seen_in_cones(seed: int, true: int, outliers: int) -> tuple[PointSets, Array, Array]:
    """Bearings and points of which `true` are pairs, all seen from within 35 degrees of a direction 20 degrees off."""
    rng = np.random.default_rng(seed)
    bearings, points, rotation, translation = view_with_outliers(rng, true, outliers)
    axes = Rotation.from_rotvec([0.35, 0, 0]).apply(directions(-rotation.T @ translation - points))
    sets = PointSets(bearings, points, axes, cosines3d=np.full(len(points), CONE))
    return sets, rotation, translation


def test_a_pose_among_six_outliers_a_true_pair_is_found_within_the_cones() -> None:
    """Without these starts the best pose of the search is 2 degrees off."""
    sets, rotation, translation = seen_in_cones(0, true=150, outliers=900)
    found = search_poses(sets, settings=replace(DEFAULT, schedule=Schedule(patience=0.01, turns=40)))
    np.testing.assert_allclose(found.best[0], rotation, atol=5e-3)
    np.testing.assert_allclose(found.best[1], translation, atol=0.05)


def test_starts_within_the_cones_that_end_at_a_pose_are_counted_once_each() -> None:
    """Copies of a start are no evidence of their own: no more hits than starts that were annealed."""
    sets, rotation, _ = seen_in_cones(0, true=300, outliers=100)
    pool = Pool(Scene(sets, 0, DEFAULT), sets, no_pose("no pose was found"))
    found = within_cones(pool.scene, DEFAULT.cones.searches[0])
    assert 1 <= found.hits.sum() <= DEFAULT.cones.searches[0].annealed
    pool.merge(found)
    np.testing.assert_allclose(pool.leaders().rotation[0], rotation, atol=5e-3)


def test_a_camera_that_looks_beside_the_scene_is_aimed_at_it() -> None:
    sets, rotation, translation = seen_in_cones(0, true=300, outliers=100)
    scene = Scene(sets, 0, DEFAULT)
    turn, moved = scene.enter(rotation, translation)
    beside = Rotation.from_rotvec([0.11, -0.17, 0]).as_matrix().astype(np.float32)
    aside = Candidates.unscored((beside @ turn)[None], (beside @ moved)[None])
    scale = 0.06
    raster = raster_of(scene, replace(DEFAULT.near.raster, cells=1.0), scale)
    _, shift = best_shifts(aside, raster, scene.sides()[1])
    aimed = shifted(aside, shift)
    off = Rotation.from_matrix(aimed.rotation[0] @ turn.T).magnitude()
    assert off < 1.5 * scale * scene.spread + 0.11 * 0.17
    assert shifted(aimed, -shift).rotation[0] == pytest.approx(aside.rotation[0], abs=1e-2)


def test_the_best_shift_is_that_of_the_largest_sum_of_the_raster_over_all() -> None:
    bearings, points, *pose = view_with_outliers(np.random.default_rng(2), 100, 100)
    scene = Scene(PointSets(bearings, points), 0, DEFAULT)
    raster = raster_of(scene, replace(DEFAULT.near.raster, cells=1.0), 0.1)
    turn, moved = scene.enter(*pose)
    beside = Rotation.from_euler("xyz", [[0, 0, 0], [0.1, -0.1, 0], [0.3, 0, 1]]).as_matrix().astype(np.float32)
    scores, shifts = best_shifts(Candidates.unscored(beside @ turn, beside @ moved), raster, scene.sides()[1])
    padded = np.pad(raster.values, 100)
    for score, shift, turned in zip(scores, shifts, beside, strict=True):
        u = directions((scene.points3d @ turn.T + moved) @ turned.T)
        at = np.floor((2 * u[:, :2] / (1 + u[:, 2:]) + raster.half) * raster.per_cell).astype(int) + 100
        steps = np.arange(-len(raster.values) // 2, len(raster.values) // 2)
        sums = {(c, r): padded[at[:, 1] + r, at[:, 0] + c].sum() for c in steps for r in steps}
        assert score == pytest.approx(max(sums.values()), abs=1e-3)
        assert score == pytest.approx(sums[tuple(np.rint(shift * raster.per_cell))], abs=1e-3)


def test_starts_see_a_point_within_its_cone_and_the_middle_in_front() -> None:
    sets, *_ = seen_in_cones(1, true=60, outliers=60)
    scene = Scene(sets, 0, DEFAULT)
    starts = drawn_in_cones(scene, 500)
    np.testing.assert_allclose(
        starts.rotation @ starts.rotation.transpose(0, 2, 1), np.tile(np.eye(3), (500, 1, 1)), atol=1e-5
    )
    np.testing.assert_allclose(np.linalg.det(starts.rotation), 1, atol=1e-5)
    middle = starts.rotation @ scene.bulk3d.mean(0) + starts.translation
    np.testing.assert_allclose(middle[:, :2], 0, atol=1e-4)
    assert (middle[:, 2] > 0).all()
    centre = -np.einsum("sij,si->sj", starts.rotation, starts.translation)
    towards = centre[:, None] - scene.points3d
    towards /= np.linalg.norm(towards, axis=-1, keepdims=True)
    within = (towards * scene.seen.cones[:, :3]).sum(-1) > scene.seen.cones[:, 3] - 1e-4
    assert within.any(1).all()
    roll = np.arctan2(starts.rotation[:, 0, 1], starts.rotation[:, 0, 0])
    assert np.histogram(roll, 6, (-np.pi, np.pi))[0].min() > 30
