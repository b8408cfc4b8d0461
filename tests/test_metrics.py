import math

import numpy as np
import pytest
import torch
from planted import plant, posed
from scipy.spatial.transform import Rotation
from torch import Tensor

from bpnp.metrics import (
    PoseErrors,
    RecallThresholds,
    centre_error,
    pose_errors,
    pose_quartiles,
    pose_recalls,
    reprojection_error,
    rotation_error,
)
from bpnp.types import Batch, Pose


def random_rotations(seed: int, size: int) -> Tensor:
    return torch.from_numpy(Rotation.random(size, rng=np.random.default_rng(seed)).as_matrix())


def planted_batch(seed: int, size: int) -> Batch:
    """Exact pairs of twelve points."""
    return plant(size, 12, seed=seed).batch()


def true_pose(batch: Batch) -> Pose:
    assert batch.rotation is not None
    assert batch.translation is not None
    return posed(batch.rotation.clone(), batch.translation.clone())


@pytest.mark.parametrize("scale", [1e-9, 1e-6, 1e-2, 1.0, math.pi - 1e-6, math.pi])
def test_rotation_error_is_the_angle_scipy_planted(scale: float) -> None:
    axes = np.random.default_rng(0).normal(size=(20, 3))
    planted = Rotation.from_rotvec(scale * axes / np.linalg.norm(axes, axis=1, keepdims=True))
    rotation = random_rotations(1, 20)
    error = rotation_error(rotation @ torch.from_numpy(planted.as_matrix()), rotation)
    torch.testing.assert_close(
        torch.deg2rad(error), torch.from_numpy(planted.magnitude()), rtol=1e-6, atol=3e-8 * scale
    )


