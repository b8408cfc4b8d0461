"""RANSAC of this and of other libraries on candidate matches: one signature, one pose a sample."""

from collections.abc import Callable
from functools import partial
from typing import Any

import cv2
import numpy as np
import poselib
import torch
from jaxtyping import Float, Int
from numpy.typing import NDArray
from torch import Tensor

from bpnp.geometry import MIN_POINTS
from bpnp.robust.consensus import consensus
from bpnp.robust.matches import Matches, residuals

FEWEST = 25  # hypotheses of PoseLib; it ends after three times as many as meet a true triple with probability 0.9999
KEPT_SHARE = 0.9  # of its inliers that OpenCV's refit must keep
Array = NDArray[np.float64]
# points2d (k, 2), points3d (k, 3), threshold, most hypotheses, seed -> pose [R | t] and hypotheses, None for no pose
SingleEstimator = Callable[[Array, Array, float, int, int], tuple[Array, int] | None]
Estimator = Callable[[Matches, float, int, int], tuple[Float[Tensor, "b 3 4"], Int[Tensor, " b"]]]


def _each(
    estimate: SingleEstimator, matches: Matches, threshold: float, max_iterations: int, seed: int
) -> tuple[Float[Tensor, "b 3 4"], Int[Tensor, " b"]]:
    """One sample after the other; those with fewer than 4 matches have no pose and no iterations."""
    poses, iterations = matches.points3d.new_full((len(matches.real), 3, 4), torch.nan), matches.real.sum(-1)
    for i, count in enumerate(iterations.tolist()):
        iterations[i] = 0 if count < MIN_POINTS else max_iterations
        x, p = (points[i][matches.real[i]].cpu().numpy() for points in matches[:2])
        if count >= MIN_POINTS and (found := estimate(x, p, threshold, max_iterations, seed)) is not None:
            poses[i], iterations[i] = torch.as_tensor(found[0]), found[1]
    return poses, iterations


def _poselib(x: Array, p: Array, threshold: float, max_iterations: int, seed: int) -> tuple[Array, int]:
    """LO-RANSAC with progressive sampling."""
    options = {
        "max_reproj_error": threshold,
        "max_iterations": max_iterations,
        "min_iterations": min(FEWEST, max_iterations),
        "progressive_sampling": True,
        "seed": seed,
    }
    camera = {"model": "SIMPLE_PINHOLE", "width": 1, "height": 1, "params": [1.0, 0.0, 0.0]}
    pose, info = poselib.estimate_absolute_pose(x, p, camera, options, {})
    return pose.Rt, int(info["iterations"])


def _opencv(x: Array, p: Array, threshold: float, max_iterations: int, seed: int) -> tuple[Array, int] | None:
    """P3P-RANSAC, then EPnP on its inliers, as in the paper; SQPnP where EPnP loses inliers."""
    del seed  # OpenCV's generator starts afresh at each call
    try:
        ok, rotvec, translation, inliers = cv2.solvePnPRansac(
            p, x, np.eye(3), None, iterationsCount=max_iterations, reprojectionError=threshold, flags=cv2.SOLVEPNP_P3P
        )
        if not ok:
            return None
        pose = np.column_stack([cv2.Rodrigues(rotvec)[0], translation])
        # EPnP has no unique solution for points of one plane: it may have left the pose that it was to refit.
        x, p = x[inliers.ravel()], p[inliers.ravel()]
        kept = _count_inliers(pose, x, p, threshold)
        if kept < KEPT_SHARE * len(x):
            ok, rotvec, translation = cv2.solvePnP(p, x, np.eye(3), None, flags=cv2.SOLVEPNP_SQPNP)
            other = np.column_stack([cv2.Rodrigues(rotvec)[0], translation])
            pose = other if ok and _count_inliers(other, x, p, threshold) > kept else pose
    except cv2.error:  # degenerate inliers: OpenCV has no pose to offer
        return None
    return pose, max_iterations


def _count_inliers(pose: NDArray[Any], x: Array, p: Array, threshold: float) -> int:
    matches = Matches(*(torch.as_tensor(values)[None] for values in (x, p, np.ones(len(x), bool))))
    return int(residuals(torch.as_tensor(pose)[None, None], matches, threshold**2).inlier.sum())


# Matches as `bpnp.robust.matches.normalised` gives them, most probable first, threshold, most hypotheses, seed ->
# poses [R | t], NaN for none, and hypotheses, or the bound on them where the library does not tell.
BACKENDS: dict[str, Estimator] = {
    "poselib": partial(_each, _poselib),
    "opencv": partial(_each, _opencv),
    "torch": consensus,
}
