"""Quartiles of pose errors over many pairs, as a function and as a metric.

A pair without a pose counts as 180 deg and infinity. A pair without a true match has no reprojection error: it is left
out of the reprojection quartiles only, and counted as "without_true_pairs".
"""

import math

import torch
from torch import Tensor

from bpnp.metrics.errors import PoseErrors
from bpnp.metrics.per_pair import PoseMetric, known_errors


def pose_quartiles(errors: PoseErrors) -> dict[str, Tensor]:
    """First, second (median) and third quartile of each error, as float64 scalars.

    Keys: "rotation_q1_deg", "translation_q2", "centre_q3", "reprojection_q1_deg" and so on; "found", the share of pairs
    with a pose; "without_true_pairs", the number of pairs without a reprojection error. Linear interpolation between
    order statistics (numpy's default); a quartile that leans on an infinite neighbour is infinite. The reprojection
    quartiles are absent if no pair has that error. Raises ValueError if there is no pair.
    """
    values: dict[str, Tensor] = {}
    for name, unit, error in known_errors(errors):
        ordered = error.sort().values
        for number in (1, 2, 3):
            position = number / 4 * (len(ordered) - 1)
            below, above = ordered[math.floor(position)], ordered[math.ceil(position)]
            # Between two infinities the interpolation is NaN.
            value = torch.lerp(below, above, position % 1).where(above.isfinite(), above)
            values[f"{name}_q{number}_{unit}".rstrip("_")] = value
    values["found"] = errors.translation.isfinite().double().mean()
    values["without_true_pairs"] = errors.reprojection_deg.isnan().double().sum()
    return values


class PoseQuartiles(PoseMetric):
    """`pose_quartiles` over all pairs.

    >>> metric = PoseQuartiles()
    >>> metric.update(PoseErrors(*torch.tensor([[1.0, 3.0, 5.0], [0.1, 0.2, 0.3], [0.1, 0.2, 0.3], [0.2, 0.2, 0.4]])))
    >>> float(metric.compute()["rotation_q1_deg"])
    2.0
    """

    higher_is_better = False

    def compute(self) -> dict[str, Tensor]:
        return pose_quartiles(self.errors())