def test_rotation_and_centre_errors_do_not_change_when_the_scene_moves() -> None:
    rotation, rotation_gt, motion = (random_rotations(seed, 10) for seed in range(3))
    translation, translation_gt, shift = torch.randn(3, 10, 3, dtype=torch.float64)

    def moved(r: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
        """Return the pose of the same camera after the scene is moved by p -> motion p + shift."""
        r = r @ motion.mT
        return r, t - (r @ shift.unsqueeze(-1)).squeeze(-1)

    rotation_2, translation_2 = moved(rotation, translation)
    rotation_gt_2, translation_gt_2 = moved(rotation_gt, translation_gt)
    torch.testing.assert_close(rotation_error(rotation_2, rotation_gt_2), rotation_error(rotation, rotation_gt))
    torch.testing.assert_close(
        centre_error(rotation_2, translation_2, rotation_gt_2, translation_gt_2),
        centre_error(rotation, translation, rotation_gt, translation_gt),
    )


def test_reprojection_error_is_the_mean_angle_over_matches_and_ignores_padding() -> None:
    batch = planted_batch(1, 3)
    rotation, translation = random_rotations(5, 3), torch.randn(3, 3, dtype=torch.float64)
    match3d = batch.match3d
    assert match3d is not None
    match3d = match3d.clone()
    match3d[0, 4:] = -1
    expected = []
    for i in range(3):
        angles = []
        for j in range(12):
            if match3d[i, j] >= 0:
                ray = np.append(batch.points2d[i, match3d[i, j]].numpy(), 1)
                point = rotation[i].numpy() @ batch.points3d[i, j].numpy() + translation[i].numpy()
                angles.append(np.degrees(np.arccos(ray @ point / np.linalg.norm(ray) / np.linalg.norm(point))))
        expected.append(np.mean(angles))
    error = reprojection_error(rotation, translation, batch.points2d, batch.points3d, match3d)
    np.testing.assert_allclose(error, expected, rtol=1e-9)

    padded3d = torch.cat([batch.points3d, torch.full((3, 2, 3), 7.0, dtype=torch.float64)], 1)
    padded_match = torch.cat([match3d, torch.full((3, 2), -1)], 1)
    again = reprojection_error(rotation, translation, batch.points2d, padded3d, padded_match)
    torch.testing.assert_close(again, error, rtol=0, atol=0)


def test_a_point_at_the_camera_centre_is_not_scored_as_perfect() -> None:
    pose = (torch.eye(3)[None], torch.zeros(1, 3))
    error = reprojection_error(*pose, torch.zeros(1, 1, 2), torch.zeros(1, 1, 3), torch.zeros(1, 1, dtype=torch.long))
    assert error.item() == 180


@pytest.mark.parametrize(
    ("broken", "value"), [("rotation", math.nan), ("translation", math.nan), ("translation", math.inf)]
)
def test_a_pair_without_a_pose_counts_as_the_worst(broken: str, value: float) -> None:
    batch = planted_batch(2, 4)
    pose = true_pose(batch)
    getattr(pose, broken)[1, 0] = value
    errors = pose_errors(pose, batch)
    assert errors.rotation_deg[1] == errors.reprojection_deg[1] == 180
    assert errors.translation[1] == errors.centre[1] == math.inf
    assert errors.rotation_deg[[0, 2, 3]].max() < 1e-6
    values = pose_quartiles(errors)
    assert values["found"] == 0.75
    assert not any(value.isnan() for value in values.values())
    # The third quartile of 4 lies a quarter of the way from the third to the fourth.
    assert values["translation_q3"] == math.inf
    assert values["translation_q2"] < 1e-6
    assert values["rotation_q3_deg"] == pytest.approx(45, abs=1e-6)
    assert pose_recalls(errors)["recall_joint_15deg_0.5"] == 0.75


def test_pairs_without_a_true_match_are_left_out_of_the_reprojection_figures_only_and_counted() -> None:
    batch = planted_batch(3, 4)
    match3d = batch.match3d
    assert match3d is not None
    match3d[:2] = -1
    pose = true_pose(batch)
    pose.rotation[1] = math.nan
    errors = pose_errors(pose, batch)
    assert errors.reprojection_deg.isnan().tolist() == [True, False, False, False]
    values = pose_quartiles(errors)
    assert values["without_matches"] == 1
    assert values["reprojection_q3_deg"] == pytest.approx(90, abs=1e-6)  # of 0, 0, 180
    assert pose_recalls(errors)["recall_reprojection_1deg"].item() == pytest.approx(2 / 3)
    assert pose_recalls(errors)["recall_rotation_1deg"] == 0.75


@pytest.mark.parametrize("size", [1, 2, 3, 4, 5, 17, 100])
def test_quartiles_are_those_of_numpy(size: int) -> None:
    errors = PoseErrors(*torch.from_numpy(np.random.default_rng(size).gamma(1.0, 10.0, (4, size))))
    values = pose_quartiles(errors)
    for name, error in (("rotation_q{}_deg", errors.rotation_deg), ("translation_q{}", errors.translation),
                        ("centre_q{}", errors.centre), ("reprojection_q{}_deg", errors.reprojection_deg)):  # fmt: skip
        ours = [values[name.format(number)].item() for number in (1, 2, 3)]
        np.testing.assert_allclose(ours, np.quantile(error.numpy(), [0.25, 0.5, 0.75]), rtol=1e-14)


def test_recall_counts_errors_up_to_and_including_the_threshold() -> None:
    rotation = torch.tensor([1.0, 5.0, 9.0, 15.0, 180.0], dtype=torch.float64)
    translation = torch.tensor([0.4, 0.5, 0.9, 0.6, math.inf], dtype=torch.float64)
    errors = PoseErrors(rotation, translation, translation, rotation)
    assert {key: value.item() for key, value in pose_recalls(errors).items() if "joint" in key or "5deg" in key} == {
        "recall_rotation_5deg": 0.4,
        "recall_rotation_15deg": 0.8,
        "recall_reprojection_0.25deg": 0,
        "recall_reprojection_0.5deg": 0,
        "recall_joint_15deg_0.5": 0.4,
        "recall_joint_10deg_1": 0.6,
    }
    chosen = pose_recalls(errors, RecallThresholds((7,), (), (0.45,), (), ((1, 0.4),)))
    assert {key: value.item() for key, value in chosen.items()} == {
        "recall_rotation_7deg": 0.4,
        "recall_centre_0.45": 0.2,
        "recall_joint_1deg_0.4": 0.2,
    }


def test_bad_input_raises_one_clear_error() -> None:
    batch = planted_batch(0, 2)
    pose = true_pose(batch)
    unknown = Batch.from_arrays(batch.points2d, batch.points3d)
    with pytest.raises(ValueError, match="the batch has no true `rotation`"):
        pose_errors(pose, unknown)
    assert batch.rotation is not None
    batch.rotation[1, 0, 0] = math.nan
    with pytest.raises(ValueError, match="true pose of 1 holds NaN or infinity"):
        pose_errors(pose, batch)
    with pytest.raises(ValueError, match="the thresholds of .* must be finite, and 0 or more"):
        RecallThresholds(translation=(0.1, -1))
    with pytest.raises(ValueError, match="the thresholds of .* must be finite, and 0 or more"):
        RecallThresholds(joint=[(1, math.inf)])
    nan = torch.full((1,), math.nan, dtype=torch.float64)
    with pytest.raises(ValueError, match="a rotation error is NaN"):
        pose_quartiles(PoseErrors(nan, nan, nan, nan))
