"""Errors of camera poses, their quartiles and recalls, and both as torchmetrics.

Conventions: camera = R p + t. Angles are in degrees, lengths in scene units; everything is computed in float64.
A pair without a pose (NaN or infinity in the estimate) has errors of 180 deg and infinity: it counts as the worst pose,
it is never left out. A pair with a pose but without a true match has no reprojection error (NaN): it is left out of the
reprojection figures only, and `quartiles` counts it as "without_true_pairs".
"""

import math
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torchmetrics import Metric
from torchmetrics.utilities.data import dim_zero_cat

from bpnp.geometry import angle_between, bearings, camera_centre, rotation_angle, transform
from bpnp.types import Batch, Pose

Limits = Sequence[float | int]
JointLimits = Sequence[tuple[float | int, float | int]]


@dataclass(frozen=True)
class PoseErrors:
    """Errors of one estimate for b pairs, float64; see the functions below. `index` is the pairs' `Batch.index`."""

    rotation_deg: Float[Tensor, " b"]
    translation: Float[Tensor, " b"]
    centre: Float[Tensor, " b"]
    reprojection_deg: Float[Tensor, " b"]
    index: Int[Tensor, " b"] | None = None


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


def rotation_error(rotation: Float[Tensor, "b 3 3"], rotation_gt: Float[Tensor, "b 3 3"]) -> Float[Tensor, " b"]:
    """Angle of R^T R_gt in degrees, in [0, 180] (paper Eq. 11), by atan2; 180 where R is not finite."""
    error = torch.rad2deg(rotation_angle(rotation.double(), rotation_gt.double()))
    return error.where(rotation.isfinite().all((-2, -1)), 180.0)


def translation_error(translation: Float[Tensor, "b 3"], translation_gt: Float[Tensor, "b 3"]) -> Float[Tensor, " b"]:
    """|t - t_gt| in scene units (paper Eq. 12); infinite where t is not finite."""
    error = torch.linalg.vector_norm(translation.double() - translation_gt.double(), dim=-1)
    return error.where(translation.isfinite().all(-1), math.inf)


def centre_error(
    rotation: Float[Tensor, "b 3 3"],
    translation: Float[Tensor, "b 3"],
    rotation_gt: Float[Tensor, "b 3 3"],
    translation_gt: Float[Tensor, "b 3"],
) -> Float[Tensor, " b"]:
    """Distance |R^T t - R_gt^T t_gt| of the camera centres, wherever the scene's origin is; infinite without a pose."""
    centre = camera_centre(rotation.double(), translation.double())
    error = torch.linalg.vector_norm(centre - camera_centre(rotation_gt.double(), translation_gt.double()), dim=-1)
    return error.where(_is_finite(rotation, translation), math.inf)


def reprojection_error(
    rotation: Float[Tensor, "b 3 3"],
    translation: Float[Tensor, "b 3"],
    points2d: Float[Tensor, "b m 2"],
    points3d: Float[Tensor, "b n 3"],
    match3d: Int[Tensor, "b n"],
    mask3d: Bool[Tensor, "b n"] | None = None,
) -> Float[Tensor, " b"]:
    """Mean angle in degrees between f_i and R p_j + t over the true pairs i = match3d[j] >= 0.

    Paper Eq. 2 divides the sum over the true pairs by m n; here it is divided by their number, so that it is an angle
    and does not depend on the sizes of the sets. A point at the camera centre counts as 180. A sample without a pose
    is 180; else a sample without a true pair is NaN.
    """
    true = (match3d >= 0) if mask3d is None else (match3d >= 0) & mask3d
    seen = points2d.double().gather(1, match3d.clamp(min=0).unsqueeze(-1).expand(-1, -1, 2))
    points = transform(rotation.double(), translation.double(), points3d.double())
    angle = angle_between(bearings(seen), points).where((points != 0).any(-1), math.pi)
    mean = torch.rad2deg(angle.where(true, 0.0).sum(-1) / true.sum(-1))
    return mean.where(_is_finite(rotation, translation), 180.0)


