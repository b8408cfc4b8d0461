"""RANSAC of this and of other libraries on candidate matches: one signature, one pose a sample.

`consensus` works on a whole batch at once, on its device. No shape depends on the data. Only the minimal problems are
solved on the CPU, those of all samples at once.
"""

from collections.abc import Callable
from functools import partial

import cv2
import numpy as np
import poselib
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from bpnp.arrays import Array
from bpnp.geometry import bearings, retract
from bpnp.layers.ransac.matches import Matches, distinct_triples, residuals, truncated_scores
from bpnp.layers.ransac.minimal_solvers import poses_of_triples, take
from bpnp.poses import MIN_POINTS
from bpnp.runtime import in_threads

SMALLEST_POOL = 16  # matches of largest weight that the first triples of a growing pool are from [matches; not tuned]
# Number of matches of largest weight on which all hypotheses are scored. With 256, poses are lost at 10 % inliers.
SUBSET = 512  # [matches; measured, the problems are not recorded]
SHORTLIST = 256  # number of hypotheses that are then scored on all matches [hypotheses; cost]
REFINED = 16  # number of hypotheses that are refined locally on the subset [hypotheses; cost]
LOCAL_STEPS = 4  # Gauss-Newton steps of these [steps; not tuned]
FINAL_STEPS = 6  # Gauss-Newton steps of the best one on all matches [steps; not tuned]
DAMPING = 1e-9  # damping, a fraction of the Hessian's mean diagonal [fraction; numerics]
# It ends after 3 times the number that has a true triple with probability 0.9999.
FEWEST_HYPOTHESES = 25  # least number of hypotheses of PoseLib [hypotheses; not tuned]
LEAST_KEPT = 0.9  # fraction of its inliers that OpenCV's refit must keep [fraction; not tuned]

# points2d (k, 2), points3d (k, 3), threshold, most hypotheses, seed -> pose [R | t] and hypotheses, None for no pose
SingleEstimator = Callable[[Array, Array, float, int, int], tuple[Array, int] | None]
Estimator = Callable[[Matches, float, int, int], tuple[Float[Tensor, "b 3 4"], Int[Tensor, " b"]]]


def consensus(
    matches: Matches, threshold: float, hypotheses: int, seed: int
) -> tuple[Float[Tensor, "b 3 4"], Int[Tensor, " b"]]:
    """Estimate the pose [R | t] of lowest truncated squared reprojection error sum_i min(r_i^2, threshold^2).

    Triples come from a pool of the most probable matches (`normalise_matches`, the most probable first; a point may be
    in many) that grows to all matches (PROSAC; Chum, Matas, CVPR 2005). `p3p` solves each, all poses are scored (MSAC;
    a point behind the camera is an outlier), and the best are refined. Only the scores are computed in float32. The
    number of hypotheses is returned too; the pose of a sample without one is arbitrary or NaN.
    """
    threshold2 = threshold**2
    subset = Matches(*(values[:, :SUBSET] for values in matches))
    progress = (torch.arange(hypotheses, device=matches.real.device, dtype=torch.float64) + 0.5) / hypotheses
    last = matches.real.sum(-1, keepdim=True).clamp(min=3).double()
    first = last.clamp(max=SMALLEST_POOL)
    triples = distinct_triples((first * (last / first) ** progress).ceil(), seed)
    # With fewer than three matches, a triple repeats one and has no pose.
    triples = triples.clamp(max=matches.real.shape[1] - 1).flatten(1)
    rays, scene = (
        take(v, triples).unflatten(1, (hypotheses, 3)) for v in (bearings(matches.points2d), matches.points3d)
    )
    poses = poses_of_triples(rays, scene)
    poses = _best(poses, truncated_scores(poses, subset, threshold2), SHORTLIST)
    poses = _best(poses, truncated_scores(poses, matches, threshold2), REFINED)
    poses = refine_locally(poses, subset, threshold2, LOCAL_STEPS)
    pose = _best(poses, truncated_scores(poses, matches, threshold2), 1)
    pose = refine_locally(pose, matches, threshold2, FINAL_STEPS)
    return pose.squeeze(1), matches.real.sum(-1).fill_(hypotheses)


def _best(poses: Float[Tensor, "b c 3 4"], score: Float[Tensor, "b c"], size: int) -> Float[Tensor, "b s 3 4"]:
    """Return the poses of lowest score; NaN, the score of an empty slot, counts as the highest."""
    return take(poses, score.topk(min(size, score.shape[1]), largest=False).indices)


def refine_locally(
    poses: Float[Tensor, "b c 3 4"], matches: Matches, threshold2: float, steps: int
) -> Float[Tensor, "b c 3 4"]:
    """Reduce sum_i min(r_i^2, threshold2) by Gauss-Newton steps on the inliers of the current pose [R | t].

    Poses are refined independently. The result is the best pose visited, which may be the initial one.
    """
    best = poses
    lowest = torch.full(poses.shape[:2], torch.inf, dtype=poses.dtype, device=poses.device)
    damping = DAMPING * torch.eye(6, dtype=poses.dtype, device=poses.device)
    for _ in range(steps + 1):
        squared, inlier, residual, camera = residuals(poses, matches, threshold2)
        score = torch.where(inlier, squared, threshold2).mul(matches.real.unsqueeze(1)).sum(-1)
        better = score < lowest
        best, lowest = torch.where(better[..., None, None], poses, best), torch.where(better, score, lowest)
        jacobian = _jacobian(camera, camera - poses[..., None, :, 3], inlier)
        residual = torch.where(inlier.unsqueeze(-1), residual, 0)
        hessian = jacobian @ jacobian.mT
        gradient = jacobian @ residual.mT.flatten(-2).unsqueeze(-1)
        hessian = hessian + damping * (1e-9 + hessian.diagonal(dim1=-2, dim2=-1).mean(-1)[..., None, None])
        step = -torch.cholesky_solve(gradient, torch.linalg.cholesky_ex(hessian).L).squeeze(-1)
        rotation, translation = retract(step, poses[..., :3], poses[..., 3])
        poses = torch.cat([rotation, translation.unsqueeze(-1)], -1)
    return best


