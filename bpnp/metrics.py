"""Pose errors, and their quartiles and recall over many problems, as functions and as torchmetrics metrics.

Conventions: camera = R p + t. Angles are in degrees, lengths in scene units; everything is computed in float64.

A problem without a pose (NaN or infinity in the estimate) has errors of 180 degrees and infinity. It counts as the
worst pose and is never left out. A problem with a pose but without a true match has no reprojection error (NaN). The
statistics of that error leave it out; it is counted as "without_matches".
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

from bpnp.geometry import angle_between, bearings, camera_centre, is_finite, rotation_angle, transform
from bpnp.types import Batch, Pose, Prediction


@dataclass(frozen=True)
class PoseErrors:
    """Errors of one estimate for b problems, float64."""

    rotation_deg: Float[Tensor, " b"]  # `rotation_error`, degrees
    translation: Float[Tensor, " b"]  # `translation_error`, scene units
    centre: Float[Tensor, " b"]  # `centre_error`, scene units
    reprojection_deg: Float[Tensor, " b"]  # `reprojection_error`, degrees
    index: Int[Tensor, " b"] | None = None  # `Batch.index` of the problems, None if they have none


def rotation_error(rotation: Float[Tensor, "b 3 3"], rotation_gt: Float[Tensor, "b 3 3"]) -> Float[Tensor, " b"]:
    """Return the angle of R^T R_gt (paper Eq. 13).

    Args:
        rotation: Estimated R (b, 3, 3).
        rotation_gt: True R (b, 3, 3).

    Returns:
        Angles (b,) in [0, 180], degrees, float64; 180 where R is not finite.

    >>> import torch
    >>> from bpnp.metrics import rotation_error
    >>> quarter_turn = torch.tensor([[[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]])
    >>> float(rotation_error(quarter_turn, torch.eye(3)[None]))
    90.0
    """
    error = torch.rad2deg(rotation_angle(rotation.double(), rotation_gt.double()))
    return error.where(rotation.isfinite().all((-2, -1)), 180.0)


def translation_error(translation: Float[Tensor, "b 3"], translation_gt: Float[Tensor, "b 3"]) -> Float[Tensor, " b"]:
    """Return the distance |t - t_gt| (paper Eq. 14).

    Args:
        translation: Estimated t (b, 3), scene units.
        translation_gt: True t (b, 3), scene units.

    Returns:
        Distances (b,), scene units, float64; infinity where t is not finite.

    >>> import torch
    >>> from bpnp.metrics import translation_error
    >>> float(translation_error(torch.tensor([[3.0, 4.0, 1.0]]), torch.tensor([[0.0, 0.0, 1.0]])))
    5.0
    """
    error = torch.linalg.vector_norm(translation.double() - translation_gt.double(), dim=-1)
    return error.where(translation.isfinite().all(-1), math.inf)


def centre_error(
    rotation: Float[Tensor, "b 3 3"],
    translation: Float[Tensor, "b 3"],
    rotation_gt: Float[Tensor, "b 3 3"],
    translation_gt: Float[Tensor, "b 3"],
) -> Float[Tensor, " b"]:
    """Return the distance of the camera centres, |R^T t - R_gt^T t_gt|, scene units; infinite if a pose is not finite.

    Unlike |t - t_gt|, it does not depend on the origin of the scene.
    """
    centre = camera_centre(rotation.double(), translation.double())
    error = torch.linalg.vector_norm(centre - camera_centre(rotation_gt.double(), translation_gt.double()), dim=-1)
    return error.where(is_finite(rotation, translation), math.inf)


def reprojection_error(
    rotation: Float[Tensor, "b 3 3"],
    translation: Float[Tensor, "b 3"],
    points2d: Float[Tensor, "b m 2"],
    points3d: Float[Tensor, "b n 3"],
    match3d: Int[Tensor, "b n"],
) -> Float[Tensor, " b"]:
    """Return the mean angle between the bearings and the projected points of the true matches.

    Paper Eq. 2 divides the sum over the true matches by m n. Here it is divided by their number, so that the result is
    an angle and does not depend on the sizes of the sets. A point at the camera centre counts as 180 degrees.

    Args:
        rotation: Estimated R (b, 3, 3).
        translation: Estimated t (b, 3), scene units.
        points2d: Normalised image coordinates (b, m, 2).
        points3d: Scene points (b, n, 3), scene units.
        match3d: Index of the true 2D point of each 3D point (b, n), -1 for none.

    Returns:
        Angles (b,), degrees, float64; 180 for a sample without a pose, else NaN for one without a true match.
    """
    true = match3d >= 0
    observed = points2d.double().gather(1, match3d.clamp(min=0).unsqueeze(-1).expand(-1, -1, 2))
    points = transform(rotation.double(), translation.double(), points3d.double())
    angle = angle_between(bearings(observed), points).where((points != 0).any(-1), math.pi)
    mean = torch.rad2deg(angle.where(true, 0.0).sum(-1) / true.sum(-1))
    return mean.where(is_finite(rotation, translation), 180.0)


def pose_errors(pose: Pose, batch: Batch) -> PoseErrors:
    """Return all four errors of a pose against the true pose of the batch.

    `reprojection_deg` is NaN if the batch has no `match3d`. Raise ValueError if it has no true pose, or one that is not
    finite.
    """
    if batch.rotation is None or batch.translation is None:
        raise ValueError("the batch has no true `rotation` and `translation`, which pose errors need")
    finite = is_finite(batch.rotation, batch.translation)
    if not bool(finite.all()):
        raise ValueError(f"the true pose of {batch.ids[int(finite.int().argmin())]} holds NaN or infinity")
    rotation = pose.rotation.where(pose.found[:, None, None], math.nan)
    translation = pose.translation.where(pose.found[:, None], math.nan)
    reprojection = torch.full_like(translation[:, 0], math.nan, dtype=torch.float64)
    if batch.match3d is not None:
        reprojection = reprojection_error(rotation, translation, batch.points2d, batch.points3d, batch.match3d)
    return PoseErrors(
        rotation_deg=rotation_error(rotation, batch.rotation),
        translation=translation_error(translation, batch.translation),
        centre=centre_error(rotation, translation, batch.rotation, batch.translation),
        reprojection_deg=reprojection,
        index=batch.index,
    )


def prediction_errors(prediction: Prediction, batch: Batch) -> dict[str, PoseErrors]:
    """Return the `pose_errors` of each estimate of a prediction, by its name."""
    return {name: pose_errors(pose, batch) for name, pose in prediction.poses.items()}


Limits = Sequence[float | int]
NO_PROBLEM = "there are no problems to compute a metric of; call update() before compute()"


@dataclass(frozen=True)
class RecallThresholds:
    """Largest errors of a pose that counts as correct.

    Args:
        rotation_deg: Rotation errors, degrees.
        translation: Translation errors, scene units.
        centre: Errors of the camera centre, scene units.
        reprojection_deg: Reprojection errors, degrees.
        joint: Pairs (rotation error in degrees, translation error in scene units); both have to hold.

    Raises:
        ValueError: A threshold is negative or not finite.
    """

    rotation_deg: Limits = (1.0, 2.0, 5.0, 10.0, 15.0, 20.0)
    translation: Limits = (0.05, 0.1, 0.2, 0.5, 1.0)
    centre: Limits = (0.05, 0.1, 0.2, 0.5, 1.0)
    reprojection_deg: Limits = (0.25, 0.5, 1.0, 2.0)
    joint: Sequence[tuple[float | int, float | int]] = ((15.0, 0.5), (10.0, 1.0))

    def __post_init__(self) -> None:
        thresholds = (self.rotation_deg, self.translation, self.centre, self.reprojection_deg, *self.joint)
        if not all(0 <= limit < math.inf for limits in thresholds for limit in limits):
            raise ValueError(f"the thresholds of {self} must be finite, and 0 or more")


def pose_quartiles(errors: PoseErrors) -> dict[str, Tensor]:
    """Return the three quartiles of each error of at least one problem as float64 scalars, and two counts.

    The names are "rotation_q1_deg", "translation_q2", "centre_q3", "reprojection_q1_deg" and so on, where q2 is the
    median; "found", the fraction of problems with a pose; "without_matches", the number of problems without a
    reprojection error. Quartiles of the reprojection error leave these problems out, and are absent if no problem has
    that error.

    Quartiles interpolate linearly between order statistics (numpy's default). A quartile next to an infinite error is
    infinite.
    """
    values: dict[str, Tensor] = {}
    for name, unit, error in known_errors(errors):
        ordered = error.sort().values
        for number in (1, 2, 3):
            position = number / 4 * (len(ordered) - 1)
            below, above = ordered[math.floor(position)], ordered[math.ceil(position)]
            # Interpolation between two infinities would give NaN.
            value = torch.lerp(below, above, position % 1).where(above.isfinite(), above)
            values[f"{name}_q{number}_{unit}".rstrip("_")] = value
    values["found"] = errors.translation.isfinite().double().mean()
    values["without_matches"] = errors.reprojection_deg.isnan().double().sum()
    return values


def pose_recalls(errors: PoseErrors, thresholds: RecallThresholds | None = None) -> dict[str, Tensor]:
    """Return the fraction of at least one problem with an error up to each threshold, float64 scalars in [0, 1].

    The names are "recall_rotation_5deg", "recall_translation_0.5", "recall_centre_0.5", "recall_reprojection_1deg" and
    so on, and "recall_joint_15deg_0.5" for rotation and translation together. Fractions of the reprojection error are
    of the problems that have one, and are absent if none has.
    """
    thresholds = thresholds or RecallThresholds()
    values: dict[str, Tensor] = {}
    for name, unit, error in known_errors(errors):
        limits = getattr(thresholds, f"{name}_{unit}".rstrip("_"))
        keys = [f"recall_{name}_{limit:g}{unit}" for limit in limits]
        values |= zip(keys, recall_at(error, limits), strict=True)
    for degrees, length in thresholds.joint:
        (values[f"recall_joint_{degrees:g}deg_{length:g}"],) = recall_at(joint_error(errors, length), [degrees])
    return values


def recall_at(error: Float[Tensor, " b"], limits: Limits) -> Float[Tensor, " k"]:
    """Return the fraction of errors up to each limit, float64.

    >>> import torch
    >>> from bpnp.metrics import recall_at
    >>> recall_at(torch.tensor([1.0, 3.0, 3.0, 9.0]), [1, 3, 4]).tolist()
    [0.25, 0.75, 0.75]
    """
    ordered = error.double().sort().values
    most = torch.as_tensor(limits, dtype=torch.float64, device=error.device)
    return torch.searchsorted(ordered, most, right=True).double() / max(len(ordered), 1)


def joint_error(errors: PoseErrors, translation: float | int) -> Float[Tensor, " b"]:
    """Return the rotation errors in degrees, infinite where the translation error exceeds a limit in scene units."""
    return errors.rotation_deg.where(errors.translation <= translation, math.inf)


def known_errors(errors: PoseErrors) -> Iterator[tuple[str, str, Tensor]]:
    """Yield the name, the unit and the finite or infinite values of each error that at least one problem has.

    Raise ValueError if there are no problems, or an error other than the reprojection error is NaN.
    """
    if len(errors.rotation_deg) == 0:
        raise ValueError(NO_PROBLEM)
    for name, unit in (("rotation", "deg"), ("translation", ""), ("centre", ""), ("reprojection", "deg")):
        error: Tensor = getattr(errors, f"{name}_{unit}".rstrip("_"))
        values = error[~error.isnan()].double()
        if len(values) < len(error) and name != "reprojection":
            raise ValueError(f"a {name} error is NaN; a problem without a pose has 180 deg or infinity")
        if len(values):
            yield name, unit, values


class ProblemMetric(Metric):
    """Base of metrics that keep `width` numbers of every problem, over batches and processes.

    A problem is counted once, by its index.
    """

    full_state_update = False
    is_differentiable = False
    width: int
    records: list[Tensor]

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.add_state("records", default=[], dist_reduce_fx="cat")

    def sync(self, *args: Any, **kwargs: Any) -> None:
        """Exchange the records; a process without a batch joins with no rows of the right type and width."""
        if len(self.records) == 0:
            self.records.append(torch.empty(0, self.width + 1, dtype=torch.float64, device=self.device))
        super().sync(*args, **kwargs)

    def _append(self, *columns: Tensor, index: Tensor | None) -> None:
        """Add rows; rows without an index are all counted."""
        index = torch.full_like(columns[0], math.nan) if index is None else index
        self.records.append(torch.stack([column.detach().double() for column in (*columns, index)], -1))

    def _columns(self) -> tuple[Tensor, ...]:
        """Return the columns so far, with the first row of each problem."""
        records = dim_zero_cat(self.records)
        if len(records) == 0:
            raise ValueError(NO_PROBLEM)
        values, index = records[:, :-1], records[:, -1]
        order = torch.argsort(index, stable=True)
        repeated = index[order].diff() == 0  # never True for NaN, which stands for no index
        first, repeat = order[:-1][repeated], order[1:][repeated]
        if not torch.isclose(values[first], values[repeat], rtol=1e-3, atol=1e-3, equal_nan=True).all():
            message = "problems with the same `Batch.index` have different values; only the first one is counted"
            warnings.warn(f"{message}. Use one metric per data set, and one index per problem", stacklevel=2)
        keep = torch.ones_like(index, dtype=torch.bool)
        keep[repeat] = False
        return values[keep].unbind(-1)


class MeanOverProblems(ProblemMetric):
    """Mean of one value per problem, over batches and processes.

    A problem is counted once, by its `Batch.index`.

    Args:
        **kwargs: Options of `torchmetrics.Metric`.

    >>> import torch
    >>> from bpnp.metrics import MeanOverProblems
    >>> mean = MeanOverProblems()
    >>> mean.update(torch.tensor([1.0, 2.0, 6.0]), torch.tensor([0, 1, 2]))
    >>> mean.update(torch.tensor([6.0]), torch.tensor([2]))
    >>> float(mean.compute())
    3.0
    """

    higher_is_better = False
    width = 1

    def update(self, values: Float[Tensor, " b"], index: Int[Tensor, " b"]) -> None:
        """Add one value per problem of a batch; `index` is its `Batch.index`."""
        self._append(values, index=index)

    def compute(self) -> Float[Tensor, ""]:
        """Return the mean."""
        return self._columns()[0].mean()


class PoseMetric(ProblemMetric):
    """Base of metrics of the four errors of every problem's pose."""

    width = 4

    def update(self, errors: PoseErrors) -> None:
        """Add the errors of a batch.

        Args:
            errors: Errors; all of them are counted if their `index` is None.
        """
        self._append(
            errors.rotation_deg, errors.translation, errors.centre, errors.reprojection_deg, index=errors.index
        )

    def errors(self) -> PoseErrors:
        """Return the errors so far, each problem once."""
        return PoseErrors(*self._columns())


class PoseQuartiles(PoseMetric):
    """`pose_quartiles` over all problems, as a metric.

    Args:
        **kwargs: Options of `torchmetrics.Metric`.

    >>> import torch
    >>> from bpnp.metrics import PoseErrors, PoseQuartiles
    >>> metric = PoseQuartiles()
    >>> metric.update(PoseErrors(*torch.tensor([[1.0, 3.0, 5.0], [0.1, 0.2, 0.3], [0.1, 0.2, 0.3], [0.2, 0.2, 0.4]])))
    >>> float(metric.compute()["rotation_q1_deg"])
    2.0
    """

    higher_is_better = False

    def compute(self) -> dict[str, Tensor]:
        """Return the quartiles by name, as `pose_quartiles` does."""
        return pose_quartiles(self.errors())


class PoseRecall(PoseMetric):
    """`pose_recalls` over all problems, as a metric.

    Args:
        thresholds: Largest errors of a correct pose. Default: `RecallThresholds()`.
        **kwargs: Options of `torchmetrics.Metric`.

    >>> import torch
    >>> from bpnp.metrics import PoseErrors, PoseRecall, RecallThresholds
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
        """Return the recalls by name, as `pose_recalls` does."""
        return pose_recalls(self.errors(), self.thresholds)
