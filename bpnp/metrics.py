"""Errors of poses, and their quartiles and recalls over many problems, as functions and as torchmetrics' metrics.

Conventions: camera = R p + t. Angles are in degrees, lengths in scene units; everything is computed in float64.
A problem without a pose (NaN or infinity in the estimate) has errors of 180 deg and infinity: it counts as the worst
pose and is right at no threshold, it is never left out. A problem with a pose but without a true match has no
reprojection error (NaN): it is left out of what is said of that error, and counted as "without_matches".
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
    """Errors of one estimate for b problems, float64; see the functions below. `index` is their `Batch.index`."""

    rotation_deg: Float[Tensor, " b"]
    translation: Float[Tensor, " b"]
    centre: Float[Tensor, " b"]
    reprojection_deg: Float[Tensor, " b"]
    index: Int[Tensor, " b"] | None = None


def rotation_error(rotation: Float[Tensor, "b 3 3"], rotation_gt: Float[Tensor, "b 3 3"]) -> Float[Tensor, " b"]:
    """Angle of R^T R_gt in degrees, in [0, 180] (paper Eq. 13), by atan2; 180 where R is not finite.

    >>> quarter_turn = torch.tensor([[[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]])
    >>> float(rotation_error(quarter_turn, torch.eye(3)[None]))
    90.0
    """
    error = torch.rad2deg(rotation_angle(rotation.double(), rotation_gt.double()))
    return error.where(rotation.isfinite().all((-2, -1)), 180.0)


def translation_error(translation: Float[Tensor, "b 3"], translation_gt: Float[Tensor, "b 3"]) -> Float[Tensor, " b"]:
    """|t - t_gt| in scene units (paper Eq. 14); infinite where t is not finite.

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
    """Distance |R^T t - R_gt^T t_gt| of the camera centres in scene units; infinite where the pose is not finite.

    Unlike |t - t_gt| it does not depend on where the scene's origin is.
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
    """Mean angle in degrees between f_i and R p_j + t over the true matches i = match3d[j] >= 0.

    Paper Eq. 2 divides the sum over the true matches by m n; here it is divided by their number, so that it is an angle
    and does not depend on the sizes of the sets. A point at the camera centre counts as 180. A sample without a pose
    is 180; else a sample without a true match is NaN.
    """
    true = match3d >= 0
    seen = points2d.double().gather(1, match3d.clamp(min=0).unsqueeze(-1).expand(-1, -1, 2))
    points = transform(rotation.double(), translation.double(), points3d.double())
    angle = angle_between(bearings(seen), points).where((points != 0).any(-1), math.pi)
    mean = torch.rad2deg(angle.where(true, 0.0).sum(-1) / true.sum(-1))
    return mean.where(is_finite(rotation, translation), 180.0)


def pose_errors(pose: Pose, batch: Batch) -> PoseErrors:
    """All four errors against the batch's true pose. `reprojection_deg` is NaN if the batch has no `match3d`.

    Raises ValueError if the true pose is absent or not finite.
    """
    if batch.rotation is None or batch.translation is None:
        raise ValueError("expected a batch with its true `rotation` and `translation`, got None; try Batch.from_arrays")
    known = is_finite(batch.rotation, batch.translation)
    if not bool(known.all()):
        raise ValueError(f"expected a finite true pose, got NaN or infinity in {batch.ids[int(known.int().argmin())]}")
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
    """Return the `pose_errors` of each estimate of a prediction."""
    return {name: pose_errors(pose, batch) for name, pose in prediction.poses.items()}


Limits = Sequence[float | int]
NO_PROBLEM = "expected at least one problem, got none; try update() before compute()"


@dataclass(frozen=True)
class RecallThresholds:
    """Errors up to which a pose counts as right; `joint` holds limits (rotation in deg, translation)."""

    rotation_deg: Limits = (1.0, 2.0, 5.0, 10.0, 15.0, 20.0)
    translation: Limits = (0.05, 0.1, 0.2, 0.5, 1.0)
    centre: Limits = (0.05, 0.1, 0.2, 0.5, 1.0)
    reprojection_deg: Limits = (0.25, 0.5, 1.0, 2.0)
    joint: Sequence[tuple[float | int, float | int]] = ((15.0, 0.5), (10.0, 1.0))

    def __post_init__(self) -> None:
        given = (self.rotation_deg, self.translation, self.centre, self.reprojection_deg, *self.joint)
        if not all(0 <= limit < math.inf for limits in given for limit in limits):
            raise ValueError(f"expected finite thresholds >= 0, got {self}")


def pose_quartiles(errors: PoseErrors) -> dict[str, Tensor]:
    """First, second (median) and third quartile of each error, as float64 scalars.

    Keys: "rotation_q1_deg", "translation_q2", "centre_q3", "reprojection_q1_deg" and so on; "found", the share of
    problems with a pose; "without_matches", the number of those without a reprojection error. Linear
    interpolation between order statistics (numpy's default); a quartile that leans on an infinite neighbour is
    infinite. The reprojection quartiles are absent if no problem has that error. Raises ValueError if there is no
    problem.
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
    values["without_matches"] = errors.reprojection_deg.isnan().double().sum()
    return values


def pose_recalls(errors: PoseErrors, thresholds: RecallThresholds | None = None) -> dict[str, Tensor]:
    """Share of problems in [0, 1] with error <= threshold, for every threshold, as float64 scalars.

    Keys: "recall_rotation_5deg", "recall_translation_0.5", "recall_centre_0.5", "recall_reprojection_1deg", and
    "recall_joint_15deg_0.5" for rotation and translation both. Raises ValueError if there is no problem.
    """
    thresholds = thresholds or RecallThresholds()
    values: dict[str, Tensor] = {}
    for name, unit, error in known_errors(errors):
        limits = getattr(thresholds, f"{name}_{unit}".rstrip("_"))
        keys = [f"recall_{name}_{limit:g}{unit}" for limit in limits]
        values |= zip(keys, recall_curve(error, limits), strict=True)
    for degrees, length in thresholds.joint:
        (values[f"recall_joint_{degrees:g}deg_{length:g}"],) = recall_curve(joint_error(errors, length), [degrees])
    return values


def recall_curve(error: Float[Tensor, " b"], limits: Limits) -> Float[Tensor, " k"]:
    """Share of errors up to each limit, float64.

    >>> recall_curve(torch.tensor([1.0, 3.0, 3.0, 9.0]), [1, 3, 4]).tolist()
    [0.25, 0.75, 0.75]
    """
    ordered = error.double().sort().values
    most = torch.as_tensor(limits, dtype=torch.float64, device=error.device)
    return torch.searchsorted(ordered, most, right=True).double() / max(len(ordered), 1)


def joint_error(errors: PoseErrors, translation: float | int) -> Float[Tensor, " b"]:
    """Rotation errors in degrees, infinite for a pose with more than this translation error."""
    return errors.rotation_deg.where(errors.translation <= translation, math.inf)


def known_errors(errors: PoseErrors) -> Iterator[tuple[str, str, Tensor]]:
    """Name, unit and values of each error that at least one problem has."""
    if len(errors.rotation_deg) == 0:
        raise ValueError(NO_PROBLEM)
    for name, unit in (("rotation", "deg"), ("translation", ""), ("centre", ""), ("reprojection", "deg")):
        error: Tensor = getattr(errors, f"{name}_{unit}".rstrip("_"))
        known = error[~error.isnan()].double()
        if len(known) < len(error) and name != "reprojection":
            raise ValueError(f"expected a {name} error for each problem, got NaN; one without a pose is 180 deg or inf")
        if len(known):
            yield name, unit, known


class ProblemMetric(Metric):
    """Numbers of every problem, `width` of them, over batches and processes; each problem once, by its index."""

    full_state_update = False
    is_differentiable = False
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
        """The columns so far, with the first occurrence of each problem."""
        records = dim_zero_cat(self.records)
        if len(records) == 0:
            raise ValueError(NO_PROBLEM)
        values, index = records[:, :-1], records[:, -1]
        order = torch.argsort(index, stable=True)
        again = index[order].diff() == 0  # never true of NaN, the index of problems that have none
        first, repeat = order[:-1][again], order[1:][again]
        if not torch.isclose(values[first], values[repeat], rtol=1e-3, atol=1e-3, equal_nan=True).all():
            message = "expected one problem per `Batch.index`, got one index with several values; the first is counted"
            warnings.warn(f"{message}; try a metric per data set, and an index for each of its problems", stacklevel=2)
        keep = torch.ones_like(index, dtype=torch.bool)
        keep[repeat] = False
        return values[keep].unbind(-1)


class MeanOverProblems(ProblemMetric):
    """Mean of one value per problem over batches and processes, each problem counted once by its `Batch.index`.

    >>> mean = MeanOverProblems()
    >>> mean.update(torch.tensor([1.0, 2.0, 6.0]), torch.tensor([0, 1, 2]))
    >>> mean.update(torch.tensor([6.0]), torch.tensor([2]))
    >>> float(mean.compute())
    3.0
    """

    higher_is_better = False
    width = 1

    def update(self, values: Float[Tensor, " b"], index: Int[Tensor, " b"]) -> None:
        self._append(values, index=index)

    def compute(self) -> Float[Tensor, ""]:
        return self._columns()[0].mean()


class PoseMetric(ProblemMetric):
    """The four errors of every problem's pose."""

    width = 4

    def update(self, errors: PoseErrors) -> None:
        """Add the errors of a batch; all of them are counted if their index is None."""
        self._append(
            errors.rotation_deg, errors.translation, errors.centre, errors.reprojection_deg, index=errors.index
        )

    def errors(self) -> PoseErrors:
        """The errors so far, each problem once."""
        return PoseErrors(*self._columns())


class PoseQuartiles(PoseMetric):
    """`pose_quartiles` over all problems.

    >>> metric = PoseQuartiles()
    >>> metric.update(PoseErrors(*torch.tensor([[1.0, 3.0, 5.0], [0.1, 0.2, 0.3], [0.1, 0.2, 0.3], [0.2, 0.2, 0.4]])))
    >>> float(metric.compute()["rotation_q1_deg"])
    2.0
    """

    higher_is_better = False

    def compute(self) -> dict[str, Tensor]:
        return pose_quartiles(self.errors())


class PoseRecall(PoseMetric):
    """`pose_recalls` over all problems.

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
