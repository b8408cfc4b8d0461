"""Quartiles and recalls of pose errors, as functions and as torchmetrics.

A pair without a pose counts as 180 deg and infinity. A pair without a true match has no reprojection error: it is left
out of the reprojection figures only, and `quartiles` counts it as "without_true_pairs".
"""

import math
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torchmetrics import Metric
from torchmetrics.utilities.data import dim_zero_cat

from bpnp.metrics.errors import PoseErrors, pose_errors
from bpnp.types import Batch, Pose

Limits = Sequence[float | int]
JointLimits = Sequence[tuple[float | int, float | int]]


@dataclass(frozen=True)
class RecallThresholds:
    """Errors up to which a pose counts as right; `joint` holds pairs (rotation in deg, translation)."""

    rotation_deg: Limits = (1.0, 2.0, 5.0, 10.0, 15.0, 20.0)
    translation: Limits = (0.05, 0.1, 0.2, 0.5, 1.0)
    centre: Limits = (0.05, 0.1, 0.2, 0.5, 1.0)
    reprojection_deg: Limits = (0.25, 0.5, 1.0, 2.0)
    joint: JointLimits = ((15.0, 0.5), (10.0, 1.0))

    def __post_init__(self) -> None:
        given = (self.rotation_deg, self.translation, self.centre, self.reprojection_deg, *self.joint)
        if not all(0 <= limit < math.inf for limits in given for limit in limits):
            raise ValueError(f"expected finite thresholds >= 0, got {self}")


def quartiles(errors: PoseErrors) -> dict[str, Tensor]:
    """First, second (median) and third quartile of each error, as float64 scalars.

    Keys: "rotation_q1_deg", "translation_q2", "centre_q3", "reprojection_q1_deg" and so on; "found", the share of pairs
    with a pose; "without_true_pairs", the number of pairs without a reprojection error. Linear interpolation between
    order statistics (numpy's default); a quartile that leans on an infinite neighbour is infinite. The reprojection
    quartiles are absent if no pair has that error. Raises ValueError if there is no pair.
    """
    values: dict[str, Tensor] = {}
    for name, unit, error in _known(errors):
        keys = (f"{name}_q{number}_{unit}".rstrip("_") for number in (1, 2, 3))
        values.update(zip(keys, _quartiles(error), strict=True))
    values["found"] = errors.translation.isfinite().double().mean()
    values["without_true_pairs"] = errors.reprojection_deg.isnan().double().sum()
    return values


def recalls(errors: PoseErrors, thresholds: RecallThresholds | None = None) -> dict[str, Tensor]:
    """Share of pairs in [0, 1] with error <= threshold, for every threshold, as float64 scalars.

    Keys: "recall_rotation_5deg", "recall_translation_0.5", "recall_centre_0.5", "recall_reprojection_1deg", and
    "recall_joint_15deg_0.5" for rotation and translation both. Raises ValueError if there is no pair.
    """
    thresholds = thresholds or RecallThresholds()
    values: dict[str, Tensor] = {}
    for name, unit, error in _known(errors):
        for limit in getattr(thresholds, f"{name}_{unit}".rstrip("_")):
            values[f"recall_{name}_{limit:g}{unit}"] = (error <= limit).double().mean()
    for degrees, length in thresholds.joint:
        right = (errors.rotation_deg <= degrees) & (errors.translation <= length)
        values[f"recall_joint_{degrees:g}deg_{length:g}"] = right.double().mean()
    return values


def _known(errors: PoseErrors) -> Iterator[tuple[str, str, Tensor]]:
    """Name, unit and values of each error that at least one pair has."""
    if len(errors.rotation_deg) == 0:
        raise ValueError("expected at least one pair, got none; try update() before compute()")
    for name, unit in (("rotation", "deg"), ("translation", ""), ("centre", ""), ("reprojection", "deg")):
        error: Tensor = getattr(errors, f"{name}_{unit}".rstrip("_"))
        known = error[~error.isnan()].double()
        if len(known) < len(error) and name != "reprojection":
            raise ValueError(f"expected a {name} error for each pair, got NaN; a pair without a pose is 180 deg or inf")
        if len(known):
            yield name, unit, known


