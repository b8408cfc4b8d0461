"""Refinement of the RANSAC pose by least squares, as in the tests of BPnPNet's authors."""

import math
from dataclasses import replace

import cv2
import numpy as np
import torch

from bpnp.arrays import Array
from bpnp.checks import check_positive
from bpnp.geometry import within_angle
from bpnp.models.batch_search import on_host
from bpnp.models.refinement import REFINED, Refinement
from bpnp.poses import MIN_POINTS
from bpnp.types import Batch, Pose, Prediction, SolveStats


class LeastSquares(Refinement):
    """Refinement of the pose "ransac" to the pose "refined" by Levenberg-Marquardt on all pairs within an angle.

    The pairs are those of an image point and a scene point within the angle of each other under the RANSAC pose, also
    several of one point. The assignment is not used. A sample with fewer than four pairs has no refined pose.

    Args:
        angle: Largest angle of a pair, radians. Default: one degree, as in the authors' code.
        enabled: False returns predictions unchanged. Default True.

    >>> from bpnp import BPnPNet
    >>> from bpnp.models import LeastSquares
    >>> BPnPNet(refinement=LeastSquares()).estimates
    ('ransac', 'pnp', 'refined')
    """

    def __init__(self, *, angle: float = math.radians(1), enabled: bool = True) -> None:
        super().__init__(hypotheses=0, enabled=enabled)
        check_positive(angle=angle)
        self.angle = angle

    def forward(self, prediction: Prediction, batch: Batch) -> Prediction:
        """Return the prediction with the pose "refined".

        Args:
            prediction: Prediction with the pose "ransac".
            batch: Problems.
        """
        if not self.enabled:
            return prediction
        start = prediction.poses["ransac"]
        rotation, translation = start.rotation.to(batch.points3d), start.translation.to(batch.points3d)
        pairs = within_angle(batch.points2d, batch.points3d, rotation, translation, self.angle)
        pairs &= batch.mask2d.unsqueeze(2) & batch.mask3d.unsqueeze(1)  # no pair without a pose: NaN is within nothing
        poses = np.full((len(batch), 3, 4), np.nan)
        for k, near in enumerate(on_host(pairs)):
            i, j = near.nonzero()
            if len(i) >= MIN_POINTS:
                initial = on_host(rotation[k]), on_host(translation[k])
                poses[k] = _fit_pose(on_host(batch.points2d[k])[i], on_host(batch.points3d[k])[j], *initial)
        found = torch.from_numpy(poses).to(start.rotation)
        stats = SolveStats.of(found.isfinite().all(-1).all(-1))
        refined = Pose(found[:, :, :3].contiguous(), found[:, :, 3].contiguous(), stats)
        return replace(prediction, poses=prediction.poses | {REFINED: refined})


def _fit_pose(points2d: Array, points3d: Array, rotation: Array, translation: Array) -> Array:
    """Return the pose [R | t] (3, 4) of least squared reprojection error of pairs (k, 2) and (k, 3) near a pose."""
    rotvec, _ = cv2.Rodrigues(rotation)
    rotvec, shift = cv2.solvePnPRefineLM(points3d, points2d, np.eye(3), None, rotvec, translation.reshape(3, 1))
    return np.column_stack([cv2.Rodrigues(rotvec)[0], shift])