def pose_errors(pose: Pose, batch: Batch) -> PoseErrors:
    """All four errors against the batch's true pose. `reprojection_deg` is NaN if the batch knows no matches.

    Raises ValueError if the true pose is absent or not finite.
    """
    if batch.rotation is None or batch.translation is None:
        raise ValueError("expected a batch with its true `rotation` and `translation`, got None; try Batch.from_arrays")
    known = _is_finite(batch.rotation, batch.translation)
    if not bool(known.all()):
        raise ValueError(f"expected a finite true pose, got NaN or infinity in {batch.ids[int(known.int().argmin())]}")
    rotation = pose.rotation.where(pose.found[:, None, None], math.nan)
    translation = pose.translation.where(pose.found[:, None], math.nan)
    reprojection = torch.full_like(translation[:, 0], math.nan, dtype=torch.float64)
    if batch.match3d is not None:
        points = (batch.points2d, batch.points3d, batch.match3d, batch.mask3d)
        reprojection = reprojection_error(rotation, translation, *points)
    return PoseErrors(
        rotation_deg=rotation_error(rotation, batch.rotation),
        translation=translation_error(translation, batch.translation),
        centre=centre_error(rotation, translation, batch.rotation, batch.translation),
        reprojection_deg=reprojection,
        index=batch.index,
    )


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


def _is_finite(rotation: Float[Tensor, "b 3 3"], translation: Float[Tensor, "b 3"]) -> Bool[Tensor, " b"]:
    return rotation.isfinite().all((-2, -1)) & translation.isfinite().all(-1)


class _PoseMetric(Metric):
    """Gathers the errors of every pair once, over batches and processes."""

    full_state_update = False
    records: list[Tensor]

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.add_state("records", default=[], dist_reduce_fx="cat")

    def update(self, pose: Pose | PoseErrors, batch: Batch | None = None) -> None:
        """Add a batch's poses, or errors computed before (all of them are counted if their index is None)."""
        if isinstance(pose, Pose):
            if batch is None:
                raise ValueError("expected the `batch` that the pose belongs to, got None; or give PoseErrors")
            pose = pose_errors(pose, batch)
        index = torch.full_like(pose.rotation_deg, math.nan) if pose.index is None else pose.index
        columns = (pose.rotation_deg, pose.translation, pose.centre, pose.reprojection_deg, index)
        self.records.append(torch.stack([column.detach().double() for column in columns], -1))

    def sync(self, *args: Any, **kwargs: Any) -> None:
        """A process without a batch joins the exchange with no rows, in the type and width of the others' rows."""
        if len(self.records) == 0:
            self.records.append(torch.empty(0, 5, dtype=torch.float64, device=self.device))
        super().sync(*args, **kwargs)

    def errors(self) -> PoseErrors:
        """The errors so far, each pair once: its first occurrence."""
        records = dim_zero_cat(self.records) if len(self.records) else torch.empty(0, 5, dtype=torch.float64)
        order = torch.argsort(records[:, 4], stable=True)
        again = records[order, 4].diff() == 0  # never true of NaN, the index of pairs that have none
        first, repeat = order[:-1][again], order[1:][again]
        if not torch.isclose(records[first, :2], records[repeat, :2], rtol=1e-3, atol=1e-3).all():
            message = "expected one pair per `Batch.index`, got one index with several errors; the first is counted"
            warnings.warn(f"{message}; try a metric per data set, and an index for each of its pairs", stacklevel=2)
        keep = torch.ones_like(records[:, 0], dtype=torch.bool)
        keep[repeat] = False
        return PoseErrors(*records[keep, :4].unbind(-1))


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


class MeanOverPairs(Metric):
    """Mean of one value per pair over batches and processes, each pair counted once by its `Batch.index`."""

    full_state_update = False
    records: list[Tensor]

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.add_state("records", default=[], dist_reduce_fx="cat")

    def update(self, values: Float[Tensor, " b"], index: Int[Tensor, " b"]) -> None:
        self.records.append(torch.stack([index.double(), values.detach().double()], -1))

    def compute(self) -> Float[Tensor, ""]:
        records = dim_zero_cat(self.records)
        order = torch.argsort(records[:, 0], stable=True)
        first = torch.ones_like(order, dtype=torch.bool)
        first[1:] = records[order, 0].diff() != 0
        return records[order, 1][first].mean()
