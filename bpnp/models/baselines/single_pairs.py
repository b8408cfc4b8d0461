"""What the baselines share: each pair of a batch is solved by itself, in float64, within a limit of time."""

import math
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

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


class Answer(NamedTuple):
    """The pose of one pair, None if there is none, and how its solver ended: the fields of `SolveStats`."""

    pose: tuple[Float[Tensor, "3 3"], Float[Tensor, "3"]] | None = None
    iterations: int = 0
    residual: float = math.inf
    converged: bool = False


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
            answers = [self._solve(pair) for pair in _pairs(batch)]
            like = batch.points3d
            missing = like.new_full((3, 3), math.nan), like.new_full((3,), math.nan)
            poses = zip(*(missing if answer.pose is None else answer.pose for answer in answers), strict=True)
            stats = SolveStats(*(torch.tensor(values) for values in zip(*(a[1:] for a in answers), strict=True)))
            rotation, translation = (torch.stack([value.to(like) for value in values]) for values in poses)
            return Prediction(poses={self.estimates[0]: Pose(rotation, translation, stats.to(like))})

    def solve(self, pair: SinglePair, deadline: float) -> Answer:
        """The pose of one pair, found before `deadline` on the clock of `time.monotonic`."""
        raise NotImplementedError

    def _solve(self, pair: SinglePair) -> Answer:
        if min(len(pair.points2d), len(pair.points3d)) < MIN_POINTS:
            return Answer()
        return self.solve(pair, math.inf if self.time_limit is None else time.monotonic() + self.time_limit)


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
