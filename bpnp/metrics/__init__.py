"""Errors of poses, and their quartiles and recalls over many pairs."""

from bpnp.metrics.errors import (
    PoseErrors,
    centre_error,
    pose_errors,
    reprojection_error,
    rotation_error,
    translation_error,
)
from bpnp.metrics.pose_metrics import (
    MeanOverPairs,
    PoseQuartiles,
    PoseRecall,
    RecallThresholds,
    pose_quartiles,
    pose_recalls,
)

__all__ = [
    "MeanOverPairs", "PoseErrors", "PoseQuartiles", "PoseRecall", "RecallThresholds", "centre_error", "pose_errors",
    "pose_quartiles", "pose_recalls", "reprojection_error", "rotation_error", "translation_error",
]  # fmt: skip