def _quartiles(values: Float[Tensor, " k"]) -> Float[Tensor, " 3"]:
    ordered = values.sort().values
    position = torch.tensor([0.25, 0.5, 0.75], dtype=torch.float64, device=values.device) * (len(values) - 1)
    below, above = ordered[position.floor().long()], ordered[position.ceil().long()]
    # Between two infinities the interpolation is NaN.
    return torch.lerp(below, above, position.frac()).where(above.isfinite(), above)


class _PairMetric(Metric):
    """Numbers of every pair, over batches and processes; each pair once, by its index."""

    full_state_update = False
    width: int
    records: list[Tensor]

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.add_state("records", default=[], dist_reduce_fx="cat")

    def sync(self, *args: Any, **kwargs: Any) -> None:
        """A process without a batch joins the exchange with no rows, in the type and width of the others' rows."""
        if len(self.records) == 0:
            self.records.append(torch.empty(0, self.width + 1, dtype=torch.float64, device=self.device))
        super().sync(*args, **kwargs)

    def _append(self, *columns: Tensor, index: Tensor | None) -> None:
        """Add rows; those without an index are all counted."""
        index = torch.full_like(columns[0], math.nan) if index is None else index
        self.records.append(torch.stack([column.detach().double() for column in (*columns, index)], -1))

    def _columns(self) -> tuple[Tensor, ...]:
        """The columns so far, with the first occurrence of each pair."""
        records = dim_zero_cat(self.records) if len(self.records) else torch.empty(0, self.width + 1)
        values, index = records[:, :-1], records[:, -1]
        order = torch.argsort(index, stable=True)
        again = index[order].diff() == 0  # never true of NaN, the index of pairs that have none
        first, repeat = order[:-1][again], order[1:][again]
        if not torch.isclose(values[first], values[repeat], rtol=1e-3, atol=1e-3, equal_nan=True).all():
            message = "expected one pair per `Batch.index`, got one index with several values; the first is counted"
            warnings.warn(f"{message}; try a metric per data set, and an index for each of its pairs", stacklevel=2)
        keep = torch.ones_like(index, dtype=torch.bool)
        keep[repeat] = False
        return values[keep].unbind(-1)


class _PoseMetric(_PairMetric):
    width = 4

    def update(self, pose: Pose | PoseErrors, batch: Batch | None = None) -> None:
        """Add a batch's poses, or errors computed before (all of them are counted if their index is None)."""
        if isinstance(pose, Pose):
            if batch is None:
                raise ValueError("expected the `batch` that the pose belongs to, got None; or give PoseErrors")
            pose = pose_errors(pose, batch)
        self._append(pose.rotation_deg, pose.translation, pose.centre, pose.reprojection_deg, index=pose.index)

    def errors(self) -> PoseErrors:
        """The errors so far, each pair once: its first occurrence."""
        return PoseErrors(*self._columns())


class PoseQuartiles(_PoseMetric):
    """Quartiles of the pose errors over all pairs, as `quartiles` returns them."""

    def compute(self) -> dict[str, Tensor]:
        return quartiles(self.errors())


class PoseRecall(_PoseMetric):
    """Recall at error thresholds over all pairs, as `recalls` returns them."""

    def __init__(
        self,
        *,
        rotation_deg: Limits = RecallThresholds.rotation_deg,
        translation: Limits = RecallThresholds.translation,
        centre: Limits = RecallThresholds.centre,
        reprojection_deg: Limits = RecallThresholds.reprojection_deg,
        joint: JointLimits = RecallThresholds.joint,
        **kwargs: Any,
    ) -> None:
        super().__init__(**kwargs)
        self.thresholds = RecallThresholds(rotation_deg, translation, centre, reprojection_deg, joint)

    def compute(self) -> dict[str, Tensor]:
        return recalls(self.errors(), self.thresholds)


class MeanOverPairs(_PairMetric):
    """Mean of one value per pair over batches and processes, each pair counted once by its `Batch.index`."""

    width = 1

    def update(self, values: Float[Tensor, " b"], index: Int[Tensor, " b"]) -> None:
        self._append(values, index=index)

    def compute(self) -> Float[Tensor, ""]:
        (values,) = self._columns()
        if len(values) == 0:
            raise ValueError("expected at least one pair, got none; try update() before compute()")
        return values.mean()
