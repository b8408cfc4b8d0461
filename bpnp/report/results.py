"""What a test found: one row per pair and estimate, why estimates are wrong, and the aggregates of the rows.

Angles in degrees, lengths in scene units, as in `bpnp.metrics`. `bpnp.report.folder` keeps results on disk.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import torch
from scipy.spatial import cKDTree

from bpnp.geometry import project, transform
from bpnp.metrics import PoseErrors, RecallThresholds, pose_errors, pose_quartiles, pose_recalls
from bpnp.types import Batch, Pose, Prediction

if TYPE_CHECKING:
    from pandas import DataFrame

PIPELINE = ("ransac", "pnp", "refined")  # estimates are listed in this order, others after them
SOLVED_DEG = 5.0  # largest rotation error of a solved pair
PLAUSIBLE_INLIERS = 0.5  # share of the 2D points from which a wrong pose counts as fitting the image
CAUSES = ("solved", "no pose", "wrong, not converged", "wrong, but fits the image", "wrong")


@dataclass(frozen=True)
class PairRow:
    """One estimate of one pair.

    index, id: the pair in its data set. Errors: see `bpnp.metrics`. inliers: see `count_inliers`. m, n: 2D and 3D
    points. true_pairs: 3D points with a known match. iterations, residual, converged: the solver's `SolveStats`.
    found: whether there is a pose. seconds: share of the time that the pair's batch took.
    """

    index: int
    id: str
    estimate: str
    rotation_error_deg: float
    translation_error: float
    centre_error: float
    reprojection_error_deg: float
    inliers: int
    m: int
    n: int
    true_pairs: int
    iterations: int
    residual: float
    converged: bool
    found: bool
    seconds: float

    @property
    def cause(self) -> str:
        """One of `CAUSES`: the first of these that holds.

        - "no pose": the solver gave none;
        - "solved": rotation error up to `SOLVED_DEG` degrees, whether the solver reports convergence or not;
        - "wrong, not converged": the solver itself reports that it did not converge;
        - "wrong, but fits the image": `PLAUSIBLE_INLIERS` of the 2D points have a reprojected 3D point beside them:
          another minimum, or a symmetric scene, that the solver cannot tell from the true pose;
        - "wrong": none of these.
        """
        if not self.found:
            return "no pose"
        if self.rotation_error_deg <= SOLVED_DEG:
            return "solved"
        if not self.converged:
            return "wrong, not converged"
        return "wrong, but fits the image" if self.inliers >= PLAUSIBLE_INLIERS * self.m else "wrong"


@dataclass(frozen=True)
class Results:
    """The rows of a test and, by estimate, what `summarise` makes of them; `settings` is what the caller recorded."""

    rows: tuple[PairRow, ...]
    estimates: dict[str, dict[str, float]]
    correspondence_loss: float | None
    settings: dict[str, Any]
    bpnp_version: str
    written: str

    def of(self, estimate: str) -> list[PairRow]:
        """The rows of one estimate, in the order of the data set."""
        return [row for row in self.rows if row.estimate == estimate]

    def errors(self, estimate: str) -> PoseErrors:
        """Errors of one estimate in the order of the rows."""
        return _errors(self.of(estimate))

    @property
    def pairs(self) -> int:
        """Number of pairs."""
        return len({row.index for row in self.rows})

    def frame(self) -> "DataFrame":
        """The rows as a DataFrame for notebooks: the columns of `PairRow`, and "cause".

        `read_results("runs/quickstart/test").frame().groupby("estimate").rotation_error_deg.median()`
        """
        from pandas import DataFrame

        return DataFrame([asdict(row) | {"cause": row.cause} for row in self.rows])


def rows_from(prediction: Prediction, batch: Batch, seconds: float, *, inlier_threshold: float = 0.01) -> list[PairRow]:
    """One row per pair and estimate. `seconds` is the time of the whole batch; each pair is given an equal share.

    `inlier_threshold` in normalised image units, see `count_inliers`. Raises ValueError if the batch has no true pose.
    """
    true_pairs = torch.zeros_like(batch.index) if batch.match3d is None else (batch.match3d >= 0).sum(-1)
    sizes = torch.stack([batch.count2d, batch.count3d, true_pairs], -1).tolist()
    indices = batch.index.tolist()
    rows = []
    for estimate, pose in prediction.poses.items():
        errors = pose_errors(pose, batch)
        columns = (errors.rotation_deg, errors.translation, errors.centre, errors.reprojection_deg)
        numbers = torch.stack([*columns, pose.stats.residual.double()], -1).tolist()
        iterations, converged, found = (v.tolist() for v in (pose.stats.iterations, pose.stats.converged, pose.found))
        inliers = count_inliers(pose, batch, threshold=inlier_threshold)
        for i, (m, n, pairs) in enumerate(sizes):
            rotation, translation, centre, reprojection, residual = numbers[i]
            rows.append(
                PairRow(
                    indices[i], batch.ids[i], estimate, rotation, translation, centre, reprojection, inliers[i], m, n,
                    pairs, iterations[i], residual, converged[i], found[i], seconds / len(batch),
                )
            )  # fmt: skip
    return rows


def count_inliers(pose: Pose, batch: Batch, *, threshold: float = 0.01) -> list[int]:
    """2D points of each pair with a projected 3D point nearer than `threshold` (normalised image units).

    Needs no true match: it is what a user of the pose can check. Points behind the camera do not count; without a pose
    there is no inlier.
    """
    camera = transform(pose.rotation.double(), pose.translation.double(), batch.points3d.double())
    projected = project(camera)
    visible = batch.mask3d & (camera[..., 2] > 0) & projected.isfinite().all(-1)
    counts = []
    for i in range(len(batch)):
        shown, seen = projected[i, visible[i]].cpu().numpy(), batch.points2d[i, batch.mask2d[i]].cpu().numpy()
        # An empty tree answers infinity.
        distance, _ = cKDTree(shown).query(seen, distance_upper_bound=threshold)
        counts.append(int((distance < math.inf).sum()))
    return counts


def cause_shares(rows: Iterable[PairRow]) -> dict[str, float]:
    """Share of the rows with each cause, in the order of `CAUSES`; they sum to one.

    Raises ValueError if there is no row.
    """
    found = [row.cause for row in rows]
    if not found:
        raise ValueError("expected at least one row, got none")
    return {cause: found.count(cause) / len(found) for cause in CAUSES}


def summarise(rows: Sequence[PairRow], *, thresholds: RecallThresholds | None = None) -> dict[str, dict[str, float]]:
    """By estimate: `quartiles` and `recalls` of its rows, the share that converged and the mean seconds per pair."""
    summary = {}
    for estimate in sorted({row.estimate for row in rows}, key=pipeline_order):
        chosen = [row for row in rows if row.estimate == estimate]
        errors = _errors(chosen)
        values = {
            key: float(value) for key, value in (pose_quartiles(errors) | pose_recalls(errors, thresholds)).items()
        }
        values["converged"] = sum(row.converged for row in chosen) / len(chosen)
        values["seconds_mean"] = math.fsum(row.seconds for row in chosen) / len(chosen)
        summary[estimate] = values
    return summary


def pipeline_order(estimate: str) -> tuple[int, str]:
    """Sorts estimates by the step of the pipeline that makes them."""
    return PIPELINE.index(estimate) if estimate in PIPELINE else len(PIPELINE), estimate


def _errors(rows: Iterable[PairRow]) -> PoseErrors:
    columns = [
        (row.rotation_error_deg, row.translation_error, row.centre_error, row.reprojection_error_deg) for row in rows
    ]
    return PoseErrors(*torch.tensor(columns, dtype=torch.float64).reshape(-1, 4).unbind(-1))
