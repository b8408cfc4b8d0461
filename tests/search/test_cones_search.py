"""From where points are seen leads to poses among outliers that hide them from the annealing on clusters."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from planted import directions, view_with_outliers
from scipy.spatial.transform import Rotation

from bpnp.search.point_sets import PointSets
from bpnp.search.search import search_poses
from bpnp.search.settings import DEFAULT, Schedule

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
