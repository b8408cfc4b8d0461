"""Poses that rest on one wrong match, beside the planted one."""

import numpy as np
from planted import degrees_between, directions
from scipy.spatial.transform import Rotation

from bpnp.search.enumeration.points import ImageSide, prior_arrays, scene_side
from bpnp.search.enumeration.poses import Enumeration
from bpnp.search.enumeration.settings import DEFAULT
from bpnp.search.point_sets import PointSets
from bpnp.solving.matches import fit_pose


def test_a_wrong_match_that_holds_the_pose_is_exchanged() -> None:
    """A far point and a decoy beside it, as near to the image point as the noise: seven others cannot tell at once."""
    wrong, mended = 0, 0
    for seed in range(30):
        rng = np.random.default_rng(seed)
        points = rng.uniform(-1, 1, (7, 3)) * [1, 1, 0.15]
        points[0, 2] = 0.8
        rotation = Rotation.from_rotvec(np.radians(20) * directions(rng.standard_normal(3))).as_matrix()
        translation = np.array([0, 0, 12.0])
        rays = directions(directions(points @ rotation.T + translation) + 3e-4 * rng.standard_normal((7, 3)))
        decoy = points[:1] + [*rng.uniform(-0.15, 0.15, 2), 0]
        sets = PointSets(rays, np.concatenate([points, decoy]))
        scene, image = scene_side(sets.points3d, None, None), ImageSide(rays, 6e-3, None, 2.0)
        run = Enumeration(scene, image, prior_arrays(sets, scene, image, DEFAULT), 3, 2.0, DEFAULT)
        taken = np.concatenate([decoy, points[1:]])
        held = fit_pose(
            lambda r, t, taken=taken: directions(taken @ r.T + t), rays, rotation, translation, scale=1e-3
        )  # fmt: skip
        run.refine(run.enter(*held), 1.0)
        if degrees_between(run.leave(run.best_pose[None])[0][0], rotation) > 2:
            wrong += 1
            run.vary_best()
            mended += degrees_between(run.leave(run.best_pose[None])[0][0], rotation) < 1.5
    assert wrong > 25
    assert mended > 0.8 * wrong
