"""RANSAC of other libraries on candidate pairs of one sample: PoseLib's, and OpenCV's as in the paper."""

from collections.abc import Callable
from typing import Any, NamedTuple

import cv2
import numpy as np
import poselib
from numpy.typing import NDArray

from bpnp.geometry import MIN_POINTS

KEPT = 0.9  # share of its inliers that a refit must keep


class Estimate(NamedTuple):
    rotation: NDArray[np.float64]
    translation: NDArray[np.float64]
    iterations: int


Estimator = Callable[[NDArray[np.float64], NDArray[np.float64], float, int, int], Estimate | None]


def mean_residual(
    found: Estimate, points2d: NDArray[np.float64], points3d: NDArray[np.float64], threshold: float
) -> float | None:
    """Mean reprojection error of the inliers of a pose; None if it is not finite or has too few in front of it.

    The returned pose itself is scored: a refit to the inliers of another one may have lost them.
    """
    errors = _inlier_errors(found, points2d, points3d, threshold)
    return float(errors.mean()) if len(errors) >= MIN_POINTS else None


def _inlier_errors(
    found: Estimate, points2d: NDArray[np.float64], points3d: NDArray[np.float64], threshold: float
) -> NDArray[np.float64]:
    """Reprojection errors up to the threshold of points in front of the camera; none for a pose that is not finite."""
    if not (np.isfinite(found.rotation).all() and np.isfinite(found.translation).all()):
        return np.empty(0)
    y = points3d @ found.rotation.T + found.translation
    front = y[:, 2] > 0
    error = np.linalg.norm(y[front, :2] / y[front, 2:] - points2d[front], axis=-1)
    return error[error <= threshold]


def poselib_ransac(
    points2d: NDArray[np.float64], points3d: NDArray[np.float64], threshold: float, max_iterations: int, seed: int
) -> Estimate | None:
    options = {
        "max_reproj_error": threshold,
        "max_iterations": max_iterations,
        "min_iterations": min(1000, max_iterations),
        "progressive_sampling": True,
        "seed": seed,
    }
    camera = {"model": "SIMPLE_PINHOLE", "width": 1, "height": 1, "params": [1.0, 0.0, 0.0]}
    pose, info = poselib.estimate_absolute_pose(points2d, points3d, camera, options, {})
    return Estimate(pose.R, pose.t, int(info["iterations"]))


def opencv_ransac(
    points2d: NDArray[np.float64], points3d: NDArray[np.float64], threshold: float, max_iterations: int, seed: int
) -> Estimate | None:
    del seed  # OpenCV's generator starts afresh at each call
    try:  # with the P3P flag, OpenCV itself ends with EPnP on the inliers
        ok, rotvec, translation, inliers = cv2.solvePnPRansac(
            points3d,
            points2d,
            np.eye(3),
            None,
            iterationsCount=max_iterations,
            reprojectionError=threshold,
            flags=cv2.SOLVEPNP_P3P,
        )
        if not ok:
            return None
        found = _estimate(rotvec, translation, max_iterations)
        # EPnP has no unique solution for points of one plane: it may have left the pose that it was to refit.
        x, p = (points[inliers.ravel()] for points in (points2d, points3d))
        kept = len(_inlier_errors(found, x, p, threshold))
        if kept < KEPT * len(x):
            ok, rotvec, translation = cv2.solvePnP(p, x, np.eye(3), None, flags=cv2.SOLVEPNP_SQPNP)
            other = _estimate(rotvec, translation, max_iterations)
            if ok and len(_inlier_errors(other, x, p, threshold)) > kept:
                return other
    except cv2.error:  # degenerate inliers: OpenCV has no pose to offer
        return None
    return found


def _estimate(rotvec: Any, translation: Any, iterations: int) -> Estimate:
    return Estimate(np.asarray(cv2.Rodrigues(rotvec)[0], float), np.asarray(translation, float).ravel(), iterations)
