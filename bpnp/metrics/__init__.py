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
    from bpnp.metrics.per_pair import MeanOverPairs
    from bpnp.metrics.quartiles import PoseQuartiles, pose_quartiles
    from bpnp.metrics.recall import PoseRecall, RecallThresholds, pose_recalls

__all__ = [
    "MeanOverPairs", "PoseErrors", "PoseQuartiles", "PoseRecall", "RecallThresholds", "centre_error", "pose_errors",
    "pose_quartiles", "pose_recalls", "reprojection_error", "rotation_error", "translation_error",
]  # fmt: skip
PLACES = dict.fromkeys(__all__, "errors") | {
    "MeanOverPairs": "per_pair",
    **dict.fromkeys(("PoseQuartiles", "pose_quartiles"), "quartiles"),
    **dict.fromkeys(("PoseRecall", "RecallThresholds", "pose_recalls"), "recall"),
}


def __getattr__(name: str) -> Any:
    if name not in PLACES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"bpnp.metrics.{PLACES[name]}"), name)
