"""Poses from an assignment: RANSAC, weighted PnP, and rounds of matching under the last pose.

A match (i, j) is rated by d_ij = r_ij^2 / (2 s^2). Here r_ij is the chord between bearing i and the direction of
R p_j + t, and s the standard deviation of the residuals in radians. d_ij is -log of a normal density, up to a constant.
"""

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, Literal, TypeVar

import numpy as np
import roma
import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from bpnp.checks import check_within
from bpnp.geometry import bearings, choose, chords
from bpnp.types import Batch, Pose, Prediction, SolveStats, Tensors

FIRST_WIDTH = 5.0  # s of the first round, relative to the last
FEATURE_WEIGHT = 0.03  # weight of the feature distances in a round; the pose separates matches better than features
FARTHEST = 12.0  # largest d, nats: that of points five widths apart
# Residual of a match that supports the RANSAC pose of a heading: the default threshold of RANSAC.
SUPPORT_WIDTH = 0.01  # [radians; not tuned]

_T = TypeVar("_T", SolveStats, Pose, "InitialMatch")
Axis = Literal["x", "y", "z"]


@dataclass(frozen=True)
class InitialMatch(Tensors):
    """Cost and assignment of a network, and the RANSAC pose."""

    cost: Float[Tensor, "b m n"]
    assignment: Float[Tensor, "b m n"]
    stats: SolveStats  # of the transport
    pose: Pose


class StageClock:
    """Stopwatch of the estimates of a batch, started at construction."""

    def __init__(self) -> None:
        self.start, self.seconds = time.perf_counter(), dict[str, float]()

    def record(self, estimate: str) -> None:
        """Record the time of an estimate."""
        self.seconds[estimate] = time.perf_counter() - self.start

    def add_times(self, prediction: Prediction) -> Prediction:
        """Return the prediction with its `seconds`; poses that were not recorded get the current time."""
        for estimate in prediction.poses.keys() - self.seconds.keys():
            self.record(estimate)
        return replace(prediction, seconds={name: self.seconds[name] for name in prediction.poses})


def ransac_pose(ransac: nn.Module, assignment: Float[Tensor, "b m n"], batch: Batch) -> Pose:
    """Estimate an initial pose from the most probable matches; no gradient reaches the assignment.

    The module has the arguments of `bpnp.layers.RansacPnP`.
    """
    return Pose(*ransac(assignment.detach(), batch.points2d, batch.points3d, batch.mask2d, batch.mask3d))


def pnp_pose(pnp: nn.Module, assignment: Float[Tensor, "b m n"], batch: Batch, start: Pose) -> Pose:
    """Compute the pose that best explains the whole assignment, differentiable in the assignment.

    The module has the arguments of `bpnp.layers.WeightedPnP`.
    """
    rays = bearings(batch.points2d)
    return Pose(*pnp(assignment, rays, batch.points3d, start.rotation, start.translation))


def turn_scene(batch: Batch, vertical: Axis, angle: float) -> Batch:
    """Rotate the points of each scene by an angle, radians, about a vertical through their mean; nothing else."""
    mask = batch.mask3d.unsqueeze(-1)
    points3d = torch.where(mask, batch.points3d, 0)
    mean = points3d.sum(1, keepdim=True) / mask.sum(1, keepdim=True)
    axis = torch.zeros(3, dtype=torch.float64)
    axis["xyz".index(vertical)] = angle
    rotation = roma.rotvec_to_rotmat(axis).to(mean)
    return replace(batch, points3d=torch.where(mask, (points3d - mean) @ rotation.mT + mean, 0))


def pose_support(assignment: Float[Tensor, "b m n"], batch: Batch, pose: Pose) -> Float[Tensor, " b"]:
    """Return the sum of P over matches with a residual below `SUPPORT_WIDTH`; 0 without a pose."""
    rotation, translation = pose.rotation, pose.translation
    residual = chords(bearings(batch.points2d).to(rotation), batch.points3d.to(rotation), rotation, translation)
    return torch.where(residual < SUPPORT_WIDTH, assignment.detach(), 0).sum((-2, -1))


def choose_tensors(chosen: Bool[Tensor, " b"], first: _T, second: _T) -> _T:
    """Choose each tensor of `first` for the samples of the mask, else that of `second`, recursively."""
    parts: list[Any] = []
    for one, other in ((getattr(first, field.name), getattr(second, field.name)) for field in fields(first)):
        parts.append((choose if isinstance(one, Tensor) else choose_tensors)(chosen, one, other))
    return type(first)(*parts)


def residual_energy(
    batch: Batch, rotation: Float[Tensor, "b 3 3"], translation: Float[Tensor, "b 3"], width: float
) -> Float[Tensor, "b m n"]:
    """Return d_ij = r_ij^2 / (2 s^2), with the width s in radians, in the dtype of the pose; NaN without a pose."""
    rays, points3d = bearings(batch.points2d).to(rotation), batch.points3d.to(rotation)
    return chords(rays, points3d, rotation, translation).square() / (2 * width**2)


def round_widths(rounds: int, ransac: nn.Module) -> list[float]:
    """Return s of each round in radians, decreasing geometrically to the `threshold` of `ransac`.

    Raise ValueError if `rounds` is negative, or `ransac` has no `threshold`.
    """
    check_within(0, math.inf, rounds=rounds)
    if rounds == 0:
        return []
    last = getattr(ransac, "threshold", None)
    if last is None:
        raise ValueError(
            f"`rounds` needs the `threshold` of `ransac`, which {type(ransac).__name__} lacks; use rounds 0"
        )
    return [float(width) for width in np.geomspace(last, FIRST_WIDTH * last, rounds)[::-1]]  # one round has the last


def match_again(
    prediction: Prediction,
    cost: Float[Tensor, "b m n"],
    batch: Batch,
    *,
    transport: nn.Module,
    pnp: nn.Module,
    widths: Sequence[float],
) -> Prediction:
    """Replace the pose "pnp" by the result of rounds of transport and weighted PnP, one for each width s, radians.

    The first round matches the points under the pose "ransac", each later one under the pose of the round before. The
    assignment of the last round becomes `rematched`; `assignment` stays. `cost` is that of the network's own
    assignment; `transport.entropy` is mu, the weight of its entropy. Without widths the prediction is unchanged.
    """
    pose, assignment = prediction.poses["ransac"], None
    for width in widths:
        under_pose = cost_under_pose(cost, batch, pose, width=width, mu=transport.entropy)  # type: ignore[arg-type]
        assignment, _ = transport(under_pose, batch.mask2d, batch.mask3d)
        pose = pnp_pose(pnp, assignment, batch, pose)
    if assignment is None:
        return prediction
    return replace(prediction, poses=prediction.poses | {"pnp": pose}, rematched=assignment)


def cost_under_pose(
    cost: Float[Tensor, "b m n"], batch: Batch, pose: Pose, *, width: float, mu: float | Tensor
) -> Float[Tensor, "b m n"]:
    """Combine feature distances M and residuals d under a pose, of width s in radians: w M_ij + mu min(d_ij, L).

    The entropic transport of this cost assigns in proportion to exp(-w M_ij / mu) times a normal density of the
    residual with a floor. No gradient reaches the pose. A sample without a pose keeps its M.
    """
    rotation, translation = pose.rotation.detach().to(cost), pose.translation.detach().to(cost)
    energy = residual_energy(batch, rotation, translation, width).clamp(max=FARTHEST)
    return torch.where(pose.found[:, None, None], FEATURE_WEIGHT * cost + mu * energy, cost)