def _jacobian(
    camera: Float[Tensor, "b c k 3"], turned: Float[Tensor, "b c k 3"], inlier: Bool[Tensor, "b c k"]
) -> Float[Tensor, "b c 6 2*k"]:
    """Return the derivatives of x/z, then of y/z, by the step (w, s) of `retract`; zero for outliers.

    A step moves y = R p + t, `camera`, by w x R p + s; `turned` is R p.
    """
    inverse = torch.where(inlier, 1 / camera[..., 2], 0)
    u, v = camera[..., 0] * inverse, camera[..., 1] * inverse
    a, b, c = (turned * inverse.unsqueeze(-1)).unbind(-1)
    zero = torch.zeros_like(u)
    along_x = torch.stack([-u * b, c + u * a, -b, inverse, zero, -u * inverse], -2)
    along_y = torch.stack([-c - v * b, v * a, a, zero, inverse, -v * inverse], -2)
    return torch.cat([along_x, along_y], -1)


def _each(
    estimate: SingleEstimator, matches: Matches, threshold: float, max_iterations: int, seed: int
) -> tuple[Float[Tensor, "b 3 4"], Int[Tensor, " b"]]:
    """Estimate each sample by itself, in threads; those with fewer than 4 matches have no pose and no iterations."""
    points2d, points3d, real = (values.cpu().numpy() for values in matches)
    enough = real.sum(-1) >= MIN_POINTS
    poses, iterations = np.full((len(real), 3, 4), np.nan), np.where(enough, max_iterations, 0)

    def work(first: int, last: int) -> None:
        for i in range(first, last):
            x, p = points2d[i][real[i]], points3d[i][real[i]]
            if enough[i] and (found := estimate(x, p, threshold, max_iterations, seed)) is not None:
                poses[i], iterations[i] = found

    in_threads(work, len(real))
    return torch.from_numpy(poses).to(matches.points3d), torch.from_numpy(iterations).to(matches.real.device)


def _poselib(x: Array, p: Array, threshold: float, max_iterations: int, seed: int) -> tuple[Array, int]:
    """Run LO-RANSAC with progressive sampling."""
    options = {
        "max_reproj_error": threshold,
        "max_iterations": max_iterations,
        "min_iterations": min(FEWEST_HYPOTHESES, max_iterations),
        "progressive_sampling": True,
        "seed": seed,
    }
    camera = {"model": "SIMPLE_PINHOLE", "width": 1, "height": 1, "params": [1.0, 0.0, 0.0]}
    pose, info = poselib.estimate_absolute_pose(x, p, camera, options, {})
    return pose.Rt, int(info["iterations"])


def _opencv(x: Array, p: Array, threshold: float, max_iterations: int, seed: int) -> tuple[Array, int] | None:
    """Run P3P-RANSAC, then EPnP on its inliers, as in the paper; SQPnP where EPnP loses inliers."""
    del seed  # OpenCV resets its generator at each call
    try:
        ok, rotvec, translation, inliers = cv2.solvePnPRansac(
            p, x, np.eye(3), None, iterationsCount=max_iterations, reprojectionError=threshold, flags=cv2.SOLVEPNP_P3P
        )
        if not ok:
            return None
        pose = np.column_stack([cv2.Rodrigues(rotvec)[0], translation])
        # EPnP has no unique solution for points of one plane: its result may be far from the RANSAC pose.
        x, p = x[inliers.ravel()], p[inliers.ravel()]
        kept = _count_inliers(pose, x, p, threshold)
        if kept < LEAST_KEPT * len(x):
            ok, rotvec, translation = cv2.solvePnP(p, x, np.eye(3), None, flags=cv2.SOLVEPNP_SQPNP)
            other = np.column_stack([cv2.Rodrigues(rotvec)[0], translation])
            pose = other if ok and _count_inliers(other, x, p, threshold) > kept else pose
    except cv2.error:  # degenerate inliers: OpenCV has no pose to offer
        return None
    return pose, max_iterations


def _count_inliers(pose: Array, x: Array, p: Array, threshold: float) -> int:
    """Return the number of inliers of one pose [R | t]."""
    camera = p @ pose[:, :3].T + pose[:, 3]
    front = camera[:, 2] > 0
    errors = camera[front, :2] / camera[front, 2:] - x[front]
    return int((np.square(errors).sum(-1) < threshold**2).sum())


# Matches of `bpnp.layers.ransac.matches.normalise_matches`, most probable first, threshold, most hypotheses, seed ->
# poses [R | t], NaN for none, and hypotheses; their bound where the library does not report the number.
BACKENDS: dict[str, Estimator] = {
    "poselib": partial(_each, _poselib),
    "opencv": partial(_each, _opencv),
    "torch": consensus,
}
