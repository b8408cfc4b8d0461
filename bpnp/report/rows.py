"""From a solver's prediction to the rows of its report."""

import math

import torch
from scipy.spatial import cKDTree

from bpnp.geometry import project, transform
from bpnp.metrics import pose_errors
from bpnp.report.results import PairRow
from bpnp.types import Batch, Pose, Prediction


def rows_from(prediction: Prediction, batch: Batch, seconds: float, *, inlier_threshold: float = 0.01) -> list[PairRow]:
    """One row per pair and estimate. `seconds` is the time of the whole batch; each pair is given an equal share.

    `inlier_threshold` in normalised image units, see `count_inliers`. Raises ValueError if the batch has no true pose.
    """
    true_pairs = torch.zeros_like(batch.index) if batch.match3d is None else (batch.match3d >= 0).sum(-1)
    sizes = torch.stack([batch.count2d, batch.count3d, true_pairs], -1).tolist()
    indices = batch.index.tolist()
    rows = []
    for estimate, pose in prediction.poses.items():
        errors = pose_errors(pose, batch)
        columns = (errors.rotation_deg, errors.translation, errors.centre, errors.reprojection_deg)
        numbers = torch.stack([*columns, pose.stats.residual.double()], -1).tolist()
        iterations = pose.stats.iterations.tolist()
        flags = torch.stack([pose.stats.converged, pose.found], -1).tolist()
        inliers = count_inliers(pose, batch, threshold=inlier_threshold)
        for i in range(len(batch)):
            rotation, translation, centre, reprojection, residual = numbers[i]
            (m, n, pairs), (converged, found) = sizes[i], flags[i]
            rows.append(
                PairRow(
                    index=indices[i],
                    id=batch.ids[i],
                    estimate=estimate,
                    rotation_error_deg=rotation,
                    translation_error=translation,
                    centre_error=centre,
                    reprojection_error_deg=reprojection,
                    inliers=inliers[i],
                    m=m,
                    n=n,
                    true_pairs=pairs,
                    iterations=iterations[i],
                    residual=residual,
                    converged=converged,
                    found=found,
                    seconds=seconds / len(batch),
                )
            )
    return rows


def count_inliers(pose: Pose, batch: Batch, *, threshold: float = 0.01) -> list[int]:
    """2D points of each pair with a projected 3D point nearer than `threshold` (normalised image units).

    Needs no true match: it is what a user of the pose can check. Points behind the camera do not count; without a pose
    there is no inlier.
    """
    camera = transform(pose.rotation.double(), pose.translation.double(), batch.points3d.double())
    projected = project(camera)
    visible = batch.mask3d & (camera[..., 2] > 0) & projected.isfinite().all(-1)
    counts = []
    for i in range(len(batch)):
        shown, seen = projected[i, visible[i]].cpu().numpy(), batch.points2d[i, batch.mask2d[i]].cpu().numpy()
        # An empty tree answers infinity.
        distance, _ = cKDTree(shown).query(seen, distance_upper_bound=threshold)
        counts.append(int((distance < math.inf).sum()))
    return counts
