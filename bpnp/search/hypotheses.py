"""Poses that any source has proposed, one record with a column per quantity, and how equal ones are merged.

The hypotheses of minimal problems that the enumeration tests are in `bpnp.search.few_points.hypotheses`.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bpnp.poses import close_poses, distinct
from bpnp.search.search_frame import SearchFrame

SIGNIFICANT = 1e3  # more than any log-likelihood per bearing [nats; derived]
KEPT_CANDIDATES = 8  # number of candidates that a search keeps from one iteration to the next [poses; cost]
SAME_DEG = 3.0  # angle below which two poses can be the same, degrees [degrees; convention]
# Shift below which they can be, in extents of the scene; both conditions are necessary.
SAME_SHIFT = 0.05  # [extents of the scene; convention]


@dataclass(frozen=True, eq=False)
class Hypotheses:
    """Poses of one problem, camera = R p + t, one per row, with the measures of how well they explain its points.

    A stage fills the columns that it computes; the others have the values of `from_poses`.
    """

    rotation: NDArray[Any]  # (c, 3, 3). Float32 in the frame of a `SearchFrame`, float64 in that of a `Problem`
    translation: NDArray[Any]  # (c, 3), in the same frame; (c, 4) homogeneous for a rig
    log_likelihood: NDArray[Any]  # (c,) mean over the bearings, nats; -inf for a pose that was not scored
    match_count: NDArray[Any]  # (c,) expected number of matches
    # (c,) standard deviation of the residuals per axis, radians, at which the two previous columns are computed.
    scale: NDArray[Any]
    basin_count: NDArray[np.int64]  # (c,) number of independent starts that ended at this pose
    # (c,) log10 NFA at the scale of the residuals (`bpnp.search.verdict.false_alarms`); NaN before it is computed.
    log10_false_alarms: NDArray[np.float64]
    log10_rough: NDArray[np.float64]  # (c,) log10 NFA at scales far beyond those of the residuals; NaN likewise
    # (c,) of a proposer, nats by which the matches exceed chance; None where it computes none.
    evidence: NDArray[np.float64] | None = None
    # (c, m) index of the scene point of each image point, -1 for none; None where no matches are fixed.
    matches: NDArray[np.int64] | None = None
    residual: NDArray[np.float64] | None = None  # (c, m) angle of each match, radians, infinite for none; None likewise

    @classmethod
    def from_poses(
        cls, rotation: NDArray[Any], translation: NDArray[Any], *, basin_count: int | NDArray[Any] = 0, **columns: Any
    ) -> "Hypotheses":
        """Return hypotheses with these poses (c, 3, 3), (c, 3), one basin count or (c,), and other columns by name."""
        c = len(rotation)
        none, zero, unknown = np.full(c, -math.inf, np.float32), np.zeros(c, np.float32), np.full(c, math.nan)
        poses = cls(rotation, translation, none, zero, zero, np.full(c, basin_count, np.int64), unknown, unknown)
        return replace(poses, **columns) if columns else poses

    @classmethod
    def empty(cls, numbers: int = 3, dtype: type[np.floating[Any]] = np.float64) -> "Hypotheses":
        """Return a record without hypotheses; translations have `numbers` coordinates."""
        return cls.from_poses(np.empty((0, 3, 3), dtype), np.empty((0, numbers), dtype))

    @property
    def sort_key(self) -> NDArray[np.float64]:
        """(c,) sort key, largest for the best: the NFA of significant poses, else the log-likelihood."""
        is_significant = self.log10_false_alarms < 0  # not NaN
        return np.where(is_significant, SIGNIFICANT - self.log10_false_alarms, self.log_likelihood)

    def as_dependent(self) -> "Hypotheses":
        """Return a copy with all basin counts set to 0, for starts that were not independent."""
        return replace(self, basin_count=np.zeros_like(self.basin_count))

    def unweighed(self) -> "Hypotheses":
        """Return a copy without NFA, so that it is computed again."""
        unknown = np.full(len(self), math.nan)
        return replace(self, log10_false_alarms=unknown, log10_rough=unknown)

    def pose(self, k: int = 0) -> tuple[NDArray[Any], NDArray[Any]]:
        """Return rotation (3, 3) and translation (3,) of hypothesis k, default the first."""
        return self.rotation[k], self.translation[k]

    def __len__(self) -> int:
        return len(self.rotation)

    def __getitem__(self, chosen: slice | NDArray[Any]) -> "Hypotheses":
        rows: dict[str, Any] = {}
        for name, column in self._columns().items():
            rows[name] = None if column is None else column[chosen]
        return replace(self, **rows)

    @classmethod
    def concatenate(cls, parts: "Sequence[Hypotheses]") -> "Hypotheses":
        """Return all hypotheses of the parts, one part after the other; columns that one of them lacks are None."""
        columns: dict[str, Any] = {}
        for name in parts[0]._columns():
            column = [getattr(part, name) for part in parts]
            columns[name] = None if any(each is None for each in column) else np.concatenate(column)
        return replace(parts[0], **columns)

    def _columns(self) -> dict[str, Any]:
        return {field.name: getattr(self, field.name) for field in fields(self)}


def select_distinct(poses: Hypotheses, scene: SearchFrame, count: int, apart_deg: float | None = None) -> Hypotheses:
    """Return the best hypotheses of a scene, at most `count`, best first, no two of them equal.

    They have the basin counts of all poses equal to them. Poses are equal within `SAME_DEG` and `SAME_SHIFT`, or if
    their rotations are within `apart_deg` degrees.
    """
    limits = (SAME_DEG, SAME_SHIFT) if apart_deg is None else (apart_deg, math.inf)
    compared = poses.rotation, poses.translation * scene.shift_weight
    kept = distinct(*compared, poses.sort_key, count, *limits)
    if not len(kept):
        return poses[kept]
    same = close_poses(*compared, kept, *limits)
    first = same & (np.cumsum(same, 0) == 1)  # a pose near two counts for the better one
    return replace(poses[kept], basin_count=first @ poses.basin_count)


def merge_hypotheses(parts: Sequence[Hypotheses], scene: SearchFrame) -> Hypotheses:
    """Return the best distinct hypotheses of several batches, with the basin counts of all batches."""
    return select_distinct(Hypotheses.concatenate(parts), scene, KEPT_CANDIDATES)


def to_problem_frame(poses: Hypotheses, scene: SearchFrame) -> Hypotheses:
    """Return hypotheses in the frame of the problem of their `SearchFrame`, in float64."""
    rotation, translation = scene.leave(poses.rotation, poses.translation)
    return replace(
        poses,
        rotation=rotation,
        translation=translation,
        log_likelihood=poses.log_likelihood.astype(np.float64),
        match_count=poses.match_count.astype(np.float64),
        scale=poses.scale.astype(np.float64),
    )


def to_scene_frame(poses: Hypotheses, scene: SearchFrame) -> Hypotheses:
    """Return hypotheses of a problem in the frame of a `SearchFrame`, in float32."""
    rotation, translation = scene.enter(poses.rotation, poses.translation)
    return replace(poses, rotation=rotation, translation=translation)
