"""Residuals and scores against OpenCV's projection; the refinement against scipy's optimum."""

import cv2
import numpy as np
import torch
from planted import plant
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from bpnp.robust.consensus import Matches, in_scene, normalised, refine_locally, residuals, truncated_scores


def problem(noise: float = 0.002) -> tuple[Matches, torch.Tensor]:
    """Two samples of 40 pairs, ten of them wrong and the last five padding, and five poses near the planted ones."""
    planted = plant(2, 40, noise=noise, seed=2)
    points2d = planted.points2d.gather(1, planted.match3d.unsqueeze(-1).expand(-1, -1, 2)).clone()
    points2d[:, :10] = points2d[:, :10].roll(1, 1)
    real = (torch.arange(40) < 35).expand(2, 40)
    poses = []
    for seed in range(5):
        rotation, translation = planted.near(0.003 * seed, seed=seed)
        poses.append(torch.cat([rotation, translation.unsqueeze(-1)], -1))
    return Matches(points2d, planted.points3d, real), torch.stack(poses, 1)


def by_opencv(pairs: Matches, pose: torch.Tensor, i: int) -> np.ndarray:
    vector = cv2.Rodrigues(pose[:, :3].numpy())[0]
    seen = cv2.projectPoints(pairs.points3d[i].numpy(), vector, pose[:, 3].numpy(), np.eye(3), None)[0][:, 0]
    return np.linalg.norm(seen - pairs.points2d[i].numpy(), axis=-1)


def test_residuals_and_scores_are_those_of_opencvs_projection() -> None:
    pairs, poses = problem()
    threshold2 = 0.01**2
    found, scores = residuals(poses, pairs, threshold2), truncated_scores(poses, pairs, threshold2)
    for i in range(2):
        for k in range(5):
            expected = by_opencv(pairs, poses[i, k], i)
            np.testing.assert_allclose(found.squared[i, k].sqrt(), expected, rtol=1e-6, atol=1e-9)
            np.testing.assert_array_equal(found.inlier[i, k], (expected < 0.01) & pairs.real[i].numpy())
            total = np.minimum(expected[:35] ** 2, threshold2).sum()
            np.testing.assert_allclose(scores[i, k], total, rtol=1e-4)


def test_a_point_behind_the_camera_is_an_outlier_and_no_pose_has_no_score() -> None:
    pairs, poses = problem()
    behind = poses.clone()
    behind[..., 2, :] *= -1
    behind[..., :2, :] *= -1  # the same image through the back of the camera
    assert not residuals(behind, pairs, 1.0).inlier.any()
    torch.testing.assert_close(truncated_scores(behind, pairs, 1e-4), torch.full((2, 5), 35e-4))
    assert truncated_scores(torch.full_like(poses, torch.nan), pairs, 1e-4).isnan().all()


def test_a_pose_on_normalised_pairs_is_the_same_camera_in_the_scene() -> None:
    pairs, poses = problem()
    far = pairs._replace(points3d=30 * pairs.points3d + 1e5)
    near, centre, scale = normalised(far)
    real = near.points3d[:, :35]
    torch.testing.assert_close(real.mean(1), torch.zeros(2, 3).double(), atol=1e-9, rtol=0)
    torch.testing.assert_close(real.square().sum((1, 2)) / 35, torch.ones(2).double())
    rotation, translation = in_scene(poses, centre, scale)
    there = residuals(torch.cat([rotation, translation.unsqueeze(-1)], -1), far, 1.0).squared
    torch.testing.assert_close(there[..., :35], residuals(poses, near, 1.0).squared[..., :35], rtol=1e-5, atol=1e-9)


def test_the_refinement_ends_at_the_optimum_of_the_inliers() -> None:
    pairs, poses = problem()
    refined = refine_locally(poses, pairs, 0.01**2, 10)
    before, after = (truncated_scores(p, pairs, 0.01**2) for p in (poses, refined))
    assert (after <= before).all()
    for i in range(2):
        inlier = residuals(refined, pairs, 0.01**2).inlier[i, 0].numpy()
        start = refined[i, 0].numpy()

        def error(step: np.ndarray, i: int = i, inlier: np.ndarray = inlier, start: np.ndarray = start) -> np.ndarray:
            rotation = Rotation.from_rotvec(step[:3]).as_matrix() @ start[:, :3]
            camera = pairs.points3d[i].numpy()[inlier] @ rotation.T + start[:, 3] + step[3:]
            return (camera[:, :2] / camera[:, 2:] - pairs.points2d[i].numpy()[inlier]).ravel()

        optimum = least_squares(error, np.zeros(6), xtol=1e-15, ftol=1e-15, gtol=1e-15).x
        np.testing.assert_allclose(optimum, 0, atol=1e-6)
