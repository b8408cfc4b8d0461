"""The estimate after Levenberg-Marquardt: another library's optimum on the same pairs, and samples without one."""

import math

import numpy as np
import torch
from planted import padded, plant, posed
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from bpnp import Prediction
from bpnp.arrays import Array
from bpnp.models import LeastSquares

DEGREE = math.radians(1)


def angles(points2d: Array, camera: Array) -> Array:
    """Angle of every image point and every point in the camera's frame, by arccos."""
    rays = np.column_stack([points2d, np.ones(len(points2d))])
    rays, ways = (x / np.linalg.norm(x, axis=1, keepdims=True) for x in (rays, camera))
    return np.arccos(np.clip(rays @ ways.T, -1, 1))


def test_the_refined_pose_is_scipys_optimum_over_all_pairs_within_a_degree() -> None:
    planted = plant(2, 40, noise=0.002, outliers2d=5, outliers3d=7, seed=2)
    start = planted.near(0.004)
    prediction = LeastSquares()(Prediction(poses={"ransac": posed(*start)}), planted.batch())
    refined = prediction.poses["refined"]
    assert list(prediction.poses) == ["ransac", "refined"]
    for k in range(2):
        x, p, r, t = (v[k].numpy() for v in (planted.points2d, planted.points3d, *start))
        i, j = (angles(x, p @ r.T + t) <= DEGREE).nonzero()
        assert len(i) > 40  # points of the other side that happen to be near are pairs too

        def residuals(pose: Array, x: Array = x[i], p: Array = p[j]) -> Array:
            camera = Rotation.from_rotvec(pose[:3]).apply(p) + pose[3:]
            return (camera[:, :2] / camera[:, 2:] - x).ravel()

        best = least_squares(residuals, [*Rotation.from_matrix(r).as_rotvec(), *t], xtol=1e-12, ftol=1e-12).x
        np.testing.assert_allclose(refined.rotation[k], Rotation.from_rotvec(best[:3]).as_matrix(), atol=1e-4)
        np.testing.assert_allclose(refined.translation[k], best[3:], atol=1e-3)


def test_without_noise_it_is_the_planted_pose_and_padding_is_no_pair() -> None:
    scenes = [plant(1, 30, seed=3), plant(1, 12, seed=4)]
    batch = padded(scenes)
    starts = [scene.near(0.003) for scene in scenes]
    rotation, translation = (torch.cat(parts) for parts in zip(*starts, strict=True))
    # Padded scene points are at the origin; a padded image point is where they would be seen.
    batch.points2d[1, 12:] = translation[1, :2] / translation[1, 2]
    refined = LeastSquares(angle=0.008)(Prediction(poses={"ransac": posed(rotation, translation)}), batch)
    pose = refined.poses["refined"]
    alone = LeastSquares(angle=0.008)(Prediction(poses={"ransac": posed(*starts[1])}), scenes[1].batch())
    torch.testing.assert_close(pose.rotation[1:], alone.poses["refined"].rotation)
    assert pose.stats.converged.all()


def test_a_sample_without_a_pose_or_four_pairs_has_no_refined_pose() -> None:
    planted = plant(3, 10, seed=5)
    rotation, translation = (values.clone() for values in planted.pose)
    rotation[0], translation[0] = torch.nan, torch.nan
    translation[1, 0] += 50
    prediction = LeastSquares()(Prediction(poses={"ransac": posed(rotation, translation)}), planted.batch())
    pose = prediction.poses["refined"]
    assert pose.stats.converged.tolist() == [False, False, True]
    assert pose.found.tolist() == [False, False, True]
    torch.testing.assert_close(pose.rotation[2], planted.rotation[2], atol=1e-5, rtol=0)
