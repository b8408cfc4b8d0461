"""What the baselines share: each pair of a batch is solved by itself, in float64, within a limit of time."""

import math
import time
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

from bpnp.geometry import MIN_POINTS
from bpnp.types import Batch, Pose, Prediction, SolveStats


@dataclass(frozen=True)
class SinglePair:
    """The real points of one pair, on the batch's device, and its true pose where it is known."""

    points2d: Float[Tensor, "m 2"]
    points3d: Float[Tensor, "n 3"]
    index: int
    rotation: Float[Tensor, "3 3"] | None = None
    translation: Float[Tensor, "3"] | None = None


class PairSolver(nn.Module):
    """A solver of single pairs: subclasses implement `solve` and name their one estimate.

    A pair's pose depends neither on the other pairs nor on padding. A side with fewer than 4 points has no pose.
    """

    estimates: tuple[str, ...]

    def __init__(self, time_limit: float | None) -> None:
        super().__init__()
        if time_limit is not None and not time_limit > 0:
            raise ValueError(f"expected `time_limit` > 0 seconds, got {time_limit}; try 30, or none for no limit")
        self.time_limit = time_limit

    def forward(self, batch: Batch) -> Prediction:
        # The trainer's inference mode would forbid a local optimiser's gradients.
        with torch.inference_mode(False), torch.no_grad():
            found = [self._solve(pair) for pair in _pairs(batch)]
            return Prediction(poses={self.estimates[0]: _collect(found, batch)})

    def solve(self, pair: SinglePair, deadline: float) -> Pose:
        """The pose of one pair, a batch of one, found before `deadline` on the clock of `time.monotonic`."""
        raise NotImplementedError

    def _solve(self, pair: SinglePair) -> Pose:
        if min(len(pair.points2d), len(pair.points3d)) < MIN_POINTS:
            return no_pose(pair.points3d)
        return self.solve(pair, math.inf if self.time_limit is None else time.monotonic() + self.time_limit)


def one_pose(rotation: Tensor, translation: Tensor, iterations: int, residual: float, converged: bool) -> Pose:
    """A batch of one pose, of a rotation (3, 3) and a translation (3,)."""
    stats = SolveStats(torch.tensor([iterations]), rotation.new_tensor([residual]), torch.tensor([converged]))
    return Pose(rotation.unsqueeze(0), translation.unsqueeze(0), stats.to(rotation.device))


def no_pose(like: Tensor, iterations: int = 0) -> Pose:
    return one_pose(like.new_full((3, 3), math.nan), like.new_full((3,), math.nan), iterations, math.inf, False)


def over(deadline: float) -> bool:
    return time.monotonic() >= deadline


def pair_seed(seed: int, index: int) -> int:
    """Seed of one pair's random numbers, whatever batch it is in."""
    mixed = torch.Generator().manual_seed(seed)
    return int(torch.randint(2**31, (1,), generator=mixed)) * 1_000_003 + index


def _pairs(batch: Batch) -> Iterator[SinglePair]:
    for i, index in enumerate(batch.index.tolist()):
        pose = (None if value is None else value[i].double().clone() for value in (batch.rotation, batch.translation))
        points2d, points3d = batch.points2d[i][batch.mask2d[i]], batch.points3d[i][batch.mask3d[i]]
        yield SinglePair(points2d.double().clone(), points3d.double().clone(), index, *pose)


def _collect(found: list[Pose], batch: Batch) -> Pose:
    stats = zip(*((pose.stats.iterations, pose.stats.residual, pose.stats.converged) for pose in found), strict=True)
    pose = Pose(
        torch.cat([pose.rotation for pose in found]),
        torch.cat([pose.translation for pose in found]),
        SolveStats(*(torch.cat(values) for values in stats)),
    )
    return pose.to(batch.points3d)
