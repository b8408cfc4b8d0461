"""Errors of poses, and their quartiles and recalls over many pairs.

The names are imported when they are asked for: the errors need torch alone, the others torchmetrics too.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from bpnp.metrics.errors import (
        PoseErrors,
        centre_error,
        pose_errors,
        reprojection_error,
        rotation_error,
        translation_error,
    )
    from bpnp.metrics.per_pair import MeanOverPairs, PoseQuartiles, PoseRecall, RecallThresholds, quartiles, recalls

ERRORS = ("PoseErrors", "centre_error", "pose_errors", "reprojection_error", "rotation_error", "translation_error")
__all__ = [
    "MeanOverPairs", "PoseErrors", "PoseQuartiles", "PoseRecall", "RecallThresholds", "centre_error", "pose_errors",
    "quartiles", "recalls", "reprojection_error", "rotation_error", "translation_error",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module("bpnp.metrics.errors" if name in ERRORS else "bpnp.metrics.per_pair"), name)
