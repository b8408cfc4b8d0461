"""The poses of a search: a better pose takes the place of one beside it."""

from dataclasses import replace

import numpy as np
from planted import plant
from scipy.spatial.transform import Rotation

from bpnp.search.candidates import Candidates
from bpnp.search.point_sets import PointSets
from bpnp.search.pool import Pool
from bpnp.search.scene import Scene
from bpnp.search.settings import DEFAULT
from bpnp.search.verdict import no_pose


def test_a_better_pose_takes_the_place_of_one_beside_it_that_exceeds_chance():
    """200 true pairs; a pose 2 degrees off, at residuals as large, exceeds chance by far; the planted one by more."""
    planted = plant(1, 200, seed=5, noise=1e-3, outliers2d=20, outliers3d=20)
    sets = PointSets(planted.bearings[0].double().numpy(), planted.points3d[0].double().numpy())
    truth, translation = planted.rotation[0].double().numpy(), planted.translation[0].double().numpy()
    wrong = Rotation.from_rotvec([np.radians(2), 0, 0]).as_matrix() @ truth
    scene = Scene(sets, 0, DEFAULT)
    pool = Pool(scene, sets, no_pose("none yet"))

    def found(rotation, scale, score):
        moved = translation + (truth - rotation) @ sets.points3d.mean(0)
        pose = Candidates.unscored(*scene.enter(rotation[None], moved[None]), hits=1)
        return replace(pose, scale=np.full(1, scale, np.float32), score=np.full(1, score, np.float32))

    pool.merge(found(wrong, 0.02, 4.0))
    assert pool.leaders().log10_false_alarms[0] < 0
    pool.merge(found(truth, 1e-3, 5.0))
    turned, _ = scene.leave(pool.candidates.rotation, pool.candidates.translation)
    assert len(turned) == 1  # closer than `same_deg`
    np.testing.assert_allclose(turned[0], truth, atol=1e-5)
