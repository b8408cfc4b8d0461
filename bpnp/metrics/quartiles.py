"""Quartiles of pose errors over many pairs, as a function and as a metric.

A pair without a pose counts as 180 deg and infinity. A pair without a true match has no reprojection error: it is left
out of the reprojection quartiles only, and counted as "without_true_pairs".
"""

import torch
from jaxtyping import Float
from torch import Tensor

from bpnp.metrics.errors import PoseErrors
from bpnp.metrics.per_pair import PoseMetric, known_errors


def pose_quartiles(errors: PoseErrors) -> dict[str, Tensor]:
    """First, second (median) and third quartile of each error, as float64 scalars.

    Keys: "rotation_q1_deg", "translation_q2", "centre_q3", "reprojection_q1_deg" and so on; "found", the share of pairs
    with a pose; "without_true_pairs", the number of pairs without a reprojection error. Linear interpolation between
    order statistics (numpy's default); a quartile that leans on an infinite neighbour is infinite. The reprojection
    quartiles are absent if no pair has that error. Raises ValueError if there is no pair.

    >>> errors = PoseErrors(*torch.tensor([[1.0, 3.0, 5.0], [0.1, 0.2, 0.3], [0.1, 0.2, 0.3], [0.2, 0.2, 0.4]]))
    >>> float(pose_quartiles(errors)["rotation_q2_deg"])
    3.0
    """
    values: dict[str, Tensor] = {}
    for name, unit, error in known_errors(errors):
        keys = (f"{name}_q{number}_{unit}".rstrip("_") for number in (1, 2, 3))
        values.update(zip(keys, _quartiles(error), strict=True))
    values["found"] = errors.translation.isfinite().double().mean()
    values["without_true_pairs"] = errors.reprojection_deg.isnan().double().sum()
    return values


def _quartiles(values: Float[Tensor, " k"]) -> Float[Tensor, " 3"]:
    ordered = values.sort().values
    position = torch.tensor([0.25, 0.5, 0.75], dtype=torch.float64, device=values.device) * (len(values) - 1)
    below, above = ordered[position.floor().long()], ordered[position.ceil().long()]
    # Between two infinities the interpolation is NaN.
    return torch.lerp(below, above, position.frac()).where(above.isfinite(), above)


class PoseQuartiles(PoseMetric):
    """Quartiles of the pose errors over all pairs, as `pose_quartiles` returns them.

    >>> metric = PoseQuartiles()
    >>> metric.update(PoseErrors(*torch.tensor([[1.0, 3.0, 5.0], [0.1, 0.2, 0.3], [0.1, 0.2, 0.3], [0.2, 0.2, 0.4]])))
    >>> float(metric.compute()["rotation_q1_deg"])
    2.0
    """

    higher_is_better = False

    def compute(self) -> dict[str, Tensor]:
        return pose_quartiles(self.errors())
