"""Poses drawn from an assignment: frequencies of the draws, planted poses among wrong matches, padding and scores."""

import math

import numpy as np
import pytest
import torch
from planted import Planted, plant
from torch import Tensor

from bpnp.geometry import bearings, retract, rotation_angle, transform
from bpnp.layers.ransac.matches import Matches, distinct_triples, truncated_scores, weighted_draws
from bpnp.layers.ransac.minimal_solvers import p3p
from bpnp.layers.ransac.proposals import drawn_poses, pose_hypotheses


def test_draws_are_in_proportion_to_the_weights() -> None:
    """The frequencies are within four standard deviations of a binomial distribution, and exact for weight zero."""
    weights = torch.tensor([[0.0, 1, 2, 5, 0], [3, 0, 0, 0, 1]])
    drawn = weighted_draws(weights, 20_000, 1)
    found = torch.stack([row.bincount(minlength=5) for row in drawn]) / 20_000
    expected = weights / weights.sum(-1, keepdim=True)
    assert ((found - expected).abs() <= 4 * (expected * (1 - expected) / 20_000).sqrt()).all()
    assert not torch.equal(drawn, weighted_draws(weights, 20_000, 2))


def half_true(seed: int = 0) -> tuple[Tensor, ...]:
    """An assignment with half of its mass on the true matches, the points, and the true pose."""
    planted = plant(1, 24, outliers2d=3, outliers3d=5, seed=seed)
    true = planted.permutation()
    return 0.5 * true + 0.5 / true[0].numel(), planted.points2d, planted.points3d, *planted.pose


def masks(points2d: Tensor, points3d: Tensor) -> tuple[Tensor, Tensor]:
    return torch.ones(points2d.shape[:2]) > 0, torch.ones(points3d.shape[:2]) > 0


@pytest.mark.parametrize("far", [0.0, 1e6])
def test_the_best_hypothesis_is_the_planted_pose_and_the_others_are_apart(far: float) -> None:
    """Scores are in float32, which has no digits for a scene of unit size that is a million units away."""
    assignment, points2d, points3d, rotation, translation = half_true()
    points = points2d, points3d + far
    r, t = pose_hypotheses(assignment, *points, *masks(*points), count=9)
    assert r.shape == (1, 9, 3, 3)
    assert torch.rad2deg(rotation_angle(r[:, 0], rotation)) < 0.01
    found = transform(r[:, 0], t[:, 0], points[1])
    assert (found - transform(rotation, translation, points3d)).norm(dim=-1).max() < 1e-3
    apart = torch.stack([rotation_angle(r[0], one.expand_as(r[0])) for one in r[0]])
    assert torch.rad2deg(apart[~torch.eye(9, dtype=torch.bool)]).min() > 14.9


def test_hypotheses_depend_neither_on_padding_nor_on_samples_without_a_pose() -> None:
    """Padded entries have most of the mass. The others have no mass, NaN, two points on a side, and infinity."""
    assignment, *points, _, _ = half_true()
    expected = pose_hypotheses(assignment, *points, *masks(*points), count=5)
    pad = torch.nn.functional.pad
    wide = pad(assignment, (0, 4, 0, 2), value=1.0).repeat(5, 1, 1)
    padded = [pad(x, (0, 0, 0, more), value=9.0).repeat(5, 1, 1) for x, more in zip(points, (2, 4), strict=True)]
    mask2d, mask3d = masks(*padded)
    mask2d[:, -2:], mask3d[:, -4:] = False, False
    wide[1] = 0
    wide[2, 0, 0] = torch.nan
    mask3d[3, 2:] = False
    wide[4, 0, 0] = torch.inf
    r, t = pose_hypotheses(wide, *padded, mask2d, mask3d, count=5)
    for found, alone in zip((r, t), expected, strict=True):
        torch.testing.assert_close(found[:1], alone, rtol=0, atol=1e-9)
        assert found[1:].isnan().all()


