"""Recall of poses at error thresholds over many pairs, as a function and as a metric.

A pair without a pose is right at no threshold. A pair without a true match is left out of the reprojection recall only.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from torch import Tensor

from bpnp.metrics.errors import PoseErrors
from bpnp.metrics.per_pair import PoseMetric, known_errors

Limits = Sequence[float | int]


@dataclass(frozen=True)
class RecallThresholds:
    """Errors up to which a pose counts as right; `joint` holds pairs (rotation in deg, translation)."""

    rotation_deg: Limits = (1.0, 2.0, 5.0, 10.0, 15.0, 20.0)
    translation: Limits = (0.05, 0.1, 0.2, 0.5, 1.0)
    centre: Limits = (0.05, 0.1, 0.2, 0.5, 1.0)
    reprojection_deg: Limits = (0.25, 0.5, 1.0, 2.0)
    joint: Sequence[tuple[float | int, float | int]] = ((15.0, 0.5), (10.0, 1.0))

    def __post_init__(self) -> None:
        given = (self.rotation_deg, self.translation, self.centre, self.reprojection_deg, *self.joint)
        if not all(0 <= limit < math.inf for limits in given for limit in limits):
            raise ValueError(f"expected finite thresholds >= 0, got {self}")


def pose_recalls(errors: PoseErrors, thresholds: RecallThresholds | None = None) -> dict[str, Tensor]:
    """Share of pairs in [0, 1] with error <= threshold, for every threshold, as float64 scalars.

    Keys: "recall_rotation_5deg", "recall_translation_0.5", "recall_centre_0.5", "recall_reprojection_1deg", and
    "recall_joint_15deg_0.5" for rotation and translation both. Raises ValueError if there is no pair.
    """
    thresholds = thresholds or RecallThresholds()
    values: dict[str, Tensor] = {}
    for name, unit, error in known_errors(errors):
        for limit in getattr(thresholds, f"{name}_{unit}".rstrip("_")):
            values[f"recall_{name}_{limit:g}{unit}"] = (error <= limit).double().mean()
    for degrees, length in thresholds.joint:
        right = (errors.rotation_deg <= degrees) & (errors.translation <= length)
        values[f"recall_joint_{degrees:g}deg_{length:g}"] = right.double().mean()
    return values


class PoseRecall(PoseMetric):
    """`pose_recalls` over all pairs.

    >>> metric = PoseRecall(RecallThresholds(rotation_deg=(4,)))
    >>> metric.update(PoseErrors(*torch.tensor([[1.0, 3.0, 5.0], [0.1, 0.2, 0.3], [0.1, 0.2, 0.3], [0.2, 0.2, 0.4]])))
    >>> round(float(metric.compute()["recall_rotation_4deg"]), 3)
    0.667
    """

    higher_is_better = True

    def __init__(self, thresholds: RecallThresholds | None = None, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.thresholds = thresholds

    def compute(self) -> dict[str, Tensor]:
        return pose_recalls(self.errors(), self.thresholds)
