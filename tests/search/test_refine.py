"""Poses that somebody else proposes are judged by the points."""

import numpy as np
import torch
from planted import plant

from bpnp.loops.parallel import Deadline
from bpnp.metrics import rotation_error
from bpnp.search.point_sets import PointSets
from bpnp.search.refine import score_poses

PLANTED = plant(1, 60, noise=0.001)
SETS = PointSets(PLANTED.bearings[0].numpy(), PLANTED.points3d[0].numpy())


def test_the_best_of_the_given_poses_is_fitted_and_believed() -> None:
    poses = [PLANTED.near(off) for off in (1.0, 0.003)]
    rotation, translation = (torch.cat(values).numpy() for values in zip(*poses, strict=True))
    missing = np.full((1, 3, 3), np.nan)
    rotation, translation = np.concatenate([missing, rotation]), np.concatenate([missing[:, 0], translation])
    result = score_poses(SETS, rotation, translation, Deadline())
    assert result.verdict == "confident"
    assert rotation_error(torch.as_tensor(result.best[0])[None], PLANTED.rotation) < 0.3
    assert result.batches == 2


def test_a_wrong_pose_is_not_believed_and_none_is_none() -> None:
    rotation, translation = (values.numpy() for values in PLANTED.near(1.0))
    wrong = score_poses(SETS, rotation, translation, Deadline())
    assert wrong.verdict == "failed"
    assert (wrong.candidates.hits == 0).all()
    assert score_poses(SETS, np.nan * rotation, translation, Deadline()).verdict == "failed"