def test_drawn_poses_have_the_planted_one_in_any_unit_and_origin() -> None:
    assignment, points2d, points3d, rotation, _ = half_true(seed=1)
    for scene in (points3d, 250 * points3d + 1e4):
        poses = drawn_poses(assignment, points2d, scene, triples=256, seed=0)
        assert poses.shape == (1, 2 * 256 // 4 + 2, 3, 4)
        angle = rotation_angle(poses[..., :3], rotation.unsqueeze(1).expand_as(poses[..., :3]))
        best = poses[0, angle.nan_to_num(nan=math.inf).argmin(1)[0]]
        camera = scene[0] @ best[:, :3].mT + best[:, 3]
        near = torch.cdist(camera[:, :2] / camera[:, 2:], points2d[0]).amin(1)
        assert near[:24].max() < 1e-5
    again, other = (drawn_poses(assignment, points2d, scene, triples=256, seed=seed) for seed in (0, 1))
    assert torch.equal(again.nan_to_num(), poses.nan_to_num())
    assert not torch.equal(other.nan_to_num(), poses.nan_to_num())


def in_camera_axes(noise: float) -> tuple[Planted, Tensor, Tensor]:
    """A planted problem, its scene almost in the axes of the camera, and the rotation of this scene."""
    planted = plant(1, 30, noise=noise, seed=2)
    step = torch.tensor([[0.05, -0.05, 0.05, 0, 0, 0]], dtype=torch.float64)
    rotation, translation = retract(step, torch.eye(3, dtype=torch.float64)[None], torch.zeros(1, 3).double())
    return planted, transform(rotation.mT, translation, transform(*planted.pose, planted.points3d)), rotation


def fraction_near(poses: Tensor, rotation: Tensor) -> float:
    """Fraction of the poses that are within 0.02 radians of a rotation."""
    angle = rotation_angle(poses[..., :3], rotation.unsqueeze(1).expand_as(poses[..., :3]))
    return int((angle < 0.02).sum()) / int(angle.isfinite().sum())


def test_aligned_triples_are_oftener_true() -> None:
    """A tenth of the mass is on true matches."""
    planted, scene, rotation = in_camera_axes(0.0)
    assignment, near = 0.1 * planted.permutation() + 0.9 / 900, []
    for aligned in (False, True):
        poses = drawn_poses(assignment, planted.points2d, scene, triples=2048, seed=0, aligned=aligned)
        assert poses.shape[1] == 2 * 2048 // (8 if aligned else 4) + 2
        near.append(fraction_near(poses, rotation))
    assert near[1] > 3 * near[0]


def test_the_triangles_that_are_solved_are_wide() -> None:
    """Their poses are nearer to the planted one than those of all triples, with noise and true matches only."""
    planted, scene, rotation = in_camera_axes(0.003)
    poses = drawn_poses(planted.permutation(), planted.points2d, scene, triples=1024, seed=0)
    triples = distinct_triples(torch.full((1, 1024), 30.0), 0)[0]
    rays = bearings(planted.points2d[0, planted.match3d[0]])
    solved = p3p(rays[triples], scene[0, triples])
    every = torch.cat([solved.rotation, solved.translation[..., None]], -1).flatten(0, 1)[None]
    assert fraction_near(poses, rotation) > fraction_near(every, rotation)


@pytest.mark.parametrize("threshold", [0.02, 0.3])
def test_scores_are_truncated_squared_errors_of_the_real_matches(threshold: float) -> None:
    """The sum by numpy; every fourth point is behind the camera, in line with its match. A pose of NaN has no score."""
    planted = plant(1, 40, noise=0.02, seed=3)
    rotation, translation = planted.pose
    camera = transform(rotation, translation, planted.points3d)
    camera[:, ::4] *= -1
    image, scene = planted.points2d[:, planted.match3d[0]], (camera - translation[:, None]) @ rotation
    poses = torch.stack([torch.cat([rotation, t[..., None]], -1) for t in (translation, translation + 0.1)], 1)
    poses = torch.cat([poses, torch.full((1, 1, 3, 4), torch.nan, dtype=torch.float64)], 1)
    real = torch.arange(40) % 3 > 0
    expected = []
    for pose in poses[0].numpy():
        camera = scene[0].numpy() @ pose[:, :3].T + pose[:, 3]
        squared = ((camera[:, :2] / camera[:, 2:] - image[0].numpy()) ** 2).sum(-1)
        squared[camera[:, 2] < 0] = np.inf
        expected.append(np.minimum(squared, threshold**2)[real].sum())
    found = truncated_scores(poses, Matches(image, scene, real[None]), threshold**2)[0]
    np.testing.assert_allclose(found[:2], expected[:2], rtol=1e-4)
    assert found[2].isnan()
